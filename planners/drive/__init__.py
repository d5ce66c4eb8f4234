"""Planners that drive: their plans followed, looked at again and followed on, until something ends the drive."""
