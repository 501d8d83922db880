"""Recorded human hand-object motions to robot-hand motions that hold in physics."""

__version__ = "0.1.0"
