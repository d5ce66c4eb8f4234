"""Traffic that a policy drives: what one is asked and answers, how it is stepped, and one that was fitted to logs."""
