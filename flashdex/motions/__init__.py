"""Recordings in, motion libraries out: readers, retargeting, objects, checks."""
