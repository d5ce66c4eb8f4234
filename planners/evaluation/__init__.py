"""EPDMS of planners on a benchmark: frames, plans, scores, tables and comparisons."""
