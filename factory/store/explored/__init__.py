"""What planners proposed: a table of their drives, and what a run takes from it."""
