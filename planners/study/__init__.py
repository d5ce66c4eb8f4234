"""Many trainings and what they say together: sweeps, the study, its tables and pictures."""
