"""Robot hands: specs, MuJoCo models, kinematics."""
