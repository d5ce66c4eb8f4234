"""The sample row: what declares a column, what makes a row a run's, and every column once."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any, cast, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tasks.subscores import HALVES, JUDGED, SUBSCORES, WHOLES

# Declared columns: from one `Column` its Arrow type, its validation, its line in the docs, and arrays in and out.
#
# A shape lists sizes: a number is a fixed size, a letter a ragged one. Rectangular values are arrays of that shape;
# where a ragged size stands behind the first, the value is a list of arrays.

Size = int | str

_ARROW = {
    "string": pa.string(),
    "binary": pa.binary(),
    "bool": pa.bool_(),
    "int8": pa.int8(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "float32": pa.float32(),
    "float64": pa.float64(),
}

_ARROW_OF = {  # type of a dataclass' field -> of its column
    str: pa.string(),
    bool: pa.bool_(),
    int: pa.int32(),
    float: pa.float64(),
    dict[str, int]: pa.map_(pa.string(), pa.int64()),
    dict[str, float]: pa.map_(pa.string(), pa.float64()),
}


@dataclass(frozen=True)
class TableSpec:
    """What a table is; `key` is its unique column."""

    name: str
    schema: pa.Schema
    key: str
    partition_by: tuple[str, ...] = ()
    properties: Mapping[str, str] | None = None
    packed: tuple[str, ...] = ()  # leaves whose values are compressed already, as their paths in a file


class BadRow(ValueError):
    """A row does not fit its columns; says which column and why."""


@dataclass(frozen=True)
class Column:
    """One column, or one member of a struct column."""

    name: str
    dtype: str  # a key of _ARROW, or "struct"
    shape: tuple[Size, ...] = ()
    unit: str = ""
    frame: str = ""
    about: str = ""
    nullable: bool = False
    nan: bool = False  # NaN marks absent entries; elsewhere it is refused
    members: tuple["Column", ...] = ()  # of a struct

    @cached_property
    def arrow_type(self) -> pa.DataType:
        inner = _ARROW[self.dtype] if self.dtype != "struct" else pa.struct([m.arrow_field for m in self.members])
        for size in reversed(self.shape):
            inner = pa.list_(inner, size) if isinstance(size, int) else pa.list_(inner)
        return inner

    @cached_property
    def arrow_field(self) -> pa.Field:
        notes = {"unit": self.unit, "frame": self.frame, "shape": str(list(self.shape)), "about": self.about}
        return pa.field(self.name, self.arrow_type, metadata={k: v for k, v in notes.items() if v and v != "[]"})

    def to_arrow(self, value: object) -> pa.Array:
        """One value as an array of length 1. Raises BadRow."""
        if value is None:
            if not self.nullable:
                raise BadRow(f"{self.name}: missing")
            return pa.nulls(1, self.arrow_type)
        return _build(self, self.shape, [value], self.name)

    def to_python(self, value: pa.Scalar) -> object:
        """The opposite: an array, a list of arrays where ragged inside, a list of dicts for structs, None for null."""
        if not value.is_valid:
            return None
        return _read(self, self.shape, value)


def _build(column: Column, shape: tuple[Size, ...], values: Sequence[object], where: str) -> pa.Array:
    """Values, each of `shape`, as one Arrow array of len(values)."""
    if not shape:
        return _scalars(column, values, where)
    regular = column.dtype not in ("struct", "string", "binary") and not any(isinstance(s, str) for s in shape[1:])
    if regular:
        arrays = [_shaped(shape, value, where) for value in values]
        lengths = [len(a) for a in arrays]
        inner: pa.Array = _entries(column, arrays, where)
        for size in reversed(shape[1:]):
            assert isinstance(size, int)
            inner = pa.FixedSizeListArray.from_arrays(inner, size)
    else:
        items = [_sequence(value, where) for value in values]
        lengths = [len(item) for item in items]
        inner = _build(column, shape[1:], [entry for item in items for entry in item], where)
    if isinstance(shape[0], int):
        if any(length != shape[0] for length in lengths):
            raise BadRow(f"{where}: {shape[0]} entries expected, got {lengths}")
        return pa.FixedSizeListArray.from_arrays(inner, shape[0])
    offsets = np.array([0, *accumulate(lengths)], np.int32)
    return pa.Array.from_buffers(pa.list_(inner.type), len(lengths), [None, pa.py_buffer(offsets)], children=[inner])


def _sequence(value: object, where: str) -> Sequence[object]:
    if isinstance(value, str | bytes) or not hasattr(value, "__len__") or not hasattr(value, "__getitem__"):
        raise BadRow(f"{where}: a list is expected, got {type(value).__name__}")
    return value  # type: ignore[return-value]


def _shaped(shape: tuple[Size, ...], value: object, where: str) -> NDArray[np.generic]:
    array = np.asarray(value)
    if array.size == 0 and array.ndim < len(shape) and isinstance(shape[0], str):
        array = array.reshape(0, *(s for s in shape[1:] if isinstance(s, int)))
    fits = array.ndim == len(shape) and all(isinstance(s, str) or s == n for s, n in zip(shape, array.shape))
    if not fits:
        raise BadRow(f"{where}: shape {list(shape)} expected, got {list(array.shape)}")
    return array


def _entries(column: Column, arrays: Sequence[NDArray[np.generic]], where: str) -> pa.Array:
    """All entries of arrays, one behind the other; looked at together, as a row has hundreds of lanes."""
    wanted = np.dtype(column.dtype)
    each = [array.reshape(-1) for array in arrays if array.size]
    flat = each[0] if len(each) == 1 else np.concatenate(each) if each else np.zeros(0, wanted)
    if not np.can_cast(flat.dtype, wanted, casting="same_kind"):
        raise BadRow(f"{where}: {wanted} expected, got {flat.dtype}")
    if wanted.kind == "f" and not column.nan and not np.isfinite(flat).all():
        raise BadRow(f"{where}: holds NaN or infinity")
    if wanted.kind == "b":  # Arrow packs eight into a byte
        return pa.array(np.ascontiguousarray(flat, wanted), _ARROW[column.dtype])
    buffer = pa.py_buffer(np.ascontiguousarray(flat, wanted))
    return pa.Array.from_buffers(_ARROW[column.dtype], len(flat), [None, buffer])  # a row 1.5 ms, by `pa.array` 2.0


def _scalars(column: Column, values: Sequence[object], where: str) -> pa.Array:
    if column.dtype == "struct":
        return _structs(column, values, where)
    if column.dtype == "string":
        good = all(isinstance(v, str) for v in values)
    elif column.dtype == "binary":
        good = all(v is None or isinstance(v, bytes) for v in values)
    else:
        return _entries(column, [_shaped((), value, where) for value in values], where)
    if not good:
        raise BadRow(f"{where}: {column.dtype} expected, got {sorted({type(v).__name__ for v in values})}")
    return pa.array([str(v) for v in values] if column.dtype == "string" else list(values), _ARROW[column.dtype])


def _structs(column: Column, values: Sequence[object], where: str) -> pa.Array:
    names = [member.name for member in column.members]
    for value in values:
        if not isinstance(value, Mapping) or sorted(value) != sorted(names):
            got = sorted(value) if isinstance(value, Mapping) else type(value).__name__
            raise BadRow(f"{where}: members {names} expected, got {got}")
    children = [
        _build(member, member.shape, [value[member.name] for value in values], f"{where}.{member.name}")  # type: ignore[index]
        for member in column.members
    ]
    return pa.StructArray.from_arrays(children, fields=[m.arrow_field for m in column.members])


def _read(column: Column, shape: tuple[Size, ...], value: pa.Scalar) -> object:
    if column.dtype == "struct":
        if shape:
            members = [_read_all(member, value.values.field(member.name)) for member in column.members]
            names = [member.name for member in column.members]
            return [dict(zip(names, entry)) for entry in zip(*members, strict=True)]
        return {member.name: _read(member, member.shape, value[member.name]) for member in column.members}
    if not shape or column.dtype in ("string", "binary"):
        return value.as_py()
    if any(isinstance(size, str) for size in shape[1:]):
        return [_read(column, shape[1:], entry) for entry in value]
    flat = value.values
    while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    sizes = [size if isinstance(size, int) else -1 for size in shape]
    array: NDArray[np.generic] = flat.to_numpy(zero_copy_only=False)
    if -1 in sizes:
        sizes[0] = len(value)
    return array.reshape(sizes)


def _read_all(column: Column, values: pa.Array) -> Sequence[object]:
    """Of every entry of a list of structs one member: a scalar of Arrow for each would take ten times as long."""
    if not column.shape and column.dtype != "struct":
        return cast(list[object], values.to_pylist())
    if column.dtype in ("struct", "string", "binary") or len(column.shape) > 1 or isinstance(column.shape[0], str):
        return [_read(column, column.shape, value) for value in values]
    return list(values.flatten().to_numpy(zero_copy_only=False).reshape(-1, *column.shape))


def schema_of(row: type) -> pa.Schema:
    """The columns of a dataclass: its fields in their order."""

    def arrow(hint: Any) -> pa.DataType:
        if is_dataclass(hint):
            return pa.struct(list(schema_of(hint)))  # type: ignore[arg-type]
        if get_origin(hint) is tuple:
            return pa.list_(arrow(get_args(hint)[0]))
        return _ARROW_OF[hint]

    return pa.schema([pa.field(name, arrow(hint)) for name, hint in get_type_hints(row).items()])


# What makes a row this run's: the digests of its settings, stage versions and inputs, and the key of an attempt.

UNLISTED = "unlisted"  # prepare_digest of clips prepared for the log's own drive alone: no perturb work, no list


@dataclass(frozen=True)
class RunIdentity:
    """What the rows of a run depend on besides clip, candidate and expert."""

    settings: Mapping[str, object]  # flat, dotted names -> plain values; without rounds, experts, limit, executor, out
    stage_versions: Mapping[str, int]
    vocabulary_digest: str
    prepare_digest: str  # of all that `prepare` depends on besides the clip: perturb, traffic, seed, stage versions;
    # UNLISTED in a run of `human` alone

    @cached_property
    def settings_hash(self) -> str:
        """16 hex digits of the canonical JSON of `settings`."""
        return hashlib.sha256(canonical_json(self.settings).encode()).hexdigest()[:16]

    @cached_property
    def versions_json(self) -> str:
        """`stage_versions` as it stands in the tables."""
        return canonical_json(self.stage_versions)


@dataclass(frozen=True)
class Stamp:
    """What the executor writes on a row: columns that Work.label does not give."""

    attempt_id: str
    expert: str
    expert_digest: str
    round: int
    candidate_index: int
    vocabulary_digest: str
    settings_hash: str
    stage_versions: str

    def of_attempt(self, clip_id: str, candidate: int, round: int) -> "Stamp":
        """Of another attempt of the same walk."""
        key = attempt_id(clip_id, candidate, self.vocabulary_digest, self.expert, self.expert_digest)
        return replace(self, attempt_id=key, candidate_index=candidate, round=round)


def canonical_json(value: object) -> str:
    """JSON with sorted keys and no spaces; the same for equal values, on every machine."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def attempt_id(clip_id: str, candidate: int, vocabulary_digest: str, expert: str, expert_digest: str) -> str:
    """16 hex digits: the primary key of an attempt, whatever became of it."""
    key = "\x1f".join((clip_id, str(candidate), vocabulary_digest, expert, expert_digest))
    return hashlib.sha256(key.encode()).hexdigest()[:16]


