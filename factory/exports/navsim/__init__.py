"""SimScale's released layout: logs, pictures, splits and rewards that NAVSIM and SimScale read unchanged.

What is written, key by key, and the public line that reads it: docs/navsim_format.md. Names and steps follow
`OpenDriveLab/SimScale` @ f51ad64 and `autonomousvision/navsim` @ 0a380a9.
"""
