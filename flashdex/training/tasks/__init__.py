"""What a run does: a policy on motions or on a stock environment, or a search."""
