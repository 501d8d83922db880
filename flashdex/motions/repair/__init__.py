"""Gaps closed, outliers mended, sessions cut into motions."""
