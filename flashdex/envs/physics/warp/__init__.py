"""MuJoCo Warp on one NVIDIA GPU."""
