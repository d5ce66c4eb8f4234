"""EPDMS and its sub-scores, rule by rule (METRIC.md)."""
