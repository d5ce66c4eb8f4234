"""`python -m planners train_traffic clips=<whose logs> out=<file>`: fit a traffic policy to logs.

    python -m planners train_traffic clips=av2 clips.root=/data/av2/val out=runs/traffic.npz
    python -m factory.run traffic=learned traffic.weights=runs/traffic.npz ...

Every clip gives two scenes, at T and at T+H. The network is fitted in rounds: to lessons of vehicles that drive with
noise, and then to those of vehicles that it drives itself. Which logs it saw, and with which settings, stands in the
file. Minutes on one core; the same command, the same file. docs/realism.md has numbers.
"""

import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from factory import __version__
from factory.config.compose import compose, fill
from factory.config.run import refuse_missing_root
from factory.readers.base import BadClip, ClipIndex, ClipReader
from factory.readers.validate import read_clip
from factory.setup.settings import open_reader
from planners.command import command
from planners.traffic.fit import Network, NetworkSettings, fit, held_out_error
from planners.traffic.lessons import Lessons, joined, lessons_of
from tasks.kernels.compiled import write_whole
from tasks.rollout.learned.imitation import NetworkWeights, weights_file
from tasks.rollout.settings import TrafficSettings
from tasks.rollout.simulate import TrafficScene, prepare_traffic
from tasks.world.chance import stream
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS, NOW, Clip, Scene, scene_of_clip

PREPARED = TrafficSettings(mode="learned", policy="none:asked")  # scenes are prepared, no policy is asked


@dataclass(frozen=True)
class TrainTraffic:
    """What is fitted to what."""

    clips: dict[str, Any]  # the reader, and which clips of its data
    out: str = "runs/traffic.npz"  # the file of weights
    without: tuple[str, ...] = ()  # logs that are left out of the fit; its errors on them are told
    rounds: int = 3  # the first of lessons that are driven with noise, the others by the network
    network: NetworkSettings = field(default_factory=NetworkSettings)
    seed: int = 0
    limit: int | None = None  # the first so many clips only

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds={self.rounds}: at least one is needed")
        if self.limit is not None and self.limit < 1:
            raise ValueError(f"limit={self.limit}: must be positive, or null for no bound")


def train_all(settings: TrainTraffic) -> Path:
    """Fit, and write the file. Raises ConfigError, ValueError where there is nothing to learn, OSError."""
    refuse_missing_root(settings.clips)
    torch.set_num_threads(1)  # the same file whatever the machine's cores
    reader, index = open_reader(settings.clips)
    clips = list(_clips(reader, index, settings))
    seen = [ready for clip, ready in clips if clip.log_id not in settings.without]
    unseen = [ready for clip, ready in clips if clip.log_id in settings.without]
    torch.manual_seed(settings.seed)
    network = Network(settings.network)
    learned: list[Lessons] = []
    for number in range(settings.rounds):
        weights = network.weights if number else None
        learned.append(_lessons(seen, weights, settings.seed, number))
        if not len(learned[0]):
            raise ValueError("no vehicle drives on a lane in these clips: there is nothing to learn")
        loss = fit(network, joined(learned), settings.network, settings.seed + number)
        told = f"round {number + 1}: {sum(map(len, learned)):,} lessons, loss {loss:.4f}"
        if unseen:
            held_out = _lessons(unseen, network.weights, settings.seed, settings.rounds)
            off = ("-" if math.isnan(error) else f"{error:.2f}" for error in held_out_error(network, held_out))
            told += "; on {:,} of logs left out: {} m/s2, {} m beside in 1 s".format(len(held_out), *off)
        print(told, flush=True)
    record = {
        "version": __version__,
        "logs": sorted({f"{clip.dataset}/{clip.log_id}" for clip, _ in clips if clip.log_id not in settings.without}),
        "rounds": settings.rounds,
        "seed": settings.seed,
        **asdict(settings.network),
    }
    out = Path(settings.out)
    write_whole(out, weights_file(network.weights, json.dumps(record)))
    return out


def _clips(reader: ClipReader, index: ClipIndex, settings: TrainTraffic) -> Iterator[tuple[Clip, list[TrafficScene]]]:
    """Every clip that can be read, and its two scenes."""
    unknown = set(settings.without) - {ref.log_id for ref in index.refs}
    if unknown:
        raise ValueError(f"without: there is no log {', '.join(sorted(unknown))}")
    for ref in index.refs[: settings.limit]:
        try:
            clip = read_clip(reader, ref)
        except BadClip as error:
            print(f"left out: {error}", flush=True)
            continue
        yield clip, [prepare_traffic(scene, PREPARED) for scene in _scenes(clip)]


def _scenes(clip: Clip) -> Iterator[Scene]:
    """The log at T and at T+H."""
    for step in (NOW, NOW + HORIZON_STEPS):
        history = clip.ego_states[step - HISTORY_STEPS : step + 1]
        yield replace(scene_of_clip(clip), step=step, ego_history=history)


def _lessons(
    scenes: Sequence[Sequence[TrafficScene]], weights: NetworkWeights | None, seed: int, number: int
) -> Lessons:
    ready = [one for of_clip in scenes for one in of_clip]
    rng = (stream(seed, one.scene.clip.clip_id, "traffic", number * 1000 + one.scene.step) for one in ready)
    return joined([lessons_of(one.scene, one, weights, chance) for one, chance in zip(ready, rng)])


def settings_of(argv: Sequence[str]) -> TrainTraffic:
    """The settings of a command line. Raises ConfigError."""
    return fill(TrainTraffic, compose("train_traffic", argv, TrainTraffic), "")


def _answer(argv: Sequence[str]) -> None:
    start = time.perf_counter()
    out = train_all(settings_of(argv))
    print(f"{out}: traffic=learned traffic.weights={out} ({time.perf_counter() - start:.0f} s)")


main = command(_answer, TrainTraffic)
