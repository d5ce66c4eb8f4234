"""A damaged log against the log as it is: clips to the byte, what repairs say, rows of whole runs."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from shapely.geometry import Polygon

from factory.readers.base import BadClip, ClipReader
from factory.run import main as run
from factory.store.samples import Store
from tasks.world.clip import STEP_S, AgentTracks, Clip
from tasks.world.repair.records import Repair
from tasks.world.repair.tracks import EGO
from tests.chaos.damaged_logs.damages import ALL, AS_IT_WAS, OFF_CLOCK, TURNS_THE_FRAMES, Damage, injected
from tests.chaos.damaged_logs.logs import DamagedLog, NavsimLog, NuscenesLog

FAR_M, FAR_RAD, FAR_MPS = 1.0, 0.5, 5.0  # from where a thing is in truth: more is no repair


@dataclass(frozen=True)
class DataSet:
    """Logs of one format."""

    logs: tuple[Path, ...]
    opened: Callable[[Path], DamagedLog]
    reader: Callable[[Path, Path], ClipReader]  # of a root that `write` gave, and of the log that it is a copy of
    words: Callable[[Path, Path], Sequence[str]]  # for a run on them


@dataclass
class Told:
    """What came of the damages of one kind; windows."""

    damages: int = 0
    inside: int = 0
    outside: int = 0  # of all damages of the log
    repaired: int = 0  # of those inside, read with a repair that the log as it is has not
    lost_inside: int = 0
    crashes: int = 0  # logs
    lost_outside: int = 0
    unequal_outside: int = 0
    unequal_others: int = 0  # inside, of things that no damage touches
    silent: int = 0  # inside, things that differ where no repair says so
    wrong: int = 0  # inside, things that are not where they are in truth

    @property
    def is_fine(self) -> bool:
        return not any(getattr(self, name) for name in FAULTS)


FAULTS = ("crashes", "lost_outside", "unequal_outside", "unequal_others", "silent", "wrong")


def read_all(reader: ClipReader) -> tuple[dict[int, Clip], list[str]]:
    """Clips by the milliseconds at which they begin, and what was said of the others."""
    index = reader.index()
    said, clips = [*index.broken.values(), *index.skipped_logs.values()], {}
    for ref in index.refs:
        try:
            clips[ref.start_ms] = reader.read(ref)
        except BadClip as error:
            said.append(str(error))
    return clips, said


def same(a: Any, b: Any) -> bool:
    """To the byte."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return bool(a == b)


# nuScenes' ego is the smooth drive nearest to all of its log, on a clock that all of it tells: where a frame goes, the
# sign of a lost message of 20 ms may go with it.
SMOOTHED, SLACK = ("ego_states", "world_from_ego"), 0.3
APART = ("agents", "repairs", "content_digest")  # fields of a clip that are looked at apart, or are to differ
OF_MAP = ("road_map", "route", "centerline", "lights")


def same_but_agents(a: Clip, b: Clip, slack: float, apart: Sequence[str] = ()) -> bool:
    """Ego, map, route, lights, names; slack: of the ego's states and poses, in their units; apart: fields to leave."""
    names = {f.name for f in fields(Clip)} - {*APART, *apart}
    if slack:
        names -= {*SMOOTHED}
        near = (np.abs(getattr(a, name) - getattr(b, name)).max() <= slack for name in SMOOTHED)
        return all(near) and all(same(getattr(a, name), getattr(b, name)) for name in names)
    return all(same(getattr(a, name), getattr(b, name)) for name in names)


LANE_LINES = ("ring", "centerline", "left_boundary", "right_boundary")


def differing_parts(a: Clip, b: Clip) -> set[str]:
    """Lanes that are of another shape, and those whose light is another; links between lanes are not looked at."""
    one, other = a.road_map.lanes, b.road_map.lanes
    shapes = {
        lane
        for lane in {*one, *other}
        if not {lane} <= one.keys() & other.keys()
        or not all(same(getattr(one[lane], name), getattr(other[lane], name)) for name in LANE_LINES)
    }
    lights = [dict(zip(clip.lights.lane_ids, clip.lights.states.T.copy())) for clip in (a, b)]
    return shapes | {lane for lane in {*lights[0], *lights[1]} if not same(*(found.get(lane) for found in lights))}


