"""Samples in the layouts of other people's code."""
