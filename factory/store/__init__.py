"""Where samples, outcomes and candidates live."""