def crossings_apart(a: Clip, b: Clip) -> int:
    """How many of b's crossings cover something that none of a's covers."""
    found = [Polygon(ring) for ring in a.road_map.crossings]
    return sum(
        all(one.symmetric_difference(Polygon(ring)).area > 1e-6 for one in found) for ring in b.road_map.crossings
    )


def _of_thing(agents: AgentTracks, thing: str) -> tuple[Any, ...] | None:
    if thing not in agents.track_ids:
        return None
    n = agents.track_ids.index(thing)
    columns = agents.boxes[:, n], agents.velocities[:, n], agents.valid[:, n], agents.center_z[:, n]
    return agents.kinds[n], agents.heights[n], *(column.copy() for column in columns)


def differing(a: AgentTracks, b: AgentTracks) -> set[str]:
    """Things that are not the same to the byte."""
    return {t for t in {*a.track_ids, *b.track_ids} if not same(_of_thing(a, t), _of_thing(b, t))}


def is_far(found: AgentTracks, thing: str, truth: AgentTracks, true_thing: str, *, as_long: bool) -> bool:
    """Whether a thing is away from where it is in truth at a step that both have.

    as_long: where both are seen at the same steps, in one piece. As NAVSIM's public code has it, a thing of which one
    frame of the 4 s is left stands there for all of them.
    """
    if not {thing} <= {*found.track_ids} or not {true_thing} <= {*truth.track_ids}:
        return False
    n, m = found.track_ids.index(thing), truth.track_ids.index(true_thing)
    both = found.valid[:, n] & truth.valid[:, m]
    if as_long and (f"{thing}#2" in found.track_ids or not np.array_equal(found.valid[:, n], truth.valid[:, m])):
        return False
    off = found.boxes[both, n] - truth.boxes[both, m]
    turned = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    sped = np.hypot(*(found.velocities[both, n] - truth.velocities[both, m]).T)
    far = np.hypot(*off[:, :2].T) > FAR_M, turned > FAR_RAD, sped > FAR_MPS, np.abs(off[:, 3:]).max(axis=1) > FAR_M
    return bool(np.any(far))


def thing_of(name: str) -> str:
    """What a piece of it is called after."""
    return name.partition("#")[0]


def _tells(repair: Repair, thing: str, inside: Sequence[Damage]) -> bool:
    """Whether a repair is of the thing or names it, or is of a frame, the ego or a nameless box at a damage's time.

    Of two things with one token the repair names one.
    """
    together = {name for d in inside if d.kind == "token of another" and thing in d.things for name in d.things}
    if thing_of(repair.thing) in {thing, *together} or thing in repair.was:
        return True
    last_s = max(repair.time_s, repair.until_s)
    nameless = repair.thing in ("", EGO) or repair.what == "token" or repair.thing.startswith("frame ")
    return nameless and any(
        np.isnan(repair.time_s) or (d.first_s - 1.5 * STEP_S <= last_s and repair.time_s <= d.last_s + STEP_S)
        for d in inside
        if d.things & {thing, ALL}
    )


def repaired_already(clip: Clip) -> set[str]:
    """Things that the log as it is has repairs of, and those that these name."""
    said = [(thing_of(repair.thing), f"{repair.was} {repair.now}") for repair in clip.repairs]
    return {thing for thing, _ in said} | {t for t in clip.agents.track_ids if any(t in words for _, words in said)}


@dataclass
class Trial:
    """One damaged log, read."""

    damages: tuple[Damage, ...]
    findings: list[str] = field(default_factory=list)


