"""Ego tracking (LQR on a kinematic bicycle) and reactive traffic (IDM)."""