# The sample row: every column once, from which the Arrow schema, the validation and docs/formats.md follow.
#
# `now` is T+H for simulated rows and T for `human` rows. Ego poses are rear-axle. Timings are not here: a row's bytes
# do not depend on when or where it was made.

SCHEMA_VERSION = 7
MAP_RADIUS_M = 64.0
AGENT_STEPS = 56  # -1.5 .. 4.0 s at 10 Hz; index 15 is now
NOW_INDEX = 15

EGO, WORLD, LOGGED = "ego at now", "world", "logged pose at T+H"
STATE = "x [m], y [m], heading [rad], vx, vy [m/s], ax, ay [m/s2], steering [rad], its rate, yaw rate, yaw acceleration"


def _lineage() -> tuple[Column, ...]:
    repairs = (
        Column("what", "string", about="name of the pass (docs/repairs.md)"),
        Column("repaired", "int32", about="things of the log that it put right"),
        Column("left_out", "int32", about="things that it left out, for a frame or as a whole"),
    )
    return (
        Column("attempt_id", "string", about="unique: hash of clip, candidate, vocabulary, expert and its inputs"),
        Column("clip_id", "string", about="hash of data set, log, start time and window"),
        Column("dataset", "string"),
        Column("log_id", "string"),
        Column("split", "string", about="train, val or test: the data set's own, else by log"),
        Column("clip_start_s", "float64", unit="s", about="first step of the clip since the log's first instant"),
        Column("now_s", "float64", unit="s", about="now since the clip's first step: 5.5 simulated, 1.5 human"),
        Column("expert", "string", about="who drives the label; partition"),
        Column("expert_digest", "string", about="of the expert's inputs and settings"),
        Column("round", "int32", about="ordinal of the accepted attempt of its (clip, expert); partition"),
        Column("candidate_index", "int32", about="place in the clip's candidate list; -1 human"),
        Column(
            "vocabulary_index",
            "int32",
            nullable=True,
            about="row of the vocabulary; -1: log; -2 - n: start n; null human",
        ),
        Column("vocabulary_digest", "string"),
        Column("settings_hash", "string", about="of the run's settings, see run.json"),
        Column("stage_versions", "string", about="canonical JSON, stage -> version"),
        Column("content_digest", "string", about="of what the clip was read from, but pixels and points"),
        Column("licence", "string", about="of the source log"),
        Column("frame_tokens", "string", (2,), about="the log's own names of its frames at T and T+H", nullable=True),
        Column("repairs", "struct", ("F",), about="in the files of its log, by pass", members=repairs),
        Column("parent_states", "float64", (2, 11), STATE, WORLD, "logged ego at T and at T+H"),
    )


