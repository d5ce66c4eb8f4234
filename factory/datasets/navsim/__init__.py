"""NAVSIM: logs, scene filters and rig of OpenScene, which is nuPlan at 2 Hz; nuPlan's maps; SimScale's released layout.

An export has logs, pictures, splits and rewards that NAVSIM and SimScale read unchanged: what is written, key by key,
and the public line that reads it, stands in docs/navsim_format.md. Names and steps follow `OpenDriveLab/SimScale` @
f51ad64 and `autonomousvision/navsim` @ 0a380a9.
"""

from factory.datasets.navsim.settings import NavsimClips

READERS = {"NavsimReader": NavsimClips}
READS = "nuplan openscene", "clips=navsim clips.root=<OpenScene's logs> clips.maps=<nuPlan's maps> (docs/navsim.md)"
IMPORTS = {
    "simscale": "factory.datasets.navsim.commands:import_simscale",
    "navhard": "factory.datasets.navsim.commands:import_two_stage_benchmark",
    "navtest": "factory.datasets.navsim.commands:import_one_stage_benchmark",
}
EXPORTS = {"navsim": "factory.datasets.navsim.commands:export_samples"}
BENCHMARKS = dict.fromkeys(("navhard", "navtest"), "factory.datasets.navsim.commands:find_or_make_benchmark")
