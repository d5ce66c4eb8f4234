"""NAVSIM: logs, scene filters and rig of OpenScene, which is nuPlan at 2 Hz."""
