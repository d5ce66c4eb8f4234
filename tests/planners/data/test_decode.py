"""What is cut from flat buffers is what the sample reader gives, and a batch is what its rows say."""

from pathlib import Path

import numpy as np
import pytest

from factory.stages.rows import label_columns
from factory.store.reader import SampleTable, labels_of
from factory.store.schema import COLUMNS, LABEL_COLUMNS
from planners.data.batch import COMMANDS, BevLayout, ImageLayout, Needs
from planners.data.bev import bev_raster, nearest_vehicles
from planners.data.decode import BatchBuffer, StoredRows, count_labels
from planners.data.files import files_of, leaf_paths
from planners.data.images import stitch_sample
from planners.data.index import BEV_COLUMNS, PLAN_COLUMNS
from tasks.reward.label_bytes import VocabularyLabels
from tasks.world.clip import AgentKind
from tests.planners.samples import grey_pictures, labels, sample, write_table

NUMERIC = [name for name, c in COLUMNS.items() if c.dtype not in ("struct", "string", "binary") and not c.nullable]
STORED = [name for name in NUMERIC if name not in ("round", "expert")]
IMAGE = ImageLayout(width=48, height=12)
BEV = BevLayout(cell_m=2.0, times_s=(-1.0, 0.0))


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rows of which the second has no agents and no lanes."""
    rng = np.random.default_rng(0)
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.VEHICLE]
    rows = []
    for number in range(3):
        boxes = np.concatenate([rng.uniform(-20, 20, (3, 56, 3)), rng.uniform(1, 4, (3, 56, 2))], axis=2)
        rows.append(
            sample(
                number,
                agent_kinds=[str(kind) for kind in kinds],
                agent_boxes=boxes.astype(np.float32),
                lane_polygons=[rng.uniform(-30, 30, (n, 2)).astype(np.float32) for n in (4, 9, 5)],
                **grey_pictures(60 * (number + 1)),
                **labels(number, 21),
            )
        )
    gone = ("agent_ids", "agent_kinds", "agent_boxes", "agent_velocities", "agent_valid", "agent_heights")
    lanes = ("lane_ids", "lane_polygons", "lane_centerlines", "lane_is_intersection", "crossing_rings")
    empty = {name: np.zeros((0, *(n for n in COLUMNS[name].shape[1:] if isinstance(n, int)))) for name in gone[2:]}
    empty["agent_valid"] = np.zeros((0, 56), bool)
    rows[1] |= empty | {name: [] for name in (*gone[:2], *lanes)} | {"agent_center_z": np.zeros((0, 56))}
    out = tmp_path_factory.mktemp("decode") / "out"
    write_table(out, rows)
    return out


def stored(table: Path, columns: list[str], cameras: tuple[str, ...] = ()) -> StoredRows:
    (file,) = files_of(table)
    parquet = file.open()
    return StoredRows(parquet.read_row_group(0, columns=leaf_paths(parquet, columns)), [cameras] * 3)


def test_every_column_is_read_as_the_sample_reader_reads_it(table: Path) -> None:
    names = [*STORED, *BEV_COLUMNS, *PLAN_COLUMNS, *LABEL_COLUMNS]
    rows = stored(table, names)
    for number, expected in enumerate(SampleTable(table)):
        for name in names:
            one, other = rows.value(name, number), expected[name]
            if isinstance(other, list):
                assert len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other)), name
            elif isinstance(other, np.ndarray):
                assert one.shape == other.shape and one.dtype == other.dtype, name
                assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), name
            else:
                assert one == other, name


def test_a_batch_is_what_its_rows_say(table: Path) -> None:
    samples = SampleTable(table)
    needs = Needs(image=IMAGE, bev=BEV, n_agents=2, labels="vocabulary-1", normalise="batch")
    columns = [*PLAN_COLUMNS, *BEV_COLUMNS, *LABEL_COLUMNS, "images.camera", "images.time_s", "images.jpeg"]
    rows = stored(table, columns, ("left", "front", "right"))
    assert count_labels(rows, 0) == 21
    buffer = BatchBuffer(3, needs, 21)
    for i in (2, 0, 1):
        buffer.fill(i, rows, i)
    batch = buffer.batch(["a", "b", "c"], np.array([True, False, True]), np.array([False, False, True]))
    assert batch.attempt_ids == ("a", "b", "c") and batch.simulated.tolist() == [True, False, True]
    assert batch.imitate.tolist() == [False, False, True] and len(batch.parts(3)) == 3
    assert batch.image is not None and batch.image.shape == (3, 3, 12, 48)
    assert batch.bev is not None and batch.agents is not None and batch.agents_valid is not None
    assert batch.labels is not None and list(batch.labels) == ["nc", "dac", "ddc", "tlc", "ttc", "lk", "hc", "ep"]
    for i, one in enumerate(samples):
        assert batch.status[i, :4].tolist() == [float(one["command"] == name) for name in COMMANDS]
        assert np.array_equal(batch.status[i, 4:], one["ego_status"])
        assert np.array_equal(batch.history[i], one["ego_history_2hz"])
        assert np.array_equal(batch.plan_2hz[i], one["label_2hz"])
        assert np.array_equal(batch.plan_10hz[i], one["label_10hz"])
        assert np.array_equal(batch.image[i].permute(1, 2, 0), stitch_sample(one, IMAGE))
        assert np.array_equal(batch.bev[i], bev_raster(one, BEV))
        boxes, valid = nearest_vehicles(one, BEV, 2)
        assert np.array_equal(batch.agents[i], boxes) and np.array_equal(batch.agents_valid[i], valid)
        meant = labels_of(one)
        assert np.array_equal(batch.labels["ddc"][i], meant.ddc)
        assert np.array_equal(batch.labels["ep"][i], meant.ep("batch").astype(np.float32))
    assert batch.bev[0].any() and batch.agents_valid[0].any() and not batch.agents_valid[1].any()


@pytest.mark.parametrize(
    ("normalise", "expected"),
    [("pairs", [1.0, 0.25, 0.75]), ("batch", [1.0, 0.125, 0.375]), ("masked", [1.0, 0.25, 0.0])],
)
def test_progress_is_normalised_as_the_planner_asks(tmp_path: Path, normalise: str, expected: list[float]) -> None:
    """PDM-Closed gets 20 m far. The first drives 40 m and is faultless, the second 5 m, the third 15 m off the road."""
    one = np.ones(3)
    made = VocabularyLabels(
        "vocabulary-1", 20.0, one, np.array([1.0, 1.0, 0.0]), *[one] * 5, ep_raw_m=np.array([40.0, 5.0, 15.0])
    )
    write_table(tmp_path / "out", [sample(0, **label_columns(made))])
    (file,) = files_of(tmp_path / "out")
    parquet = file.open()
    needed = leaf_paths(parquet, [*PLAN_COLUMNS, *LABEL_COLUMNS])
    buffer = BatchBuffer(1, Needs(labels="vocabulary-1", normalise=normalise), 3)  # type: ignore[arg-type]
    buffer.fill(0, StoredRows(parquet.read_row_group(0, columns=needed), [()]), 0)
    batch = buffer.batch(["a"], np.array([False]), np.array([True]))
    assert batch.labels is not None and batch.labels["ep"][0].tolist() == expected


def test_pictures_leave_the_table(table: Path) -> None:
    (file,) = files_of(table)
    parquet = file.open()
    read = parquet.read_row_group(0, columns=leaf_paths(parquet, ["images.camera", "images.time_s", "images.jpeg"]))
    whole = read["images"].chunk(0).values.field("jpeg").buffers()[2]
    for pictures in (StoredRows(read, [("left", "front")] * 3).jpegs(row) for row in range(3)):
        for picture in pictures:
            assert not whole.address <= picture.ctypes.data < whole.address + whole.size


def test_of_a_struct_single_members_are_read(table: Path) -> None:
    (file,) = files_of(table)
    parquet = file.open()
    assert leaf_paths(parquet, ["images.jpeg"]) == ["images.list.element.jpeg"]
    assert [path.split(".")[-1] for path in leaf_paths(parquet, ["images"])] == ["camera", "time_s", "element", "jpeg"]
    with pytest.raises(ValueError, match=r"columns images\.png, label_4hz are missing"):
        leaf_paths(parquet, ["images.png", "label_2hz", "label_4hz"])
