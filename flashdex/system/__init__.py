"""Atomic files, locks, JSON lines, this machine: what knows no domain."""
