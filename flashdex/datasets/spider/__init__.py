"""Files of SPIDER: trajectories and scenes."""
