"""EPDMS and its sub-scores, rule by rule (docs/reward.md)."""
