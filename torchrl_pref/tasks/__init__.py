"""Where trajectories come from, and their features."""
