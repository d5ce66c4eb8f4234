"""NAVSIM's one-stage benchmark as a benchmark of ours: the frames of a list of tokens, each a clip of its own.

Which frames count is the public loader's choice (navsim/common/dataloader.py:24-73 at autonomousvision/navsim @
0a380a9). Two plans are compared (extended comfort) where the token before in the log is at most 0.55 s earlier
(`infer_start_adjacent_mapping`, navsim/planning/script/run_pdm_score_one_stage.py), so a clip names that one's clip.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from itertools import pairwise
from pathlib import Path

from factory.datasets.navsim.filters import Choice, Selection, table_at, wanted_windows
from factory.datasets.navsim.import_table import Entry, identity_of, import_rows
from factory.datasets.navsim.log import LogFrames, read_frames
from factory.datasets.navsim.navhard import logged_frame
from factory.datasets.navsim.reader import log_files
from factory.datasets.navsim.scenes import Origin
from factory.graph.execute import RunSummary
from factory.stages.benchmark import BENCHMARK_FILE, FORMAT
from factory.store.location import SceneFiles
from factory.store.samples import Store
from factory.store.schema import RunIdentity
from tasks.caches import user_cache
from tasks.hard_scenes import OneStageClip
from tasks.stages import HUMAN

DATASET, LICENCE = "navtest", "CC BY-NC-SA 4.0 (NAVSIM, of nuPlan)"
NO_CANDIDATE = -1
MOST_APART_US = 550_000  # between two frames whose plans are compared


@dataclass(frozen=True)
class LoneToken:
    """One frame of the benchmark."""

    token: str
    log: Path
    timestamp_us: int
    start_ms: int
    before: str | None = None  # the token up to 0.55 s earlier, if that is one of the benchmark's

    @property
    def clip_id(self) -> str:
        return clip_of(self.token)


def clip_of(token: str) -> str:
    """The id of a token's clip."""
    return sha256("\x1f".join((DATASET, token)).encode()).hexdigest()[:16]


def lone_tokens(selection: Selection, logs: Path, cache_dir: Path) -> tuple[list[LoneToken], list[str]]:
    """The frames that the selection's scene filter chooses, log by log in time, and its tokens that are no frame here.

    A log that is named and not here is left out with its tokens. Raises BadClip for a log that is broken, and
    ValueError where nothing is chosen.
    """
    chosen = selection.scene_filter
    wanted = None if chosen.tokens is None else frozenset(chosen.tokens)
    found: list[LoneToken] = []
    for name, path in log_files(logs).items():
        if chosen.log_names is not None and name not in chosen.log_names:
            continue
        table = table_at(path, cache_dir)
        starts = table.start_ms
        for at in wanted_windows(table, Choice(1, 0, 0.0, chosen), wanted):
            found.append(LoneToken(str(table.tokens[at]), path, int(table.timestamps_us[at]), int(starts[at])))
    found = found[: chosen.max_scenes]
    if not found:
        raise ValueError(f"logs={logs}: none of the frames that {selection.name} names is in the logs here")
    for i, (last, now) in enumerate(pairwise(found), start=1):
        if now.log == last.log and 0 < now.timestamp_us - last.timestamp_us <= MOST_APART_US:
            found[i] = replace(now, before=last.token)
    return found, sorted((wanted or frozenset()) - {one.token for one in found})


@dataclass
class LoneReader:
    """Reads the frames, one log open at a time."""

    maps: Path
    sensors: Path | None
    store: Store
    _log: LogFrames | None = field(default=None)

    def row(self, one: LoneToken) -> dict[str, object]:
        """The columns of one frame. Its scene is written beside. Raises BadClip."""
        if self._log is None or self._log.file != str(one.log):
            self._log = read_frames(one.log)
        digest = sha256(one.token.encode()).hexdigest()
        origin = Origin(str(one.log), one.clip_id, DATASET, self._log.name, "test", LICENCE, digest, None)
        scene, columns = logged_frame(self._log, one.token, self.maps, self.sensors, origin)
        SceneFiles(self.store.location.child("scenes")).store(OneStageClip(scene.clip))
        return columns

    def entries(self, tokens: Sequence[LoneToken]) -> list[Entry]:
        """All of them."""
        return [
            Entry(one.clip_id, DATASET, one.log.stem, HUMAN, 0, NO_CANDIDATE, partial(self.row, one)) for one in tokens
        ]


def import_navtest(
    store: Store, selection: Selection, logs: Path, sensors: Path | None, maps: Path
) -> tuple[RunSummary, str]:
    """Every frame of a selection into a store, and its benchmark; how that ended, and a line about it.

    sensors: None for frames without pictures. Raises ValueError and BadClip where nothing can begin, and what
    `import_rows` raises.
    """
    tokens, absent = lone_tokens(selection, logs, user_cache() / "navsim")
    identity = identity_of(DATASET, {"pictures": sensors is not None, "split": selection.name})
    summary = import_rows(store, identity, LoneReader(maps, sensors, store).entries(tokens))
    return summary, write_benchmark(store, tokens, absent, identity)


def write_benchmark(store: Store, tokens: Sequence[LoneToken], absent: Sequence[str], identity: RunIdentity) -> str:
    """benchmark.json of the frames that are samples; a line that says what is in it."""
    made = set(store.samples.read(["clip_id"]).column("clip_id").to_pylist())
    made &= set(SceneFiles(store.location.child("scenes")).clip_ids())
    clips: list[dict[str, object]] = []
    left_out: list[dict[str, object]] = [{"token": token, "why": "absent_token"} for token in absent]
    for one in tokens:
        named = {"clip_id": one.clip_id, "dataset": DATASET, "log_id": one.log.stem, "start_ms": one.start_ms}
        before = None if one.before is None else clip_of(one.before)
        if one.clip_id in made:
            compared = before if before in made else None
            clips.append({**named, "follow_ups": [], "tokens": [one.token], "before": compared})
        else:
            left_out.append({**named, "why": "failed", "token": one.token})
    document = {
        "format": FORMAT,
        "stages": 1,
        "settings_hash": identity.settings_hash,
        "settings": dict(identity.settings),
        "stage_versions": dict(identity.stage_versions),
        "vocabulary_digest": identity.vocabulary_digest,
        "clips": clips,
        "left_out": left_out,
    }
    store.location.write(BENCHMARK_FILE, (json.dumps(document, indent=1) + "\n").encode())
    return f"benchmark {store.location.uri}: {len(clips)} frames; left out {len(left_out)}"
