"""PDM-Closed (Dauner et al. 2023), the privileged planner (docs/reward.md 4)."""
