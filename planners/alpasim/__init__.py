"""A planner as a driver of the closed-loop simulator AlpaSim."""
