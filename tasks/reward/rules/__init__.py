"""What each sub-score asks of one trajectory, and the indices that make asking cheap (docs/reward.md 2)."""