def _ego() -> tuple[Column, ...]:
    pose, off = "x, y [m], heading [rad]", "distance [m], turn [rad], speed [m/s], all >= 0"
    return (
        Column("now_pose", "float64", (3,), pose, WORLD, "ego at now; the origin of all that is in its frame"),
        Column("world_from_ego", "float64", (4, 4), "m", WORLD, "3-D pose of the ego at now", nullable=True),
        Column("ego_history_10hz", "float32", (16, 3), pose, EGO, "-1.5 .. 0 s"),
        Column("ego_history_2hz", "float32", (4, 3), pose, EGO, "-1.5, -1.0, -0.5, 0 s"),
        Column("ego_status", "float32", (4,), "vx, vy [m/s], ax, ay [m/s2]", "ego body", "at now"),
        Column("command", "string", about="left, straight, right or unknown, from the route"),
        Column("label_10hz", "float32", (40, 3), pose, EGO, "simulated; `human`: as logged, unsmoothed; 0.1 .. 4.0 s"),
        Column("label_2hz", "float32", (8, 3), pose, EGO, "simulated; `human`: as logged, unsmoothed; 0.5 .. 4.0 s"),
        Column("proposal_10hz", "float32", (40, 3), pose, EGO, "what the expert asked for; null human", nullable=True),
        Column("perturbed_states", "float64", (41, 11), STATE, WORLD, "stage one, T .. T+H; null human", nullable=True),
        Column(
            "candidate_end",
            "float64",
            (4,),
            pose + ", speed [m/s]",
            LOGGED,
            "reached at T+H; null human",
            nullable=True,
        ),
        Column("off_log_end", "float32", (3,), off, about="label's last pose from the log; null human", nullable=True),
        Column("off_log_most", "float32", (3,), off, about="most of each over the label; null human", nullable=True),
    )


