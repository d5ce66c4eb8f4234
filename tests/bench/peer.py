"""The public metric as a peer of our reward: another Python, the same scene, run in turns with ours.

A ratio is a ratio of CPU times of two runs that follow each other on one machine, of outputs that are compared; nothing
here holds a time that was measured elsewhere.
"""

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tasks.reward.epdms import Scores
from tasks.subscores import RECORDS
from tasks.world.clip import AgentTracks
from tasks.world.road_map import MapPolygon

Array = NDArray[np.float64]

ADAPTER = Path(__file__).with_name("peer_navsim.py")
SAME = 1e-9  # scores further apart than this are different
PEERS = {record.long_name: record.name for record in RECORDS if record.plans == 1} | {"pdm_score": "pdm_score"}


@dataclass(frozen=True)
class BenchScene:
    """What a scene is to the reward, ours and the peer's; red lights are left out."""

    ego_state0: Array  # (11,)
    past_states: Array  # (4, 11)
    centerline: Array  # (P, 3)
    polygons: tuple[MapPolygon, ...]
    route_lane_ids: frozenset[str]
    objects: AgentTracks  # 41 steps


@dataclass(frozen=True)
class Beside:
    """Two programs on the same trajectories, turn by turn."""

    ours_s: Array  # (N,) CPU seconds of each turn
    peer_s: Array  # (N,)
    worst: float  # largest difference of any sub-score or score of any trajectory

    def row(self, k: int) -> str:
        """CPU us per trajectory of ours and the peer's (medians), the ratios of the turns, whether the scores agree."""
        ratio = self.peer_s / self.ours_s
        same = "equal" if self.worst <= SAME else f"differ by {self.worst:.2g}"
        ours_us, peer_us = (1e6 * np.median(seconds) / k for seconds in (self.ours_s, self.peer_s))
        ratios = " / ".join(f"{value:,.0f}" for value in (ratio.min(), np.median(ratio), ratio.max()))
        return f"{ours_us:.1f} | {peer_us:,.0f} | {ratios} | {same}"


def beside(python: str, scene: BenchScene, poses: Array, ours: Callable[[], Scores], turns: int) -> Beside:
    """Our call and the peer's drive and score of world poses (K, 40, 3), in turns.

    python: of an environment with the public packages. Raises RuntimeError with the peer's last words if it stops.
    """
    with tempfile.TemporaryDirectory() as folder, _started(python, Path(folder), scene, poses) as ask:
        ask()  # both have been called once before any time counts
        scores = ours()
        with np.load(Path(folder) / "scores.npz") as theirs:
            worst = max(np.abs(theirs[name] - getattr(scores, own)).max() for name, own in PEERS.items())
        ours_s, peer_s = np.empty(turns), np.empty(turns)
        for turn in range(turns):
            peer_s[turn] = ask()
            begun = time.process_time()
            ours()
            ours_s[turn] = time.process_time() - begun
    return Beside(ours_s, peer_s, float(worst))


@contextmanager
def _started(python: str, folder: Path, scene: BenchScene, poses: Array) -> Iterator[Callable[[], float]]:
    """The peer with its scene; the call runs it once and gives its CPU seconds."""
    np.savez(folder / "scene.npz", **_arrays(scene), poses=poses)
    with (folder / "words").open("w+") as words:
        command = [python, "-W", "ignore", str(ADAPTER), str(folder)]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=words, text=True, env=_one_thread()) as peer:
            assert peer.stdin is not None and peer.stdout is not None

            def answer() -> str:
                assert peer.stdout is not None
                line = peer.stdout.readline()
                if not line:
                    words.seek(0)
                    raise RuntimeError(f"the peer ({python}) stopped: {(words.read().strip() or '-').splitlines()[-1]}")
                return line

            def ask() -> float:
                assert peer.stdin is not None
                print(file=peer.stdin, flush=True)
                return float(answer())

            answer()
            yield ask
            peer.stdin.close()


def _arrays(scene: BenchScene) -> dict[str, Array]:
    rings = [(i, ring) for i, polygon in enumerate(scene.polygons) for ring in (polygon.ring, *polygon.holes)]
    objects = scene.objects
    there = objects.valid & np.isfinite(objects.boxes).all(axis=-1)
    return {
        "ego_state0": scene.ego_state0,
        "past_states": scene.past_states,
        "centerline": scene.centerline[:, :3],
        "ring_points": np.concatenate([ring[:, :2] for _, ring in rings]),
        "ring_ends": np.cumsum([len(ring) for _, ring in rings]),
        "ring_owners": np.array([i for i, _ in rings]),
        "layers": np.array([polygon.layer.value for polygon in scene.polygons]),
        "polygon_tokens": np.array([polygon.token for polygon in scene.polygons]),
        "route_lane_ids": np.array(sorted(scene.route_lane_ids)),
        "object_tokens": np.array(objects.track_ids),
        "kinds": np.array([kind.value for kind in objects.kinds]),
        "boxes": objects.boxes,
        "velocities": objects.velocities,
        "valid": there,
    }


def _one_thread() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def peer_python() -> str | None:
    """The Python that PEER names. Raises SystemExit with one line where it has no public metric."""
    python = os.environ.get("PEER", "")
    if not python:
        return None
    try:
        tried = subprocess.run(
            [python, "-W", "ignore", "-c", "import navsim, nuplan"], capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise SystemExit(f"PEER={python} cannot be started: {error.strerror}; {_WANTED}") from None
    if tried.returncode:
        raise SystemExit(f"PEER={python} lacks the public metric: {tried.stderr.strip().splitlines()[-1]}; {_WANTED}")
    return python


_WANTED = "give the python of an environment in which the packages navsim and nuplan-devkit are installed"
