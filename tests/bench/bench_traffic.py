"""The public reactive traffic and ours on crowds that get in each other's way: how far apart, and how long each takes.

PEER=<python of an environment with navsim and nuplan-devkit> python -m tests.bench.bench_traffic [N] [RECORD.npz]

N crowds (32) on the maps of synthetic towns, every lane with a speed limit by chance or none; a line each: vehicles,
agents and those that stay, the largest difference of a box, of a velocity, of presence, and CPU seconds of a rollout of
both. The peer's map is a few arrays, so its own look-ups are not in the time. RECORD: three smaller crowds with the
public answers, for tests/tasks/rollout/test_navsim_traffic.py.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.datasets.av2.reader import read_log
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import write_logs
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tests.bench.peer import peer_python
from tests.tasks.rollout.crowds import Crowd, arrays_of, crowd, crowd_of, limited, relevant

ADAPTER = Path(__file__).with_name("peer_traffic.py")
TOWNS = 6
RECORDED = (9, 20, 29)  # seeds: few lanes, vehicles that stay, and ties that decide where a car goes


def crowds(n: int, groups: tuple[int, int]) -> list[Crowd]:
    """On the towns' maps in turn, as both programs read them."""
    with tempfile.TemporaryDirectory() as folder:
        logs = write_logs(Path(folder), range(TOWNS), 0, TownSettings(cameras=(), lidar_beams=0))
        lanes = [limited(read_log(log).road_map, seed) for seed, log in enumerate(logs)]
    made = [relevant(crowd(lanes[seed % TOWNS], seed, groups)) for seed in range(n)]
    return [crowd_of(arrays_of(one)) for one in made]


def peers(python: str, of: list[Crowd]) -> list[dict[str, NDArray[np.generic]]]:
    """The public answers to crowds."""
    given = {f"{i}/{name}": values for i, one in enumerate(of) for name, values in arrays_of(one).items()}
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "in.npz", **given)
        command = [python, "-W", "ignore", str(ADAPTER), f"{folder}/in.npz", f"{folder}/out.npz"]
        subprocess.run(command, check=True)
        with np.load(Path(folder) / "out.npz") as out:
            return [
                {name.split("/")[1]: out[name] for name in out.files if name.startswith(f"{i}/")}
                for i in range(len(of))
            ]


def line(one: Crowd, theirs: Mapping[str, NDArray[np.generic]]) -> str:
    """What both say of one crowd."""
    traffic = prepare_traffic(one.scene, TrafficSettings(mode="navsim"))
    assert traffic.navsim is not None
    if "failed" in theirs:
        try:
            roll_out(traffic, one.ego_states)
        except ValueError as error:
            return f"| both refuse: {theirs['failed']} / {error} |"
        return f"| only the public code refuses: {theirs['failed']} |"
    began = time.process_time()
    ours = roll_out(traffic, one.ego_states).agents
    took = time.process_time() - began
    both = ours.valid & theirs["valid"]
    apart = [np.abs(getattr(ours, name) - theirs[name])[both].max(initial=0.0) for name in ("boxes", "velocities")]
    there = int((ours.valid != theirs["valid"]).sum())
    counts = f"{len(one.now)} | {len(traffic.navsim.driven)} | {len(traffic.navsim.staying)}"
    return f"| {counts} | {apart[0]:.2g} | {apart[1]:.2g} | {there} | {took:.2f} | {float(theirs['seconds']):.2f} |"


def record(path: Path, python: str) -> None:
    """The recording of the test."""
    every = crowds(max(RECORDED) + 1, (12, 22))
    of = [every[seed] for seed in RECORDED]
    kept: dict[str, NDArray[np.generic]] = {}
    for i, (one, theirs) in enumerate(zip(of, peers(python, of))):
        kept |= {f"{i}/{name}": values for name, values in arrays_of(one).items()}
        kept |= {f"{i}/public_{name}": theirs[name] for name in ("boxes", "velocities", "valid")}
    np.savez_compressed(path, **kept)


def main(n: int = 32, recording: Path | None = None) -> None:
    python = peer_python()
    if python is None:
        raise SystemExit("there is nothing to compare with: " + (__doc__ or "").splitlines()[2])
    if recording is not None:
        record(recording, python)
    print("| vehicles | agents | staying | box m | velocity m/s | presence | ours s | public s |")
    print("|---|---|---|---|---|---|---|---|")
    of = crowds(n, (15, 60))
    for one, theirs in zip(of, peers(python, of)):
        print(line(one, theirs), flush=True)


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:2]), *(Path(word) for word in sys.argv[2:3]))
