"""nuPlan's maps: GeoPackages read once into arrays, and the part of a city around a drive as a RoadMap."""
