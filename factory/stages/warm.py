"""Compiles every kernel once, into the on-disk cache, before workers start."""

import gc
import hashlib
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from threading import Event, Lock, Thread

import numpy as np

from factory.exits import become_worker, terminal_signals_blocked
from factory.files import locked
from factory.graph.steps import NotReady
from tasks.attempt import drive_and_judge
from tasks.caches import Damaged, sealed, unsealed
from tasks.experts.pdm_closed import forecast, proposals
from tasks.experts.protocol import Plan
from tasks.kernels.compiled import USED, cache_dir, make_cache_dir, not_kept, processor, write_whole
from tasks.render import warm as render_warm
from tasks.render.settings import RenderMode, RenderSettings, SceneFrom
from tasks.reward.epdms import prepare_scene, score
from tasks.reward.labels import Labelling, hit_after_s, reactive_scores, vocabulary_labels
from tasks.rollout.simulate import SeenTraffic, TrafficSettings, prepare_traffic, simulate
from tasks.settings import PdmSettings
from tasks.world.arrays import Array
from tasks.world.clip import CLIP_STEPS, HORIZON_STEPS, NOW, AgentKind, AgentTracks, Clip, Scene, scene_of_clip
from tasks.world.road_map import Lane, RoadMap, Route
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories

REPLAY = TrafficSettings(mode="replay")
ENOUGH_S = 0.2  # between two looks whether compiling is to be given up
_one_at_a_time = Lock()
log = logging.getLogger(__name__)


def parts_of(
    simulates: bool, traffic: str, label_traffic: str | None, render: RenderSettings, photos_alone: bool
) -> list[str]:
    """What a run enters.

    simulates: it has another expert than `human`; traffic, label_traffic: the mode of the drives' traffic and of the
    labels' (None: it makes none). The public traffic, "navsim", has no kernels. photos_alone: clips may have photos and
    no lidar.
    """
    parts = ["judge", "plan"]
    if simulates and traffic == "custom":
        parts.append("policy")
    if label_traffic in ("idm", "navsim"):  # scored among the answers
        parts.append("answers")
    elif simulates and traffic == "idm":
        parts.append("drive")
    if render.mode is RenderMode.AUTO:
        parts.append("fit" if render.scene is SceneFrom.FIT else "render")
        if render.rig.may_correct(photos_alone):
            parts.append("rig")
    return parts


@contextmanager
def compiling_ahead(parts: Sequence[str]) -> Iterator[None]:
    """Compiles beside what is done inside, and gives up what is not compiled at the end of it.

    Code inside that needs the kernels calls `compile_kernels` as usual, which waits for these and raises what failed.
    """
    enough = Event()

    def ahead() -> None:
        with suppress(NotReady, RuntimeError):
            compile_kernels(parts, enough)

    Thread(target=ahead, daemon=True).start()
    try:
        yield
    finally:
        enough.set()


def compile_kernels(parts: Sequence[str], enough: Event | None = None) -> None:
    """Compiles what is not in the cache yet, each part in a process of its own, as many at once as there are cores.

    Of processes that want the same at once, one compiles and the others wait for it.
    Raises NotReady where the cache cannot be written, and RuntimeError with a part's last words where it fails or is
    given up because there is `enough`.
    """
    if all(map(_is_compiled, parts)):
        return
    try:
        make_cache_dir()
        with (cache_dir() / f"lock-{_key()}").open("w") as lock:
            if enough is None:  # somebody waits
                print("compiling kernels, once for this version: about a minute", file=sys.stderr, flush=True)
            with _one_at_a_time, locked(lock):
                missing, enough = [name for name in parts if not _is_compiled(name)], enough or Event()
                with ThreadPoolExecutor(os.cpu_count()) as pool:
                    try:
                        list(pool.map(partial(_compile_part, enough=enough), missing))
                    except KeyboardInterrupt:  # which a part does not hear
                        enough.set()
                        raise
    except OSError as error:
        raise NotReady(not_kept(error)) from error


