"""Where a planner drives itself: proposals for the factory, and turns of training and exploring."""
