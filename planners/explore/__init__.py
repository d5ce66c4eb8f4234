"""Where a planner drives itself: drifts for the factory, and turns of training and exploring."""
