"""The machine: clips in, committed samples out, exactly once."""
