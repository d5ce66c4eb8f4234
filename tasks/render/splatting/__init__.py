"""3D Gaussians to pixels, and the backward pass."""
