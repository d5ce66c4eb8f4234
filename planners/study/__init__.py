"""Many trainings and what they say together: sweeps, their tables, and arms that are held against each other."""
