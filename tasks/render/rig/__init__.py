"""A rig's calibration and poses, corrected by what its photos show together."""
