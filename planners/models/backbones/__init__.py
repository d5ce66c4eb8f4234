"""Image backbones, by name."""
