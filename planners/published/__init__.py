"""The public code's planners here: their checkpoints read into ours."""