def _key() -> str:
    """8 hex digits of the processor and of what is called here for it to be compiled."""
    sha = hashlib.sha256(processor().encode())
    for module in (__file__, render_warm.__file__):
        sha.update(Path(module).read_bytes())
    return sha.hexdigest()[:8]


def marker(name: str) -> Path:
    """The file that lists what a part has in the cache."""
    return cache_dir() / f"compiled-{_key()}-{name}"


def _is_compiled(name: str) -> bool:
    """The part was compiled, and nobody has taken a file of it away since."""
    try:
        files = [
            cache_dir() / file for file in unsealed(marker(name).read_bytes(), marker(name).name).decode().splitlines()
        ]
    except OSError:  # not there, or in a folder that cannot be: whoever then writes into it says so
        return False
    except Damaged as error:
        log.warning("%s: %s; it is made again", marker(name), error)
        return False
    return all(file.is_file() for file in files)


def _compile_part(name: str, enough: Event) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", "factory.stages.warm", name]
    if enough.is_set():
        raise RuntimeError(f"compiling the kernels of {name} was not begun")
    with terminal_signals_blocked():
        part = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)  # noqa: S603 (ours)
    with part:
        said = _ended(part, enough)
    if part.returncode == DISK_FULL:
        raise OSError(said.strip().splitlines()[-1])
    if part.returncode != 0:
        raise RuntimeError(f"compiling the kernels of {name} failed: {said[-2000:]}")


def _ended(part: "subprocess.Popen[str]", enough: Event) -> str:
    """What it said once it has ended, by itself or because there is enough."""
    while True:
        try:
            return part.communicate(timeout=ENOUGH_S)[1]
        except subprocess.TimeoutExpired:
            if enough.is_set():
                part.terminate()


def _warm(name: str) -> int:
    """One part, in this process; the exit code."""
    become_worker()
    gc.disable()  # a process that ends soon: some 220 MB more for a sixth of its time
    PARTS[name]()
    listed = "\n".join(sorted(path.relative_to(cache_dir()).as_posix() for path in USED))
    try:
        for part in (name, *INCLUDED.get(name, ())):
            write_whole(marker(part), sealed(listed.encode(), marker(part).name))
    except OSError as error:
        print(error, file=sys.stderr)
        return DISK_FULL
    return 0


def _judge() -> None:
    """Scores, and all that an attempt among the log's traffic enters.

    `plan` is compiled meanwhile and takes half as long: it is there when the attempt asks for it.
    """
    scene, ahead = _tiny_scene()
    prepared = prepare_scene(scene, scene.agents.window(scene.step, scene.step + HORIZON_STEPS + 1))
    standing = np.tile(scene.ego_state, (2, HORIZON_STEPS + 1, 1))
    score(prepared, standing, normalise="pairs")
    judged = drive_and_judge(scene, Plan(ahead), REPLAY, PdmSettings())
    labelling = Labelling(Vocabulary(kinematic_trajectories(2, 0)), REPLAY)
    vocabulary_labels(labelling, scene, judged.prepared, judged.reference)
    hit_after_s(prepare_traffic(scene, REPLAY), judged.prepared, judged.rollout.ego_states)


def _plan() -> None:
    """The tracker, and what PDM-Closed proposes."""
    scene, ahead = _tiny_scene()
    simulate(scene, ahead, REPLAY)
    seen = forecast(scene.ego_state, scene.agents.window(scene.step, scene.step + 1))
    proposals(scene.ego_state, scene.centerline, seen, None, PdmSettings())


def _drive() -> None:
    """Traffic around one ego."""
    scene, ahead = _tiny_scene()
    simulate(scene, ahead, TrafficSettings())


class _Stands:
    """A traffic policy that is none."""

    def digest(self) -> str:
        return ""

    def next_states(self, seen: SeenTraffic) -> Array:
        return np.pad(seen.boxes[-1, :-1, :3], ((0, 0), (0, 1)))


