"""SimScale's released layout as samples: a row for each log of 12 frames, as the public code reads it.

What a row is. `now` is the log's fourth frame, and the row's own log is the simulated one: `parent_states` are its ego
at T and T+H, `now_s` is 1.5. Label and history at 2 Hz are the frames', at 10 Hz linear between them. Pictures are the
files' own bytes. What the release does not hold stays null: scores, perturbation, what the expert asked for.
SimScale has released simulated samples alone; the human ones are those of our own export, which writes
them beside. Their log is the source log itself.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from itertools import pairwise
from pathlib import Path

import numpy as np

from factory.datasets.navsim.import_rows import (
    HISTORY_FRAMES,
    SCENE_FRAMES,
    ImportEntry,
    SceneOrigin,
    logged_label_columns,
    picture_columns,
    scene_of_frames,
    world_columns,
)
from factory.datasets.navsim.log import bytes_of, parse_frames
from factory.datasets.navsim.pickles import METRICS, RewardFile
from factory.datasets.navsim.window import RoadAhead, ego_states, road_around
from factory.files import folders_in, matching, matching_below
from factory.graph.steps import HUMAN_CANDIDATE
from factory.readers.base import BadClip
from factory.readers.pickles import load_plain
from factory.stages.rows import NO_IMAGES, label_columns
from factory.wording import shown
from tasks.render.settings import ImageSource
from tasks.reward.label_bytes import VocabularyLabels
from tasks.stages import HUMAN
from tasks.subscores import multiplier_product
from tasks.world.arrays import Array
from tasks.world.road_map import RoadMap, Route
from tasks.world.vocabulary import Vocabulary

# SimScale's rewards of one token as a sample's vocabulary labels.
#
# The pickles hold progress divided (PROGRESS_MODE=gen_gt: compliant progress over the best of it and PDM-Closed's),
# ours hold metres. Metres are not in them, so a length is chosen for PDM-Closed's: 256 m times the least multiplier,
# in whose units of 1/128 m a float16 from 1/32 up (1/8 where a trajectory has a multiplier of 1/4) comes back
# exactly, a smaller one rounded up by less than 1/8,000. `VocabularyLabels.ep("masked")`, which trainings take, is
# therefore the pickle's own; progress in metres, and that of trajectories whose multiplier is 0, is lost. EC was
# never in them.

SCORES = {public: ours for public, ours in METRICS.items() if ours not in ("ep", "score")}
PROGRESS = "ego_progress"
NOMINAL_M = 256.0


def labels_of_rewards(rewards: Mapping[str, Array], vocabulary: str, k: int) -> VocabularyLabels:
    """Of metrics (K,) by their names; vocabulary: the digest of its K trajectories.

    Raises ValueError naming the metric that is missing, or holds what the public code does not write.
    """
    if missing := [name for name in (*SCORES, PROGRESS) if name not in rewards]:
        raise ValueError(f"metric {missing[0]} is missing")
    scores = {ours: rewards[name] for name, ours in SCORES.items()}
    ep = rewards[PROGRESS]
    if len(ep) != k:
        raise ValueError(f"rewards of {len(ep)} trajectories, the vocabulary has {k}")
    if not ((ep >= 0.0) & (ep <= 1.0)).all():
        raise ValueError(f"{PROGRESS}: must lie within 0 .. 1")
    multiplier = multiplier_product(scores)
    stopped = multiplier == 0.0
    reference_m, raw_m = 0.0, np.zeros(k)
    if not (ep == 1.0).all():  # else nothing counts as progress, and nobody's is wanting
        if (ep[stopped] > 0.0).any():
            raise ValueError(f"{PROGRESS} is above 0 where a multiplier is 0: not as PROGRESS_MODE=gen_gt writes it")
        reference_m = NOMINAL_M * float(multiplier[~stopped].min(initial=1.0))
        raw_m = np.divide(ep * reference_m, multiplier, out=raw_m, where=~stopped)
    return VocabularyLabels(vocabulary, reference_m, ep_raw_m=raw_m, **scores)


DATASET = "simscale"
LICENCE = "CC BY-NC-SA 4.0 (SimScale, of nuPlan)"
FOLDER = re.compile(r"[a-z]+_reaction_(?P<who>[A-Za-z0-9_-]+)_v1\.0-(?P<round>\d+)")
HUMAN_FOLDER = re.compile(r"navtrain_(?P<who>human(_[A-Za-z0-9_]+)?)")
LOG, TOKEN = r"(?P<log>.+)-(?P<seed>[0-9a-f]{16})", r"(?P<frame>[0-9a-f]{16})"  # -00k behind, of simulated ones
REWARDS = re.compile(r"sim[a-z]+_\d+_(?P<who>[A-Za-z0-9_-]+)_v1\.0-(?P<round>\d+)\.pkl")
HUMAN_REWARDS = re.compile(HUMAN_FOLDER.pattern + r"_\d+\.pkl")
EXPERTS = {"pdm": "pdm_closed"}  # SimScale's name of an expert -> ours, where they differ
FRAME_US, SLACK_US = 500_000, 50_000


@dataclass(frozen=True)
class SimscaleFolder:
    """The samples of one expert and round, or human ones."""

    name: str
    logs: Path
    blobs: Path
    who: str  # as SimScale names the expert
    number: int | None  # the round; None: human samples

    @property
    def expert(self) -> str:
        return HUMAN if self.number is None else EXPERTS.get(self.who, self.who)

    @property
    def round(self) -> int:
        return self.number or 0

    @property
    def candidate(self) -> int:
        return HUMAN_CANDIDATE if self.number is None else self.number

    @property
    def suffix(self) -> str:
        """Of its logs' and tokens' names."""
        return "" if self.number is None else f"-{self.number:03d}"

    def names_of(self, log_id: str, frame_tokens: Sequence[str]) -> tuple[str, str]:
        """Log and token of a row."""
        seed, frame = frame_tokens
        return f"{log_id}-{seed}{self.suffix}", f"{seed if self.number is None else frame}{self.suffix}"

    @property
    def source(self) -> ImageSource:
        """Of its pictures; NAVSIM's human ones are photos."""
        return ImageSource.PHOTO if self.number is None else ImageSource.RENDER