def _world() -> tuple[Column, ...]:
    box = "centre x, y [m], heading [rad], length, width [m]"
    steps = "-1.5 .. 4.0 s at 10 Hz, index 15 is now"
    return (
        Column("agent_ids", "string", ("N",)),
        Column("agent_kinds", "string", ("N",), about="tasks.world.clip.AgentKind"),
        Column("agent_boxes", "float32", ("N", AGENT_STEPS, 5), box, EGO, steps, nan=True),
        Column("agent_velocities", "float32", ("N", AGENT_STEPS, 2), "m/s", EGO, "axes of the ego at now", nan=True),
        Column("agent_valid", "bool", ("N", AGENT_STEPS)),
        Column("agent_heights", "float32", ("N",), "m", about="box height"),
        Column("agent_center_z", "float32", ("N", AGENT_STEPS), "m", WORLD, "height of the box centre", nan=True),
        Column("lane_ids", "string", ("L",), about=f"lanes within {MAP_RADIUS_M:.0f} m of the ego at now"),
        Column("lane_polygons", "float32", ("L", "P", 2), "m", EGO, "closed rings"),
        Column("lane_centerlines", "float32", ("L", "P", 3), "x, y [m], heading [rad]", EGO),
        Column("lane_is_intersection", "bool", ("L",)),
        Column("drivable_rings", "float32", ("D", "P", 2), "m", EGO, "closed exterior rings"),
        Column("crossing_rings", "float32", ("X", "P", 2), "m", EGO, "closed rings"),
        Column("light_lane_ids", "string", ("S",), about="lane connectors with a traffic light"),
        Column("light_states", "int8", ("S", AGENT_STEPS), about="0 unknown, 1 green, 2 yellow, 3 red; " + steps),
        Column("map_location", "string", about="the map's name of the place; empty: it has none"),
        Column("route_roadblock_ids", "string", ("B",), about="roadblocks and connectors of the route, in order"),
        Column("route_lane_ids", "string", ("R",), about="lanes of the roadblocks on the route"),
        Column("route_centerline", "float32", ("P", 3), "x, y [m], heading [rad]", EGO, "ahead of the ego"),
    )


