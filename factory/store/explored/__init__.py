"""Where planners drove themselves: a table of their drives, and what a run takes from it."""
