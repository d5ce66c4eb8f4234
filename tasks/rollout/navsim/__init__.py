"""The public evaluation's reactive traffic, to the letter: `traffic=navsim` (docs/reward.md 5)."""
