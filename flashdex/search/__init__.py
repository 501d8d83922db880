"""Sampling-based trajectory optimisation, one motion at a time, in its own scene."""
