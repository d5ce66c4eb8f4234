"""What a reader is, and how a clip is named before anything of it is opened."""

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Protocol

from factory.wording import one_line
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import AgentTracks, Camera, Clip
from tasks.world.road_map import TrafficLights

SPLITS = ("train", "val", "test")
MAX_FILE_BYTES = 1 << 30  # of a file that is read whole
MOST_SAID = 1000  # characters of what is wrong: it may quote the file


class BadClip(Exception):
    """The input is broken: says which file, which field, and how to fix it."""

    def __init__(self, file: str, field: str, problem: str) -> None:
        field, problem = _cut(field), _cut(problem)
        super().__init__(f"{file}: {field}: {problem}")
        self.file, self.field, self.problem = file, field, problem

    def __reduce__(self) -> tuple[type["BadClip"], tuple[str, str, str]]:
        return type(self), (self.file, self.field, self.problem)


class Unreadable(BadClip):
    """The input is broken in a way that its reader did not foresee: it raised something else, which is the cause."""


def _cut(text: str) -> str:
    return text if len(text) <= MOST_SAID else f"{text[:MOST_SAID]}..."


@contextmanager
def failing_as(file: str) -> Iterator[None]:
    """Around what a reader does with one file, folder or clip: whatever it raises over that is that one's failure.

    Raises BadClip, Unreadable, and the OSError of another place, such as a full disk under the cache.
    """
    try:
        yield
    except BadClip:
        raise
    except Exception as error:
        if isinstance(error, OSError) and not _is_of(error, file):
            raise
        problem = f"cannot be read: {type(error).__name__}: {one_line(error)}"
        raise Unreadable(file, "reader", problem) from error


def _is_of(error: OSError, file: str) -> bool:
    if type(error) is OSError and error.errno is None:  # Arrow's, of a file that it does not understand
        return True
    return isinstance(error.filename, str) and Path(error.filename).is_relative_to(file)


def bytes_of(path: Path) -> bytes:
    """All of a file. Raises BadClip where it cannot be read or is larger than MAX_FILE_BYTES."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BadClip(str(path), "size", f"more than {MAX_FILE_BYTES} bytes")
        return path.read_bytes()
    except OSError as error:
        raise BadClip(str(path), "file", f"cannot be read: {error.strerror}") from error


@dataclass(frozen=True, order=True)
class ClipRef:
    """Names one window of one log."""

    dataset: str
    log_id: str
    start_ms: int  # start of the window, milliseconds since the log's first annotated instant
    window: str = "1.5+8.0s@10Hz"

    @property
    def clip_id(self) -> str:
        """16 hex digits, known without opening a sensor file."""
        key = "\x1f".join((self.dataset, self.log_id, str(self.start_ms), self.window))
        return hashlib.sha256(key.encode()).hexdigest()[:16]


def split_of(log_id: str, val_percent: int = 10, test_percent: int = 10) -> str:
    """train, val or test by the hash of the log id, so that windows of one log never part."""
    bucket = int(hashlib.sha256(log_id.encode()).hexdigest()[:8], 16) % 100
    if bucket < test_percent:
        return "test"
    return "val" if bucket < test_percent + val_percent else "train"


@dataclass(frozen=True)
class ClipIndex:
    """What a root holds: windows to read, windows filtered (reason -> count), logs skipped or broken."""

    refs: tuple[ClipRef, ...]
    dropped: Mapping[str, int] = field(default_factory=dict)  # windows filtered, by reason
    skipped_logs: Mapping[str, str] = field(default_factory=dict)  # log id -> reason (e.g. no annotations)
    broken: Mapping[ClipRef, str] = field(default_factory=dict)  # unreadable logs: become failed outcomes


class ClipReader(Protocol):
    """Reads one data set. Readers from a user's own package satisfy it too."""

    @property
    def name(self) -> str:
        """Of the data set; part of every clip id."""
        ...

    def index(self) -> ClipIndex:
        """All windows under the root, in a stable order. Raises ValueError where the root is not this data set."""
        ...

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        ...


class Painter(Protocol):
    """Draws the world of a reader's clips as it is simulated, from anywhere: pictures without a scene."""

    def rig(self, clip: Clip, width: int, height: int) -> tuple[Camera, ...]:
        """The clip's cameras, of some size, or the painter's own of this size where it has none."""
        ...

    def lights(self, clip: Clip, n_steps: int) -> TrafficLights:
        """The clip's lights over `n_steps` steps from its first one."""
        ...

    def pictures(
        self, clip: Clip, cameras: Sequence[Camera], agents: AgentTracks, step: int, state: Array
    ) -> tuple[Array, list[Bytes]]:
        """The pose (4, 4) of an ego in a state (11,), and what each camera sees from there at a step of the clip.

        agents: who is there, in the steps of the clip.
        """
        ...


def painter_of(reader: ClipReader) -> Painter | None:
    """Who paints the reader's clips; None where nobody does."""
    return getattr(reader, "painter", None)


# Which split a log belongs to by its data set's own word; None where the data set has none.
#
# Only then does the hash of the log's id decide (`factory.readers.base.split_of`). A folder that is named after a
# split wins over what is known of single logs: whoever sorted the logs said so.

WAYMO = {"training": "train", "validation": "val", "testing": "test"}
FOLDERS = {"train": "train", "val": "val", "test": "test", **WAYMO}
# nuscenes-devkit @ d9de17a, python-sdk/nuscenes/utils/splits.py: the 150 scenes `val` of v1.0-trainval, whose other 700
# are `train`; `mini_val` of v1.0-mini; all of v1.0-test is `test`. The train scenes of the mini version are partly the
# whole data set's val scenes, so the version in a file's name decides.
_NUSCENES_VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
_NUSCENES_MINI_VAL = "103 916"


def _scenes(ranges: str) -> frozenset[int]:
    ends = [[int(number) for number in part.split("-")] for part in ranges.split()]
    return frozenset(scene for first, *last in ends for scene in range(first, (last or [first])[0] + 1))


NUSCENES_VAL = {"v1.0-trainval": _scenes(_NUSCENES_VAL), "v1.0-mini": _scenes(_NUSCENES_MINI_VAL)}


def folder_split(log: Path) -> str | None:
    """The split after which the folder of a log is named, as in Argoverse's `sensor/val/<log>`."""
    return FOLDERS.get(log.parent.name)


def nuscenes_split(scenario: str) -> str | None:
    """The split of a ScenarioNet file `sd_nuscenes_<version>_scene-<number>`, by nuScenes' own lists."""
    named = re.fullmatch(r"sd_nuscenes_(v1\.0-\w+)_scene-(\d{4})", scenario)
    if named is None:
        return None
    version, scene = named[1], int(named[2])
    if version == "v1.0-test":
        return "test"
    held_out = NUSCENES_VAL.get(version)
    return None if held_out is None else "val" if scene in held_out else "train"


def waymo_split(source_file: object) -> str | None:
    """The split of the record that a scenario was converted from: training*, validation*, testing*.tfrecord-*."""
    name = PurePosixPath(source_file).name if isinstance(source_file, str) else ""
    return next((split for word, split in WAYMO.items() if name.startswith(word)), None)
