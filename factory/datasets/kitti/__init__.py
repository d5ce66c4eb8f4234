"""KITTI raw: streets for the scene engine; no clips."""
