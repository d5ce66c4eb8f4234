"""A seeded town written to disk in AV2 layout: test data and a first look, not training data."""
