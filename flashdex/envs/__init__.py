"""The tracking environment: scenes, physics, features, rewards, terminations."""