def _map_faults(clip: Clip, truth: Clip, damages: Sequence[Damage], new: set[Repair]) -> tuple[list[str], list[str]]:
    """What no damage touches and differs, and what differs and is not told; damages: of the map or lights, inside."""
    parts = frozenset[str]().union(*(d.parts for d in damages))
    unlike = differing_parts(clip, truth)
    gone = crossings_apart(clip, truth)
    others = [f"lanes or lights {sorted(unlike - parts)}"] if unlike - parts else []
    if gone > sum(d.kind == "crossing empty" for d in damages):
        others.append(f"{gone} crossings")
    told = {repair.thing for repair in new}
    silent = sorted(part for part in unlike & parts if part not in told)
    if gone and not any(repair.what == "crossing" for repair in new):
        silent.append("crossing")
    return others, silent


def tried(data: DataSet, path: Path, golden: dict[int, Clip], seed: int, table: dict[str, Told]) -> Trial:
    """One damaged log, counted into the table by kind and, once, under ALL. Odd seeds: a single short damage."""
    rng, log = np.random.default_rng(seed), data.opened(path)
    log.touched |= {name for clip in golden.values() for name in repaired_already(clip)}
    damages = injected(log, rng, short=seed % 2 == 1)
    trial = Trial(damages)
    rows = [table.setdefault(kind, Told()) for kind in {ALL, *(damage.kind for damage in damages)}]
    of_kind = dict(zip({ALL, *(damage.kind for damage in damages)}, rows))
    for damage in damages:
        of_kind[damage.kind].damages += 1
    of_kind[ALL].damages += len(damages)

    def note(name: str, what: str = "", rows: Sequence[Told] = rows) -> None:
        for row in rows:
            setattr(row, name, getattr(row, name) + 1)
        if name in FAULTS:
            trial.findings.append(f"{name} {what}")

    with tempfile.TemporaryDirectory() as folder:
        try:
            found, said = read_all(data.reader(log.write(Path(folder)), path))
        except Exception as error:  # a crash is what is looked for
            found, said = {}, []
            note("crashes", f"{type(error).__name__}: {error}")
    smoothed = isinstance(log, NuscenesLog) and any(d.ego or d.kind in TURNS_THE_FRAMES for d in damages)
    off_clock = any(damage.kind == OFF_CLOCK for damage in damages)
    for start_ms, truth in golden.items():
        inside = [d for d in damages if d.holds(start_ms / 1000, log.around_s)]
        here = [of_kind[ALL], *(of_kind[kind] for kind in {d.kind for d in inside})]
        clip, at = found.get(start_ms), f"at {start_ms} ms:"
        note("inside" if inside else "outside", rows=here if inside else rows)
        if clip is None:
            if not inside:
                note("lost_outside", f"{at} {'; '.join(said)}")
            else:
                note("lost_inside", rows=here)
                if not off_clock and not any(damage.loses for damage in inside):
                    trial.findings.append(f"lost inside {at} {'; '.join(said)}")
            continue
        of_map = [d for d in inside if d.parts]
        touched = [d for d in of_map if d.kind not in AS_IT_WAS]
        unlike = differing(clip.agents, truth.agents)
        crossed = any(d.kind == "crossing bow-tied" for d in of_map)  # begins at another corner
        apart = OF_MAP if touched or crossed else ()
        rest = same_but_agents(clip, truth, SLACK * smoothed, apart)
        if not inside:
            if unlike or not rest:
                note("unequal_outside", f"{at} {sorted(unlike)}, rest {rest}")
            continue
        new = set(clip.repairs) - set(truth.repairs)
        if new:
            note("repaired", rows=here)
        if off_clock:
            if not any(repair.what == "clock" for repair in new) and not isinstance(log, NavsimLog):
                note("silent", f"{at} clock", here)
            continue
        things = frozenset[str]().union(*(damage.things for damage in inside))
        others = set() if ALL in things else {t for t in unlike if thing_of(t) not in things}
        if others or not (rest or ALL in things):
            note("unequal_others", f"{at} {sorted(others)}, rest {rest}", here)
        if apart:
            unlike_parts, silent_parts = _map_faults(clip, truth, of_map, new)
            for what in () if ALL in things else unlike_parts:
                note("unequal_others", f"{at} {what}", here)
            for what in silent_parts:
                note("silent", f"{at} {what}", here)
        quiet = any(damage.quiet for damage in inside)
        for thing in sorted(unlike - others):
            if not quiet and not any(_tells(repair, thing_of(thing), inside) for repair in new):
                note("silent", f"{at} {thing}", here)
            true_thing = next((t for t in truth.agents.track_ids if thing.endswith(t)), thing)
            if is_far(clip.agents, thing, truth.agents, true_thing, as_long=isinstance(log, NavsimLog)):
                note("wrong", f"{at} {thing}", here)
        if not rest and not quiet and not any(_tells(repair, ALL, inside) for repair in new):
            note("silent", f"{at} the ego", here)
        if np.hypot(*(clip.ego_states - truth.ego_states)[:, :2].T).max() > FAR_M:
            note("wrong", f"{at} the ego", here)
    return trial


