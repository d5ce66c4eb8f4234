"""Where plans, candidates, samples and outcomes live."""
