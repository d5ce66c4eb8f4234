"""Reconstruction by optimisation: Gaussians, sky, exposure and small pose corrections fitted to photos and lidar."""
