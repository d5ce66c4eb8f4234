"""What a stranger may have done to a log: kinds of damages, each put into the log in hand at a random place."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tasks.world.clip import CLIP_STEPS, STEP_S, AgentKind
from tests.chaos.damaged_logs.logs import (
    NOWHERE,
    PLACES,
    SIZES,
    VELOCITY,
    AV2Files,
    DamagedLog,
    NavsimLog,
    NuscenesLog,
    Rng,
)

ALL = "*"  # things that a damage touches: whatever its frames show
MOST_DAMAGES = 4
FRAMES_A_THING = 12  # things that are seen for less are not damaged
FAST_MPS = 6.0  # forward on average: what is turned round all its life is told by its way
APART_M = 8.0  # of things that change their names
JITTER_S = 0.01


@dataclass(frozen=True)
class Damage:
    """What was done to a log."""

    kind: str
    things: frozenset[str]  # that it touches, empty: none; ALL
    first_s: float = -np.inf  # since the log's first frame
    last_s: float = np.inf
    ego: bool = False  # the ego's own poses
    loses: bool = False  # windows may be lost inside
    quiet: bool = False  # no repair tells it: real logs look the same
    parts: frozenset[str] = frozenset()  # of the map or the lights, as repairs name them

    def holds(self, start_s: float, around_s: float) -> bool:
        """Whether the window from start_s on lies in it."""
        last_s = start_s + (CLIP_STEPS - 1) * STEP_S
        return start_s - around_s <= self.last_s and last_s + around_s >= self.first_s


# Each changes the log in hand, and says what it has done; None: this log has no place for it.

Inject = Callable[[DamagedLog, Rng], Damage | None]


def _some_thing(
    log: DamagedLog, rng: Rng, kinds: Sequence[AgentKind] = (), also: Callable[[str], bool] = lambda _: True
) -> str | None:
    known = [
        thing
        for thing, frames in sorted(log.seen().items())
        if len(frames) >= FRAMES_A_THING
        and thing not in log.touched
        and (not kinds or log.kind_of(thing) in kinds)
        and also(thing)
    ]
    if not known:
        return None
    thing = str(rng.choice(known))
    log.touched.add(thing)
    return thing


def _at(log: DamagedLog, frame: int) -> tuple[float, float]:
    return float(log.times_s[frame]), float(log.times_s[frame])


def _value(kind: str, names: Sequence[str], value: Callable[[Rng], float]) -> Inject:
    """One value of one box in one frame."""

    def inject(log: DamagedLog, rng: Rng) -> Damage | None:
        thing = _some_thing(log, rng)
        if thing is None or (names == VELOCITY and isinstance(log, AV2Files)):  # which has none
            return None
        frame = rng.choice(log.seen()[thing], 1)
        log.put(thing, frame, str(rng.choice(names)), value(rng))
        return Damage(kind, frozenset({thing}), *_at(log, int(frame[0])))

    return inject


def _of_frame(kind: str, do: Callable[[DamagedLog, int, Rng], object], **about: bool) -> Inject:
    """A frame as a whole; a window of NAVSIM's may go with it."""

    def inject(log: DamagedLog, rng: Rng) -> Damage | None:
        frame = int(rng.choice(log.frames_left()))
        t, last = _at(log, frame)
        if do(log, frame, rng) is False:
            return None
        around = (float(log.times_s[1]) if isinstance(log, NavsimLog) else STEP_S) * about.get("neighbours", False)
        ego = about.get("ego", False)
        return Damage(kind, frozenset({ALL}), t - around, last + around, ego=ego, loses=isinstance(log, NavsimLog))

    return inject


def _clock(log: DamagedLog, rng: Rng) -> Damage:
    share = float(rng.choice([0.97, 1.03]))
    log.warp(lambda t: t * share)
    return Damage("clock 3 % off", frozenset({ALL}), ego=True)


def _jitter(log: DamagedLog, rng: Rng) -> Damage:
    known, off_s = log.times_s.copy(), rng.uniform(-JITTER_S, JITTER_S, len(log.times_s))
    off_s[[0, -1]] = 0.0
    order = np.argsort(known, kind="stable")
    log.warp(lambda t: t + np.interp(t, known[order], off_s[order]))
    smoothed = isinstance(
        log, NuscenesLog
    )  # whose windows begin where its ego's drive does, some frame later or sooner
    return Damage("clock jitters", frozenset({ALL}), ego=True, quiet=True, loses=smoothed)


def _out_of_order(log: DamagedLog, rng: Rng) -> Damage:
    frame = int(rng.choice(log.frames_left()))
    t = float(log.times_s[frame])
    log.swap(frame)
    touched = frozenset[str]() if isinstance(log, AV2Files) else frozenset({ALL})  # its poses, which are put in order
    smoothed = isinstance(log, NuscenesLog)
    return Damage("frames out of order", touched, t, t + 0.5, ego=smoothed, loses=isinstance(log, NavsimLog))


