"""Page and table of a run."""