def simscale_folders(root: Path, only: Collection[str] = ()) -> list[SimscaleFolder]:
    """What lies under the root: as moved into NAVSIM's folders (tools/move.sh), or as unpacked.

    Raises ValueError where there is none, none of that name, or two of one expert and round.
    """
    found = []
    for name, logs, blobs in _folders(root):
        if (named := FOLDER.fullmatch(name)) is not None:
            found.append(SimscaleFolder(name, logs, blobs, named["who"], int(named["round"])))
        elif (named := HUMAN_FOLDER.fullmatch(name)) is not None:
            found.append(SimscaleFolder(name, logs, blobs, named["who"], None))
    if not found:
        names = "synthetic_reaction_<expert>_v1.0-<k> or navtrain_human"
        expected = f"navsim_logs/<name> with sensor_blobs/<name>, or <name>/meta_datas, <name> being {names}"
        raise ValueError(f"root={root}: nothing of SimScale's here; expected {expected}")
    there = {part.name for part in found}
    if unknown := sorted(set(only) - there):
        raise ValueError(f"only={unknown[0]}: not under {root}; there are {', '.join(sorted(there))}")
    chosen: dict[tuple[str, int], SimscaleFolder] = {}
    for part in sorted(found, key=lambda part: (part.name, part.logs)):
        if not only or part.name in only:
            twin = chosen.setdefault((part.expert, part.round), part)
            if twin is not part:
                both = " and ".join(str(one.logs.relative_to(root)) for one in (twin, part))
                whose = f"of {part.expert} in round {part.round}"
                raise ValueError(f"root={root}: {both} are both {whose}: name one with only=")
    return list(chosen.values())


def _folders(root: Path) -> Iterator[tuple[str, Path, Path]]:
    for logs in folders_in(root / "navsim_logs"):
        yield logs.name, logs, root / "sensor_blobs" / logs.name
    for top in (root, root / "SimScale"):
        for folder in folders_in(top):
            if (logs := folder / "meta_datas").is_dir():
                yield folder.name, logs, folder / "sensor_blobs_hist"


