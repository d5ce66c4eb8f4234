"""3D Gaussian splatting: coloured points in, camera images at new poses out."""
