"""The sample row: every column once, from which the Arrow schema, the validation and docs/formats.md follow.

`now` is T+H for simulated rows and T for `human` rows. Ego poses are rear-axle. Timings are not here: a row's bytes do
not depend on when or where it was made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields

import pyarrow as pa

from factory.store.columns import BadRow, Column
from factory.store.identity import Stamp
from factory.store.parquet_file import TableSpec
from tasks.subscores import HALVES, JUDGED, SUBSCORES, WHOLES

SCHEMA_VERSION = 4
MAP_RADIUS_M = 64.0
AGENT_STEPS = 56  # -1.5 .. 4.0 s at 10 Hz; index 15 is now
NOW_INDEX = 15

EGO, WORLD, LOGGED = "ego at now", "world", "logged pose at T+H"
STATE = "x [m], y [m], heading [rad], vx, vy [m/s], ax, ay [m/s2], steering [rad], its rate, yaw rate, yaw acceleration"


def _lineage() -> tuple[Column, ...]:
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
            about="row of the vocabulary; -1: log; -2 - n: drift n; null human",
        ),
        Column("vocabulary_digest", "string"),
        Column("settings_hash", "string", about="of the run's settings, see run.json"),
        Column("stage_versions", "string", about="canonical JSON, stage -> version"),
        Column("content_digest", "string", about="of what the clip was read from, but pixels and points"),
        Column("licence", "string", about="of the source log"),
        Column("frame_tokens", "string", (2,), about="the log's own names of its frames at T and T+H", nullable=True),
        Column("parent_states", "float64", (2, 11), STATE, WORLD, "logged ego at T and at T+H"),
    )


def _ego() -> tuple[Column, ...]:
    pose = "x, y [m], heading [rad]"
    return (
        Column("now_pose", "float64", (3,), pose, WORLD, "ego at now; the origin of all that is in its frame"),
        Column("world_from_ego", "float64", (4, 4), "m", WORLD, "3-D pose of the ego at now", nullable=True),
        Column("ego_history_10hz", "float32", (16, 3), pose, EGO, "-1.5 .. 0 s"),
        Column("ego_history_2hz", "float32", (4, 3), pose, EGO, "-1.5, -1.0, -0.5, 0 s"),
        Column("ego_status", "float32", (4,), "vx, vy [m/s], ax, ay [m/s2]", "ego body", "at now"),
        Column("command", "string", about="left, straight, right or unknown, from the route"),
        Column("label_10hz", "float32", (40, 3), pose, EGO, "simulated states, of `human` the log's, 0.1 .. 4.0 s"),
        Column("label_2hz", "float32", (8, 3), pose, EGO, "simulated states, of `human` the log's, 0.5 .. 4.0 s"),
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
    )


def _world() -> tuple[Column, ...]:
    box = "centre x, y [m], heading [rad], length, width [m]"
    steps = "-1.5 .. 4.0 s at 10 Hz, index 15 is now"
    return (
        Column("agent_ids", "string", ("N",)),
        Column("agent_kinds", "string", ("N",), about="tasks.world.agents.AgentKind"),
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
    return (
        Column("cameras", "struct", ("C",), about="rig; null where there is none", nullable=True, members=camera),
        Column("images", "struct", ("I",), about="null: image_source is none", nullable=True, members=image),
        Column("image_source", "string", about="photo, render, map, painter or none"),
        Column("psnr", "float64", unit="dB", about="of the block's reconstruction", nullable=True),
        Column("asset_digest", "string", about="of the reconstruction the images were rendered from", nullable=True),
        Column("tags", "string", ("T",), about="what is in the scene"),
    )


def _labels() -> tuple[Column, ...]:
    """Scores of a whole vocabulary from now; all null in a run without them (reward.labels=none)."""
    planes = " ".join((*HALVES, *WHOLES)).upper()
    return (
        Column("label_vocabulary", "string", about="digest of the K trajectories that are labelled", nullable=True),
        Column("label_traffic", "string", about="replay: the row's own; else it answers to each", nullable=True),
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


def sample_row_to_table(rows: Sequence[Mapping[str, object]]) -> pa.Table:
    """Rows (column -> value) as a table of SCHEMA.

    A nullable column may be left out. Raises BadRow naming a column that is missing, unknown, misshapen or not finite.
    """
    tables = []
    for row in rows:
        unknown = sorted(set(row) - set(COLUMNS))
        if unknown:
            raise BadRow(f"unknown columns {unknown}")
        tables.append(pa.table([field.to_arrow(row.get(field.name)) for field in FIELDS], schema=SCHEMA))
    return pa.concat_tables([SCHEMA.empty_table(), *tables]).combine_chunks()


def table_to_rows(table: pa.Table) -> list[dict[str, object]]:
    """The opposite: one dict per row with arrays in the declared shapes; only the columns the table has."""
    fields = [COLUMNS[name] for name in table.column_names]
    return [{field.name: field.to_python(table[field.name][i]) for field in fields} for i in range(table.num_rows)]
