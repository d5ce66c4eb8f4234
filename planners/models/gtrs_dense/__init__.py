"""GTRS-Dense (Li et al. 2025)."""
