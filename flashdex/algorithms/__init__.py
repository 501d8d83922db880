"""What acts, remembers and learns: FlashSAC and PPO."""
