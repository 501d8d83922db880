"""OakInk2: annotated sequences cut at their primitives."""
