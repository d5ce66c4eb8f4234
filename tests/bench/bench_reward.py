"""Simulate and score K trajectories on one core: `make bench-reward`, `python -m tests.bench.bench_reward`.

The public metric's recorded scenes where they are at hand (proposals for K = 256 on all, 4,096 on four, 16,384 on
one), else a clip of the synthetic town under the kinematic vocabulary. Every row is a fresh process with one thread;
times are CPU time, the median of several calls; memory is the peak above what stood before the first such call.
"""

import multiprocessing
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factory.clips.synthetic.reader import SyntheticReader
from tasks.kinematic_vocabulary import kinematic_trajectories
from tasks.reward.epdms import score
from tasks.reward.prepare import PreparedScene, prepare_scene
from tasks.rollout.lqr import track_local
from tasks.world.clip import NOW, scene_of_clip
from tests.bench.timing import cpu_milliseconds, memory_mb
from tests.real.reference_scenes import RECORDED_K, SCENES, loader, prepared_scene

PUBLIC_MS_PER_TRAJECTORY = 20.0  # the public implementation, one core
SIZES = (1, 256, 4096, 16384)


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    prepare_ms: float
    simulate_ms: float
    score_ms: float
    peak_mb: float


def measured(prepared: Callable[[], PreparedScene], ego_state: np.ndarray, trajectories: np.ndarray) -> Row:
    """Times of one scene and K, once everything is compiled."""
    ready = prepared()
    states = track_local(ego_state, trajectories[:1])
    score(ready, states)
    before = memory_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew here
    score(ready, track_local(ego_state, trajectories))
    peak = memory_mb("VmHWM") - before

    repeats = 5 if len(trajectories) > 1000 else 40
    states = track_local(ego_state, trajectories)
    return Row(
        prepare_ms=cpu_milliseconds(prepared, 10),
        simulate_ms=cpu_milliseconds(lambda: track_local(ego_state, trajectories), repeats),
        score_ms=cpu_milliseconds(lambda: score(ready, states), repeats),
        peak_mb=peak,
    )


def recorded_row(root: Path, scene: str, k: int) -> Row:
    """One of the public metric's scenes with its recorded proposals."""
    module = loader(root)
    inputs = module.inputs(scene)
    return measured(lambda: prepared_scene(inputs), inputs["ego_state0"], module.proposals(scene, k))


def town_row(k: int) -> Row:
    """A clip of the synthetic town."""
    reader = SyntheticReader(n_clips=1)
    scene = scene_of_clip(reader.read(reader.index().refs[0]))
    agents = scene.agents.window(NOW, NOW + 41)
    return measured(lambda: prepare_scene(scene, agents), scene.ego_state, kinematic_trajectories(k, 0))


def main(root: Path) -> None:
    """Prints the table, row by row."""
    print("| scene | K | prepare ms | simulate ms | score ms | total ms | us each | peak MB | public / ours |")
    print("|---|---|---|---|---|---|---|---|---|")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        if (root / "reference").is_dir():
            jobs = [(name, k, (recorded_row, root, name, k)) for k in SIZES for name in SCENES if _recorded(name, k)]
        else:
            print(f"no recorded scenes at {root}: a synthetic one instead", file=sys.stderr)
            jobs = [("synthetic town", k, (town_row, k)) for k in SIZES]
        for name, k, job in jobs:
            row: Row = pool.submit(*job).result()
            total = row.simulate_ms + row.score_ms
            print(
                f"| {name} | {k:,} | {row.prepare_ms:.1f} | {row.simulate_ms:.2f} | {row.score_ms:.2f} | {total:.2f} "
                f"| {1e3 * total / k:.1f} | {row.peak_mb:.0f} | {PUBLIC_MS_PER_TRAJECTORY * k / total:,.0f} |",
                flush=True,
            )


def _recorded(name: str, k: int) -> bool:
    return k <= 256 or k in RECORDED_K.get(name, ())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared"))
