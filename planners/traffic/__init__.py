"""A traffic policy's fit to logs (`python -m planners train_traffic`); what it drives: tasks/rollout/learned."""
