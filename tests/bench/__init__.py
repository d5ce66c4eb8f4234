"""Benchmarks: commands that print tables. Never part of the tests."""