def _scores(prefix: str, stage: str) -> tuple[Column, ...]:
    """Flat columns, so that a query on scores reads nothing else."""
    return (
        *(
            Column(f"{prefix}_{name}", "float64", about=f"{stage}; null: not defined", nullable=True)
            for name in SUBSCORES
        ),
        Column(f"{prefix}_score", "float64", about=f"EPDMS of {stage}", nullable=True),
        *(
            Column(
                f"{prefix}_{name}_fails_s", "float64", unit="s", about="first failing time; null: never", nullable=True
            )
            for name in JUDGED
        ),
    )


def _sensors() -> tuple[Column, ...]:
    camera = (
        Column("name", "string"),
        Column("width", "int32", unit="pixel"),
        Column("height", "int32", unit="pixel"),
        Column("intrinsics", "float64", (9,), "pixel", "image", "3x3, row by row"),
        Column("distortion", "float64", (5,), about="k1, k2, p1, p2, k3 as OpenCV has them; zeros: none"),
        Column("ego_from_camera", "float64", (16,), "m", "ego", "4x4, row by row"),
    )
    image = (
        Column("camera", "string"),
        Column("time_s", "float64", unit="s", about="relative to now"),
        Column("ego_pose", "float64", (16,), "m", WORLD, "4x4, ego at this time"),
        Column("jpeg", "binary"),
    )
    left_out = Column("camera", "string"), Column("why", "string", about="PSNR of its held-out photos, and the bound")
    return (
        Column("cameras", "struct", ("C",), about="rig; null where there is none", nullable=True, members=camera),
        Column("images", "struct", ("I",), about="null: image_source is none", nullable=True, members=image),
        Column("image_source", "string", about="photo, render, map, painter or none"),
        Column(
            "cameras_left_out",
            "struct",
            ("L",),
            about="of the rig, too poor in its block to be drawn; null: drawn from no block",
            nullable=True,
            members=left_out,
        ),
        Column(
            "psnr", "float64", unit="dB", about="of the block's cameras that are drawn, held-out photos", nullable=True
        ),
        Column("asset_digest", "string", about="of the reconstruction the images were rendered from", nullable=True),
        Column("tags", "string", ("T",), about="what is in the scene"),
    )


