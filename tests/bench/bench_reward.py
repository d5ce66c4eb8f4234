"""Simulate and score K trajectories on one core: `make bench NAME=reward`, `python -m tests.bench.bench_reward`.

The public metric's recorded scenes where they are at hand (proposals for K = 256 on all, 4,096 on four, 16,384 on
one), else a clip of the synthetic town under the kinematic vocabulary. K = 2 is what an attempt pays, PDM-Closed and
the planner. Every row is a fresh process with one thread; times are CPU time, least and median of several calls;
memory is the peak above what stood before the first such call. What is made ready before is not in `us each`:
`new place` is paid once per place of the ego, `prepare` whenever the traffic is another.

PEER=<python of an environment with the packages navsim and nuplan-devkit> runs the public metric on the same
trajectories in turns with ours and says whether the scores are equal; without it nothing is compared.
"""

import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.datasets.town.reader import SyntheticReader
from tasks.reward.epdms import N_TIMES, PAST_STEPS, PreparedScene, Scores, prepare, score
from tasks.rollout.lqr import track
from tasks.world.clip import NOW, scene_of_clip
from tasks.world.frames import PACIFICA, ego_boxes, to_world
from tasks.world.road_map import polygons_near
from tasks.world.vocabulary import kinematic_trajectories
from tests.bench.peer import BenchScene, Beside, beside, peer_python
from tests.bench.timing import cpu_milliseconds, least_and_median_cpu_ms, memory_mb
from tests.real.reference_scenes import RECORDED_K, SCENES, loader, logged_tracks, map_polygons

SIZES = (2, 256, 4096, 16384)
TURNS = {2: 21, 256: 5, 4096: 1, 16384: 1}  # with a peer, which takes minutes for the large ones


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    place_ms: float  # map, centreline and objects made ready, the map for the first time
    prepare_ms: float  # the same on a map that was ready already: a further pair of the clip
    simulate_ms: tuple[float, float]  # least, median
    score_ms: tuple[float, float]  # least, median
    peak_mb: float
    beside: Beside | None


def prepared_scene(scene: BenchScene) -> PreparedScene:
    """The scene as the reward takes it."""
    return prepare(
        past_states=scene.past_states,
        centerline=scene.centerline,
        polygons=scene.polygons,
        route_lane_ids=scene.route_lane_ids,
        objects=scene.objects,
        ego_state0=scene.ego_state0,
        drop_touching=False,
    )


def measured(scene: BenchScene, trajectories: NDArray[np.float64], peer: str | None) -> Row:
    """Times of one scene and its trajectories (K, 40, 3) in the ego's frame, once everything is compiled."""
    ready, ego_state = prepared_scene(scene), scene.ego_state0

    def drive_and_score() -> Scores:
        return score(ready, track(ego_state, trajectories, local=True))

    score(ready, track(ego_state, trajectories[:1], local=True))
    before = memory_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew here
    drive_and_score()
    peak = memory_mb("VmHWM") - before

    repeats = 5 if len(trajectories) > 1000 else 200
    states = track(ego_state, trajectories, local=True)
    poses = to_world(ego_state[:3], trajectories)
    return Row(
        place_ms=cpu_milliseconds(lambda: prepared_scene(elsewhere(scene)), 10),
        prepare_ms=cpu_milliseconds(lambda: prepared_scene(scene), 10),
        simulate_ms=least_and_median_cpu_ms(lambda: track(ego_state, trajectories, local=True), repeats),
        score_ms=least_and_median_cpu_ms(lambda: score(ready, states), repeats),
        peak_mb=peak,
        beside=beside(peer, scene, poses, drive_and_score, TURNS[len(trajectories)]) if peer else None,
    )


def elsewhere(scene: BenchScene) -> BenchScene:
    """The same scene on a map that nothing has been made of yet."""
    return replace(scene, polygons=tuple(replace(polygon) for polygon in scene.polygons))


def recorded_scene(root: Path, name: str) -> BenchScene:
    """One of the public metric's scenes."""
    inputs = loader(root).inputs(name)
    return BenchScene(
        ego_state0=inputs["ego_state0"],
        past_states=inputs["past_states"],
        centerline=inputs["centerline"],
        polygons=tuple(map_polygons(inputs)),
        route_lane_ids=frozenset(inputs["route_lane_ids"]),
        objects=logged_tracks(inputs).window(0, N_TIMES),
    )


def recorded_row(root: Path, name: str, k: int, peer: str | None) -> Row:
    """One of the public metric's scenes with its recorded proposals."""
    return measured(recorded_scene(root, name), loader(root).proposals(name, k), peer)


def town_scene() -> BenchScene:
    """A clip of the synthetic town."""
    reader = SyntheticReader(n_clips=1)
    now = scene_of_clip(reader.read(reader.index().refs[0]))
    return BenchScene(
        ego_state0=now.ego_state,
        past_states=now.ego_history[list(PAST_STEPS)],
        centerline=now.centerline,
        polygons=polygons_near(now.clip.road_map, ego_boxes(now.ego_state, PACIFICA)[:2]),
        route_lane_ids=now.clip.route.lane_ids,
        objects=now.agents.window(NOW, NOW + N_TIMES),
    )


def town_row(k: int, peer: str | None) -> Row:
    """A clip of the synthetic town under the kinematic vocabulary."""
    return measured(town_scene(), kinematic_trajectories(k, 0), peer)


def main(root: Path, sizes: Sequence[int] = SIZES) -> None:
    """Prints the table, row by row."""
    peer = peer_python()
    columns = [
        "scene",
        "K",
        "new place ms",
        "prepare ms",
        "simulate ms",
        "score ms",
        "us each, least / median",
        "peak MB",
    ]
    if peer:
        columns += ["in turns: ours us each", "public us each", "public / ours, least / median / most", "scores"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        if (root / "reference").is_dir():
            rows = [
                (name, k, (recorded_row, root, name, k, peer)) for k in sizes for name in SCENES if _recorded(name, k)
            ]
        else:
            print(f"no recorded scenes at {root}: a synthetic one instead", file=sys.stderr)
            rows = [("synthetic town", k, (town_row, k, peer)) for k in sizes]
        for name, k, job in rows:
            row: Row = pool.submit(*job).result()
            least, median = (1e3 * (a + b) / k for a, b in zip(row.simulate_ms, row.score_ms))
            compared = f" {row.beside.row(k)} |" if row.beside else ""
            print(
                f"| {name} | {k:,} | {row.place_ms:.1f} | {row.prepare_ms:.2f} | {row.simulate_ms[1]:.3f} "
                f"| {row.score_ms[1]:.3f} | {least:.1f} / {median:.1f} | {row.peak_mb:.0f} |{compared}",
                flush=True,
            )


def _recorded(name: str, k: int) -> bool:
    return k <= 256 or k in RECORDED_K.get(name, ())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared"))
