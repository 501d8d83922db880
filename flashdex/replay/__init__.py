"""Replay rows: how they are coded, kept, drawn and stored."""