def _labels() -> tuple[Column, ...]:
    """Scores of a whole vocabulary from now; all null in a run without them (reward.labels=none)."""
    planes = " ".join((*HALVES, *WHOLES)).upper()
    return (
        Column("label_vocabulary", "string", about="digest of the K trajectories that are labelled", nullable=True),
        Column("label_traffic", "string", about="replay: the row's own", nullable=True),
        Column(
            "label_reference_progress_m",
            "float64",
            unit="m",
            about="compliant progress of PDM-Closed; EP is relative to it",
            nullable=True,
        ),
        Column("label_subscores", "binary", about=f"{planes} of K trajectories, as below", nullable=True),
        Column("label_progress", "binary", about="progress of K trajectories along the route, as below", nullable=True),
    )


FIELDS: tuple[Column, ...] = (
    *_lineage(),
    *_ego(),
    *_world(),
    *_scores("stage1", "the perturbation, T .. T+H"),
    *_scores("stage2", "the expert, T+H .. T+2H (human: T .. T+H)"),
    *_sensors(),
    *_labels(),
)
SCHEMA = pa.schema([field.arrow_field for field in FIELDS], metadata={"schema_version": str(SCHEMA_VERSION)})
LABEL_COLUMNS = tuple(field.name for field in _labels())
COLUMNS: Mapping[str, Column] = {field.name: field for field in FIELDS}

# What the executor fills in; everything else is the row that `Work.attempt` returns.
BOOKKEEPING = tuple(field.name for field in fields(Stamp))

LICENCES_PROPERTY = "factory.licences"  # of the table `samples`: the licences of its rows' sources, "; " between
VERSION_PROPERTY = "factory.schema_version"  # of the table `samples`
SAMPLES = TableSpec(
    "samples",
    SCHEMA,
    "attempt_id",
    partition_by=("round", "expert"),
    properties={VERSION_PROPERTY: str(SCHEMA_VERSION)},
    packed=("images.list.element.jpeg",),
)


def why_other_schema(uri: str, version: object) -> str:
    """One line on why tables of this version of the schema are not opened; nothing where it is this one's."""
    if str(version) == str(SCHEMA_VERSION):
        return ""
    return (
        f"{uri}: schema_version {version}, this version reads and writes {SCHEMA_VERSION}: make the tables again, "
        "by the command that made them with another out="
    )


def sample_rows_to_table(rows: Sequence[Mapping[str, object]]) -> pa.Table:
    """Rows (column -> value) as a table of SCHEMA.

    A nullable column may be left out. Raises BadRow naming a column that is missing, unknown, misshapen or not finite.
    """
    tables = []
    for row in rows:
        unknown = sorted(set(row) - set(COLUMNS))
        if unknown:
            raise BadRow(f"unknown columns {unknown}")
        tables.append(pa.table([field.to_arrow(row.get(field.name)) for field in FIELDS], schema=SCHEMA))
    return tables[0] if len(tables) == 1 else pa.concat_tables([SCHEMA.empty_table(), *tables]).combine_chunks()


def table_to_rows(table: pa.Table) -> list[dict[str, object]]:
    """The opposite: one dict per row with arrays in the declared shapes; only the columns the table has."""
    fields = [COLUMNS[name] for name in table.column_names]
    return [{field.name: field.to_python(table[field.name][i]) for field in fields} for i in range(table.num_rows)]
