"""Two planners held against each other, and arms of one experiment: `python -m planners compare` and `ab`."""
