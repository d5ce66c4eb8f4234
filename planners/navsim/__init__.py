"""Planners inside NAVSIM's own evaluation. `agent` and `wire` run in its Python too: 3.9, numpy 1.23."""
