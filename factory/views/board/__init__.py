"""The live dashboard: what the tables of a run hold, as JSON, pictures and one page; `python -m factory dashboard`."""
