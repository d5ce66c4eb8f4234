"""ScenarioNet databases: nuScenes, Waymo, nuPlan and others in one format."""