class RewardFiles:
    """The reward files of a folder, or one of them, by expert; each is opened when the first token of it is wanted."""

    def __init__(self, path: Path, vocabulary: Vocabulary) -> None:
        """Raises ValueError where there is none."""
        self.vocabulary = vocabulary
        self._paths: dict[str, list[tuple[int, Path]]] = {}
        for file in [path] if path.is_file() else matching_below(path, "*.pkl"):
            if (named := REWARDS.fullmatch(file.name)) is not None:
                self._paths.setdefault(named["who"], []).append((int(named["round"]), file))
            elif (named := HUMAN_REWARDS.fullmatch(file.name)) is not None:
                self._paths.setdefault(named["who"], []).append((0, file))
        if not self._paths:
            raise ValueError(
                f"rewards={path}: no file simcale_<K>_<expert>_v1.0-<k>.pkl or navtrain_human_<K>.pkl here"
            )
        self._open: dict[Path, RewardFile] = {}

    def columns(self, part: SimscaleFolder, token: str) -> dict[str, object]:
        """The label columns of a token; none where no file of its expert has it. Raises BadClip.

        The file of the part's own round is asked first, then later ones: the release's may be of one round or of all.
        """
        later = sorted(entry for entry in self._paths.get(part.who, ()) if entry[0] >= part.round)
        for _, path in later:
            if path not in self._open:
                self._open[path] = RewardFile(path)
            if token in self._open[path]:
                found, vocabulary = self._open[path][token], self.vocabulary
                try:
                    return label_columns(labels_of_rewards(found, vocabulary.digest, len(vocabulary)))
                except ValueError as error:
                    raise BadClip(str(path), f"[{token!r}]", str(error)) from error
        return {}


@dataclass(frozen=True)
class SimscaleImport:
    """What is made of every log."""

    maps: Path | None = None  # nuPlan's; None: rows without a map
    pictures: bool = True
    rewards: RewardFiles | None = None

    def entries(self, parts: Sequence[SimscaleFolder]) -> list[ImportEntry]:
        """Every log of the parts, by the names of their files alone."""
        return [self._entry(part, path) for part in parts for path in matching(part.logs, "*.pkl")]

    def _entry(self, part: SimscaleFolder, path: Path) -> ImportEntry:
        named = re.fullmatch(LOG + part.suffix, path.stem)
        log, seed = (named["log"], named["seed"]) if named else (path.stem, "")
        clip_id = sha256("\x1f".join((DATASET, log, seed)).encode()).hexdigest()[:16]
        make = partial(self.row, part, path, clip_id)
        return ImportEntry(clip_id, DATASET, log, part.expert, part.round, part.candidate, make)

    def row(self, part: SimscaleFolder, path: Path, clip_id: str) -> dict[str, object]:
        """The columns of one log's row. Raises BadClip."""
        named = re.fullmatch(LOG + part.suffix, path.stem)
        if named is None:
            raise BadClip(str(path), "name", f"expected <log>-<token>{part.suffix}.pkl, as the logs of {part.name} are")
        data = bytes_of(path)
        frames = parse_frames(load_plain(data, str(path)), path).frames
        if len(frames) != SCENE_FRAMES:
            raise BadClip(str(path), "frames", f"{len(frames)}, expected {SCENE_FRAMES}: 4 of history and 8 to come")
        for i, (before, frame) in enumerate(pairwise(frames), 1):
            if abs(frame.timestamp_us - before.timestamp_us - FRAME_US) > SLACK_US:
                raise BadClip(str(path), f"frames[{i}].timestamp", "not 0.5 s after the frame before")
            if frame.boxes is None:
                raise BadClip(str(path), f"frames[{i}].anns", "missing")
        at = HISTORY_FRAMES - 1
        now, end = frames[at], frames[-1]
        token = re.fullmatch(TOKEN + part.suffix, now.token)
        if token is None:
            raise BadClip(
                str(path), f"frames[{at}].token", f"is {shown(now.token)}, expected <16 hex digits>{part.suffix}"
            )
        # A and B: a simulated log begins at B and is named after A; a human one begins at A, and its last frame is B
        tokens = (named["seed"], token["frame"]) if part.suffix else (token["frame"], end.token)
        origin = SceneOrigin(
            file=str(path),
            clip_id=clip_id,
            dataset=DATASET,
            log_id=named["log"],
            split="train",
            licence=LICENCE,
            content_digest=sha256(data).hexdigest(),
            frame_tokens=tokens,
        )
        if self.maps is None:  # the route is known by its roadblocks alone
            route = Route((), now.roadblock_ids, frozenset())
            road = RoadAhead(RoadMap({}, (), location=now.map_location), route, np.zeros((0, 3)))
        else:
            road = road_around(self.maps, now, ego_states(frames)[:, :2], now.pose, str(path), at)
        scene = scene_of_frames(frames, road, origin)
        seen: dict[str, object] = dict(NO_IMAGES)
        if self.pictures:
            seen = picture_columns(frames[:HISTORY_FRAMES], part.blobs, part.source, str(path))
        labels = {} if self.rewards is None else self.rewards.columns(part, now.token)
        return {**world_columns(scene, now.command), **logged_label_columns(scene), **seen, **labels}
