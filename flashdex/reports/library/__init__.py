"""Page of a motion library."""
