"""Observation transforms: from the compact state to what a policy sees."""
