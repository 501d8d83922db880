"""MuJoCo scenes of motions, their union, and wrenches on objects."""
