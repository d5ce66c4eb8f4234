"""3D Gaussians to pixels, and the way back."""
