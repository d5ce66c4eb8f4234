"""DiffusionDrive (Liao et al. 2025)."""
