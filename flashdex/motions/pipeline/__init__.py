"""From recordings to a motion library: jobs, workers, cache."""