def damaged(data: DataSet, seeds: Sequence[int], say: Callable[[str], object] = print) -> dict[str, Told]:
    """Kind -> what came of it, of one log a seed, and under ALL of all; findings are said."""
    golden: dict[Path, dict[int, Clip]] = {}
    table: dict[str, Told] = {}
    for seed in seeds:
        path = data.logs[seed % len(data.logs)]
        if path not in golden:
            with tempfile.TemporaryDirectory() as folder:
                golden[path], said = read_all(data.reader(data.opened(path).write(Path(folder)), path))
            assert golden[path] and not said, said
        trial = tried(data, path, golden[path], seed, table)
        if trial.findings:
            say(f"seed {seed}, {path.name}: {', '.join(f'{d.kind} {d.first_s:.1f}' for d in trial.damages)}")
            for finding in trial.findings:
                say(f"    {finding[:300]}")
    return table


SMALL = ("experts=[human,pdm_closed]", "rounds=1", "render=none", "reward.labels=none", "vocabulary.k=256")
SEES_THE_LOG = "content_digest"  # the column that is to differ: of the log's files


def rows_of(words: Sequence[str], out: Path) -> dict[tuple[int, str], dict[str, str]]:
    """Samples of a small run, by milliseconds at which the clip begins and attempt; values as text."""
    if code := run([*words, "clips.split=train", "clips.stride_s=1.0", "executor=local", *SMALL, f"out={out}"]):
        raise RuntimeError(f"the run {' '.join(words)} ended with {code}")
    rows = Store(str(out)).samples.read().to_pylist()
    return {
        (round(1000 * row["clip_start_s"]), row["attempt_id"]): {
            name: repr(value) for name, value in row.items() if name != SEES_THE_LOG
        }
        for row in rows
    }


def unequal_rows(data: DataSet, seed: int) -> tuple[int, list[str]]:
    """Rows of a run on a log that lie outside of its one damage, and those that the run on the damaged log has not.

    Not what is done to nuScenes' ego, which is smoothed as a whole.
    """
    path = data.logs[seed % len(data.logs)]
    rng, as_it_is = np.random.default_rng(seed), data.opened(path)
    while True:
        log = data.opened(path)
        damages = injected(log, rng, short=True)
        if not (isinstance(log, NuscenesLog) and any(damage.ego for damage in damages)):
            break
    with tempfile.TemporaryDirectory() as folder:
        places = [Path(folder) / name for name in ("a", "b")]
        for place in places:
            place.mkdir()
        truth, found = (
            rows_of(data.words(one.write(place), path), Path(folder) / f"out-{place.name}")
            for one, place in zip((as_it_is, log), places)
        )
    outside = [key for key in truth if not any(d.holds(key[0] / 1000, log.around_s) for d in damages)]
    wrong = []
    for key in outside:
        if key not in found:
            wrong.append(f"{key}: no such row")
        elif columns := [name for name in truth[key] if truth[key][name] != found[key][name]]:
            wrong.append(f"{key}: {', '.join(columns)}")
    return len(outside), wrong