def _bad_in_most(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frames = log.seen()[thing]
    bad = rng.choice(frames, int(np.ceil(rng.uniform(0.6, 0.95) * len(frames))), replace=False)
    log.put(thing, bad, str(rng.choice([*PLACES, *SIZES])), np.nan)
    return Damage("bad in most frames", frozenset({thing}), *log.life_s(thing))


def _twice(kind: str, share: float) -> Inject:
    """Under another name for that share of its life, in one piece."""

    def inject(log: DamagedLog, rng: Rng) -> Damage | None:
        thing = _some_thing(log, rng)
        if thing is None:
            return None
        name = f"{rng.integers(16**8):08x}-{thing}"
        log.touched.add(name)
        frames = log.seen()[thing]
        n = int(np.ceil(share * len(frames)))
        first = int(rng.integers(len(frames) - n + 1))
        span = log.times_s[frames[[first, first + n - 1]]].tolist()
        log.list_again(thing, name, frames[first : first + n], rng)
        return Damage(kind, frozenset({thing, name}), *span)

    return inject


def _ego_listed(kind: str, off_m: float) -> Inject:
    def inject(log: DamagedLog, rng: Rng) -> Damage:
        name = f"{rng.integers(16**8):08x}-ego"
        log.touched.add(name)
        log.list_the_ego(name, off_m * float(rng.choice([-1.0, 1.0])))
        return Damage(kind, frozenset({name}))

    return inject


def _token(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frame = int(rng.choice(log.seen()[thing]))
    name = (None, "", " ", float("nan"))[rng.integers(4)]
    return Damage("token missing", frozenset({thing}), *log.misname(thing, frame, name))


def _class(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    return Damage("class unknown", frozenset({thing}), *log.misclass(thing, int(rng.choice(log.seen()[thing]))))


def _two_things(log: DamagedLog, rng: Rng) -> tuple[str, str, np.ndarray] | None:
    """Of one kind, and frames in a row that show both, never nearer to each other than APART_M."""
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    seen, kind = log.seen(), log.kind_of(thing)

    def shared(other: str) -> np.ndarray:
        both = np.intersect1d(seen[thing], seen[other])
        runs = np.split(both, np.flatnonzero(np.diff(both) > 1) + 1)
        return max(runs, key=len)

    def is_apart(other: str) -> bool:
        frames = shared(other)
        if len(frames) < FRAMES_A_THING:
            return False
        return bool(np.hypot(*(log.place(thing, frames) - log.place(other, frames)).T).min() > APART_M)

    other = _some_thing(log, rng, [kind], is_apart)
    return None if other is None else (thing, other, shared(other))


def _names_swapped(log: DamagedLog, rng: Rng) -> Damage | None:
    found = _two_things(log, rng)
    if found is None:
        return None
    thing, other, frames = found
    first = int(rng.integers(2, len(frames) - 6))
    last = int(rng.integers(first + 3, len(frames) - 2))
    log.swap_names(thing, other, frames[first:last])
    span = log.times_s[frames[[first - 1, last]]].tolist()
    lives = np.array([log.life_s(name) for name in (thing, other)])  # what comes behind it has another name
    return Damage("identities swapped", frozenset({thing, other}), span[0], float(lives.max()))


def _name_shared(log: DamagedLog, rng: Rng) -> Damage | None:
    found = _two_things(log, rng)
    if found is None:
        return None
    thing, other, frames = found
    frame = int(rng.choice(frames[1:-1]))
    if not log.share_name(thing, other, frame):
        return None
    return Damage("token of another", frozenset({thing, other}), *_at(log, frame))


def _jump(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frames = log.seen()[thing]
    at = int(rng.integers(4, len(frames) - 4))
    log.put(thing, frames[at:], str(rng.choice(["x", "y"])), float(rng.choice([-8.0, 8.0])), moved=True)
    t = log.times_s[frames]
    return Damage("identity jumps 8 m", frozenset({thing}), float(t[at - 1]), float(t[-1]))


def _spike(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frame = rng.choice(log.seen()[thing], 1)
    log.put(thing, frame, str(rng.choice(["x", "y"])), float(rng.choice([-1, 1]) * rng.uniform(8.0, 60.0)), moved=True)
    return Damage("spike", frozenset({thing}), *_at(log, int(frame[0])))


def _turned(kind: str, least: int, most: int | None) -> Inject:
    """As many frames in a row, or up to 40 % of its life; NAVSIM: of what drives.

    A window of NAVSIM's may show a thing that stands for two frames, and neither tells which of them is right.
    """

    def inject(log: DamagedLog, rng: Rng) -> Damage | None:
        slowest = FAST_MPS if isinstance(log, NavsimLog) else -np.inf
        kinds = AgentKind.VEHICLE, AgentKind.BICYCLE
        thing = _some_thing(log, rng, kinds, lambda name: log.speed_mps(name) > slowest)
        if thing is None:
            return None
        frames = log.seen()[thing]
        n = int(rng.integers(least, max(int(0.4 * len(frames)), least + 1) if most is None else most + 1))
        at = int(rng.integers(0, len(frames) - n + 1))
        log.turn(thing, frames[at : at + n])
        t = log.times_s[frames[at : at + n]]
        return Damage(kind, frozenset({thing}), float(t[0]), float(t[-1]))

    return inject


def _turned_for_life(log: DamagedLog, rng: Rng) -> Damage | None:
    kinds = AgentKind.VEHICLE, AgentKind.BICYCLE
    thing = _some_thing(log, rng, kinds, lambda name: log.speed_mps(name) > FAST_MPS)
    if thing is None:
        return None
    log.turn(thing, log.seen()[thing])
    return Damage("heading off by pi for life", frozenset({thing}), *log.life_s(thing))


def _repeated(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None:
        return None
    frame = int(rng.choice(log.seen()[thing]))
    return Damage("row twice", frozenset({thing}), *_at(log, frame)) if log.repeat(thing, frame) else None


def _misstamped(log: DamagedLog, rng: Rng) -> Damage | None:
    thing = _some_thing(log, rng)
    if thing is None or not isinstance(log, AV2Files):
        return None  # stamps are the frames', not the boxes'
    frame = int(rng.choice(log.seen()[thing][1:-1]))
    log.misstamp(thing, frame, [0, -1, 9 * 10**18][rng.integers(3)])
    return Damage("box of no time", frozenset({thing}), *_at(log, frame))


# The map and the lights.


def _of_map(
    kind: str, parts: Callable[[DamagedLog], Sequence[str]], do: Callable[[DamagedLog, str, Rng], object]
) -> Inject:
    def inject(log: DamagedLog, rng: Rng) -> Damage | None:
        if not (known := parts(log)):
            return None
        part = str(rng.choice(sorted(known)))
        if do(log, part, rng) is False:
            return None
        return Damage(kind, frozenset(), parts=frozenset({part}))

    return inject


def _lanes_but_navsim(log: DamagedLog) -> Sequence[str]:
    """nuPlan's cities come whole from one place, a lane of theirs that is none is refused."""
    return () if isinstance(log, NavsimLog) else log.lanes()


def _with_nan(log: DamagedLog, lane: str, rng: Rng) -> None:
    def change(points: np.ndarray) -> np.ndarray:
        points[rng.integers(len(points)), rng.integers(2)] = [np.nan, np.inf, 1e12][rng.integers(3)]
        return points

    log.change_lane(lane, change)


def _light_nowhere(log: DamagedLog, rng: Rng) -> Damage:
    log.light_nowhere()
    return Damage("light of no lane", frozenset(), parts=frozenset({NOWHERE}))


def _misstated(log: DamagedLog, rng: Rng) -> Damage | None:
    found = log.misstate(rng)
    if found is None:
        return None
    lane, first_s, last_s = found
    return Damage("light of no state", frozenset(), first_s, last_s, parts=frozenset({lane}))


VALUES: dict[str, tuple[Sequence[str], Callable[[Rng], float]]] = {
    "size negative": (SIZES, lambda rng: -float(rng.uniform(0.1, 5.0))),
    "size NaN": (SIZES, lambda _: np.nan),
    "size infinite": (SIZES, lambda rng: float(rng.choice([-np.inf, np.inf]))),
    "size huge": (SIZES, lambda rng: float(10.0 ** rng.uniform(2.1, 9.0))),
    "place NaN": (PLACES, lambda _: np.nan),
    "place infinite": (PLACES, lambda rng: float(rng.choice([-np.inf, np.inf]))),
    "place 1e12": (PLACES, lambda rng: float(rng.choice([-1e12, 1e12]))),
    "heading NaN": (("heading",), lambda _: np.nan),
    "heading infinite": (("heading",), lambda rng: float(rng.choice([-np.inf, np.inf]))),
    "heading 1e12": (("heading",), lambda rng: float(rng.choice([-1e12, 1e12]))),
    "velocity NaN": (VELOCITY, lambda _: np.nan),
    "velocity infinite": (VELOCITY, lambda rng: float(rng.choice([-np.inf, np.inf]))),
    "velocity 1e12": (VELOCITY, lambda _: 1e12),
}
ONE_FRAME: dict[str, Inject] = {  # of one thing, or of all
    **{kind: _value(kind, *value) for kind, value in VALUES.items()},
    "token missing": _token,
    "token of another": _name_shared,
    "class unknown": _class,
    "spike": _spike,
    "heading off by pi": _turned("heading off by pi", 1, 3),
    "row twice": _repeated,
    "box of no time": _misstamped,
    "ego pose NaN": _of_frame("ego pose NaN", lambda log, frame, _: log.put_ego(frame, np.nan), ego=True),
    "ego spike": _of_frame(
        "ego spike", lambda log, frame, rng: log.put_ego(frame, rng.choice([-30.0, 30.0, 1e12])), ego=True
    ),
    "frame malformed": _of_frame("frame malformed", lambda log, frame, rng: log.malform(frame, rng)),
    "light of no state": _misstated,
    "frames out of order": _out_of_order,
    "stamp as before": _of_frame(
        "stamp as before", lambda log, frame, _: log.stamp_as_before(frame), ego=True, neighbours=True
    ),
    "frame twice": _of_frame("frame twice", lambda log, frame, _: log.repeat_frame(frame), ego=True, neighbours=True),
    "frame missing": _of_frame("frame missing", lambda log, frame, _: log.drop_frame(frame), ego=True),
}
LONGER: dict[str, Inject] = {
    "bad in most frames": _bad_in_most,
    "listed twice": _twice("listed twice", 1.0),
    "listed twice for a third": _twice("listed twice for a third", 0.33),
    "ego among agents": _ego_listed("ego among agents", 0.0),
    "ego among agents, 0.8 m off": _ego_listed("ego among agents, 0.8 m off", 0.8),
    "identity jumps 8 m": _jump,
    "identities swapped": _names_swapped,
    "heading off by pi in a run": _turned("heading off by pi in a run", 4, None),
    "heading off by pi for life": _turned_for_life,
    "crossing bow-tied": _of_map("crossing bow-tied", lambda log: log.crossings(), lambda log, key, _: log.tie(key)),
    "crossing empty": _of_map(
        "crossing empty",
        lambda log: () if isinstance(log, NavsimLog) else log.crossings(),
        lambda log, key, _: log.change_crossing(key, lambda points: points[:0]),
    ),
    "boundary reversed": _of_map(
        "boundary reversed", lambda log: log.lanes(), lambda log, key, _: log.reverse_boundary(key)
    ),
    "lane points doubled": _of_map(
        "lane points doubled",
        lambda log: log.lanes(),
        lambda log, key, _: log.change_lane(key, lambda points: np.repeat(points, 2, axis=0)),
    ),
    "lane of one point": _of_map(
        "lane of one point",
        _lanes_but_navsim,
        lambda log, key, _: log.change_lane(key, lambda points: points[:1]),
    ),
    "lane with NaN": _of_map("lane with NaN", _lanes_but_navsim, _with_nan),
    "area empty": _of_map(
        "area empty", lambda log: log.areas(), lambda log, key, _: log.change_area(key, lambda points: points[:0])
    ),
    "light of no lane": _light_nowhere,
    "clock jitters": _jitter,
    "clock 3 % off": _clock,
}
INJECTIONS = {**ONE_FRAME, **LONGER}
LAST = ("stamp as before", "frames out of order", "frame twice", "frame missing", "clock jitters", "clock 3 % off")
AS_IT_WAS = ("crossing bow-tied", "boundary reversed", "lane points doubled", "light of no lane")  # read so
TURNS_THE_FRAMES = ("stamp as before", "frames out of order", "frame twice", "frame missing")  # of a log one
LOSES = ("ego pose NaN", "ego spike", "frame malformed", *TURNS_THE_FRAMES)  # a window of NAVSIM's
OFF_CLOCK = "clock 3 % off"


def injected(log: DamagedLog, rng: Rng, *, short: bool) -> tuple[Damage, ...]:
    """Two to four kinds, in place; short: one, of one frame.

    Of those that lose windows one at most, and one that gives the frames other places.
    """
    kinds = list(ONE_FRAME if short else INJECTIONS)
    order = [str(kind) for kind in rng.permutation(kinds)]
    n = 1 if short else int(rng.integers(2, MOST_DAMAGES + 1))
    chosen, damages = list[str](), list[Damage]()
    for kind in order if short else sorted(order[:n], key=lambda kind: LAST.index(kind) if kind in LAST else -1):
        once = LOSES if isinstance(log, NavsimLog) else TURNS_THE_FRAMES
        if len(damages) == n or (kind in once and any(other in once for other in chosen)):
            continue
        chosen.append(kind)
        damage = INJECTIONS[kind](log, rng)
        if damage is not None:
            damages.append(damage)
    return tuple(damages)
