"""NAVSIM's benchmarks as its own scripts tell of them: by name, and as tables to be held against published ones."""
