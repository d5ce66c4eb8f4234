"""The Gaussian scene of a block, from what its sensors recorded, and how it is drawn."""
