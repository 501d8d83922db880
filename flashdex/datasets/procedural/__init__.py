"""Made-up motions: a hand carries a shape."""
