"""The recovery expert: back to the log along human trajectories."""
