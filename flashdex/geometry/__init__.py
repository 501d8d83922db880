"""Geometry on tensors: rotations, point sets, signed distances. Torch only."""