def _policy() -> None:
    """Traffic that a policy of a user's own drives around one ego."""
    scene, ahead = _tiny_scene()
    simulate(scene, ahead, TrafficSettings(mode="custom", policy=f"{__name__}:{_Stands.__name__}"))


def _answers() -> None:
    """The same, and traffic around each of several egos, scored."""
    _drive()
    scene, ahead = _tiny_scene()
    states = simulate(scene, ahead, REPLAY).ego_states
    reactive_scores(scene, np.stack([states] * 2), TrafficSettings())


def _fit() -> None:
    """Scenes that are built and drawn, and fitted: in one process, for they share kernels."""
    render_warm.compile_kernels()
    render_warm.compile_fit_kernels()


PARTS = {
    "judge": _judge,
    "plan": _plan,
    "drive": _drive,
    "answers": _answers,
    "policy": _policy,
    "render": render_warm.compile_kernels,
    "fit": _fit,
    "rig": render_warm.compile_rig_kernels,
}
INCLUDED = {"judge": ("plan",), "answers": ("drive",), "fit": ("render",)}
DISK_FULL = 5  # exit code of a part whose files could not be kept


def _tiny_scene() -> tuple[Scene, Array]:
    ahead = np.stack([np.arange(1, 41) * 0.5, np.zeros(40), np.zeros(40)], axis=1)
    return scene_of_clip(tiny_clip()), ahead


def compile_town_kernels() -> None:
    """Writes the smallest log of the synthetic town into a folder that is thrown away."""
    from factory.datasets.town.town import write_town
    from factory.readers.settings import TownSettings

    settings = TownSettings(cameras=("ring_front_center",), width=16, height=16, lidar_beams=1, lidar_azimuths=8)
    with tempfile.TemporaryDirectory() as folder:
        write_town(Path(folder), 1, 0, settings, threads=1)


def tiny_clip() -> Clip:
    """A straight road with the ego and a car ahead, and a car that drives beside the road; all at 5 m/s."""
    steps = np.arange(CLIP_STEPS)
    way = np.arange(-50.0, 151.0, 1.0)
    centre = np.stack([way, np.zeros_like(way), np.zeros_like(way)], axis=1)
    ring = np.array([[-50.0, -2.0], [150.0, -2.0], [150.0, 2.0], [-50.0, 2.0], [-50.0, -2.0]])
    lane = Lane("lane", ring, centre, is_intersection=False, drives_cars=True)
    ego = np.zeros((CLIP_STEPS, 11))
    ego[:, 0], ego[:, 3] = (steps - NOW) * 0.5, 5.0
    pose = np.tile(np.eye(4), (CLIP_STEPS, 1, 1))
    pose[:, 0, 3] = ego[:, 0]
    boxes = np.tile([[0.0, 0.0, 0.0, 4.5, 2.0], [0.0, 30.0, 0.0, 4.5, 2.0]], (CLIP_STEPS, 1, 1))
    boxes[..., 0] = ego[:, :1] + 20.0
    cars = AgentTracks(
        track_ids=("ahead", "beside"),
        kinds=(AgentKind.VEHICLE, AgentKind.VEHICLE),
        boxes=boxes,
        velocities=np.tile([5.0, 0.0], (CLIP_STEPS, 2, 1)),
        valid=np.ones((CLIP_STEPS, 2), bool),
        center_z=np.full((CLIP_STEPS, 2), 0.75),
        heights=np.array([1.5, 1.5]),
    )
    return Clip(
        clip_id="warm",
        dataset="warm",
        log_id="warm",
        split="train",
        start_s=0.0,
        ego_states=ego,
        world_from_ego=pose,
        agents=cars,
        road_map=RoadMap({"lane": lane}, (), (), {"lane": "rb_lane"}),
        route=Route(("lane",), ("rb_lane",), frozenset({"lane"})),
        centerline=centre,
    )


if __name__ == "__main__":  # what compiling a part starts, in a process of its own
    sys.exit(_warm(sys.argv[1]))
