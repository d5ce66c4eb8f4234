"""From batches to a trained planner."""
