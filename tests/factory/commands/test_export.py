"""MCAP episodes, read back with the official reader: what a sample holds is in them, where and when it was."""

import io
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from factory.commands.table import COMMANDS
from factory.store.episodes import episode_bytes
from factory.store.samples import Store
from factory.store.schema import COLUMNS
from factory.views.episode_messages import episode_messages, metadata_of, world_from_now
from factory.views.pictures import sample_bev
from tests.planners.samples import FRONT_YAWS, jpeg, pictures, plain, sample, write_table

main = COMMANDS["export"].load()

Message = tuple[int, Any]  # time [ns], decoded content


@pytest.fixture(scope="module")
def row() -> dict[str, Any]:
    views = {name: jpeg(plain((40 * i, 90, 200))) for i, name in enumerate(FRONT_YAWS)}
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", [0.7, 0.02, -0.01]).as_matrix()
    pose[:3, 3] = 4100.0, -250.0, 12.0
    place = {"now_pose": np.array([4100.0, -250.0, 0.7]), "world_from_ego": pose}
    times = {"clip_start_s": 2.0, "now_s": 5.5}
    fails = {"stage2_nc_fails_s": None, "stage2_dac_fails_s": 0.0}
    found = sample(3, "recovery", **pictures(views), **place, **times, **fails, stage_versions='{"clip": 1}')
    ids = [f"agent{i}" for i in range(len(found["agent_ids"]))]
    return found | {"agent_ids": ids, "agent_boxes": np.nan_to_num(found["agent_boxes"])}


@pytest.fixture(scope="module")
def topics(row: dict[str, Any]) -> dict[str, list[Message]]:
    """Every message of the sample's episode, by topic."""
    return read(episode_bytes(episode_messages(row), metadata_of(row)))


def read(data: bytes) -> dict[str, list[Message]]:
    found: dict[str, list[Message]] = defaultdict(list)
    reader = make_reader(io.BytesIO(data), validate_crcs=True, decoder_factories=[DecoderFactory()])
    for _, channel, message, content in reader.iter_decoded_messages():  # raises on what protobuf alone does not read
        found[channel.topic].append((message.log_time, content))
    return found


def seconds(stamp: Any) -> float:
    return float(stamp.seconds + 1e-9 * stamp.nanos)


def matrix(transform: Any) -> np.ndarray[Any, Any]:
    pose = np.eye(4)
    q, t = transform.rotation, transform.translation
    pose[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    pose[:3, 3] = t.x, t.y, t.z
    return pose


def test_an_episode_is_indexed_compressed_and_names_its_sample(row: dict[str, Any]) -> None:
    messages = episode_messages(row)
    data = episode_bytes(messages, metadata_of(row))
    summary = make_reader(io.BytesIO(data), validate_crcs=True).get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == len(messages)
    assert summary.chunk_indexes and {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    (metadata,) = make_reader(io.BytesIO(data)).iter_metadata()
    assert metadata.metadata["attempt_id"] == row["attempt_id"] and metadata.metadata["licence"] == row["licence"]
    assert data == episode_bytes(episode_messages(row), metadata_of(row)), "its bytes depend on nothing else"


def test_the_frames_lead_from_the_map_to_every_camera(row: dict[str, Any], topics: dict[str, list[Message]]) -> None:
    """The 16 poses of the history and the 40 of the label, around the 3-D pose at now; a camera looks along its yaw."""
    assert len(topics["/tf"]) == 56
    now = np.eye(4)
    now[:3, :3] = Rotation.from_euler("zyx", [0.7, 0.02, -0.01]).as_matrix()
    now[:3, 3] = 4100.0, -250.0, 12.0
    for step, (time_ns, message) in enumerate(topics["/tf"]):
        x, y, heading = row["ego_history_10hz"][step] if step < 16 else row["label_10hz"][step - 16]
        by_child = {transform.child_frame_id: transform for transform in message.transforms}
        assert time_ns == round(1e9 * (2.0 + 5.5 - 1.5 + 0.1 * step)) == round(1e9 * seconds(by_child["ego"].timestamp))
        assert (by_child["now"].parent_frame_id, by_child["ego"].parent_frame_id) == ("world", "now")
        np.testing.assert_allclose(matrix(by_child["now"]), now, atol=1e-6)
        np.testing.assert_allclose(matrix(by_child["ego"])[:3, 3], [x, y, 0.0], atol=1e-6)
        turned = Rotation.from_euler("z", heading).as_matrix()
        np.testing.assert_allclose(matrix(by_child["ego"])[:3, :3], turned, atol=1e-6)
        for name, yaw in FRONT_YAWS.items():
            assert by_child[name].parent_frame_id == "ego"
            ahead, right = matrix(by_child[name])[:3, 2], matrix(by_child[name])[:3, 0]
            np.testing.assert_allclose(ahead, [np.cos(yaw), np.sin(yaw), 0.0], atol=1e-9)
            np.testing.assert_allclose(right, [np.sin(yaw), -np.cos(yaw), 0.0], atol=1e-9)


def test_pictures_are_the_stored_bytes_each_with_its_camera(
    row: dict[str, Any], topics: dict[str, list[Message]]
) -> None:
    for camera in row["cameras"]:
        name = camera["name"]
        stored = {round(1e9 * (7.5 + i["time_s"])): i["jpeg"] for i in row["images"] if i["camera"] == name}
        assert {time_ns: message.data for time_ns, message in topics[f"/camera/{name}/image"]} == stored
        for time_ns, message in topics[f"/camera/{name}/calibration"]:
            assert time_ns in stored and message.frame_id == name
            assert (message.width, message.height) == (camera["width"], camera["height"])
            assert list(message.K) == camera["intrinsics"].tolist()


def test_agents_are_where_and_when_they_are_and_gone_when_they_are_not(
    row: dict[str, Any], topics: dict[str, list[Message]]
) -> None:
    assert len(topics["/agents"]) == 56
    for step, (_, message) in enumerate(topics["/agents"]):
        assert len(message.deletions) == 1 and message.deletions[0].type == 1, "those of the step before go"
        there = {row["agent_ids"][i]: i for i in np.flatnonzero(row["agent_valid"][:, step])}
        assert sorted(entity.id for entity in message.entities) == sorted(there)
        for entity in message.entities:
            (cube,), box = entity.cubes, row["agent_boxes"][there[entity.id], step]
            np.testing.assert_allclose([cube.pose.position.x, cube.pose.position.y], box[:2], rtol=1e-6)
            np.testing.assert_allclose([cube.size.x, cube.size.y], box[3:], rtol=1e-6)
            q = cube.pose.orientation
            turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("zyx")[0]
            assert np.cos(turned - box[2]) == pytest.approx(1.0, abs=1e-5)


def test_a_street_without_anybody_is_drawn_and_exported(row: dict[str, Any]) -> None:
    alone = row | {name: row[name][:0] for name in row if name.startswith("agent_")}
    for kept in (alone, alone | {name: [] for name in alone if name.startswith("agent_")}):  # of a run, of a table
        agents = read(episode_bytes(episode_messages(kept), metadata_of(kept)))["/agents"]
        assert len(agents) == 56 and not any(message.entities for _, message in agents)
        assert (sample_bev(kept) != sample_bev(row)).any()


def test_the_three_drives_meet(row: dict[str, Any], topics: dict[str, list[Message]]) -> None:
    """The expert begins at now, where the perturbation ended; both stand in the frame of now."""
    ((_, expert),), ((_, perturbed),) = topics["/trajectories/expert"], topics["/trajectories/perturbed"]
    assert (expert.poses[0].position.x, expert.poses[0].position.y) == (0.0, 0.0)
    end = row["label_10hz"][-1]
    assert expert.poses[-1].position.x == pytest.approx(float(end[0]), rel=1e-6)
    world = world_from_now(row | {"world_from_ego": None}) @ np.array(
        [perturbed.poses[-1].position.x, perturbed.poses[-1].position.y, 0.0, 1.0]
    )
    np.testing.assert_allclose(world[:2], row["perturbed_states"][-1, :2], atol=1e-6)
    assert {entity.id for entity in topics["/trajectories"][0][1].entities} == {"logged", "perturbed", "expert"}


def test_scores_and_lineage_stand_under_their_columns_names(
    row: dict[str, Any], topics: dict[str, list[Message]]
) -> None:
    """Each of its column's kind; what is null is absent, so that no reader takes it for zero."""
    ((_, facts),) = topics["/sample"]
    assert facts.DESCRIPTOR.full_name == "driving_data_factory.Sample"
    small = {name for name, column in COLUMNS.items() if not column.shape and column.dtype != "binary"}
    assert {*facts.DESCRIPTOR.fields_by_name} == small | {"now_pose", "ego_status", "candidate_end", "tags"}
    for name in small:
        assert getattr(facts, name) == row[name] if row.get(name) is not None else not facts.HasField(name), name
    np.testing.assert_array_equal(facts.ego_status, row["ego_status"])
    assert facts.HasField("stage2_dac_fails_s") and not facts.HasField("stage2_nc_fails_s")


def test_a_human_sample_has_no_perturbation() -> None:
    human = sample(0, perturbed_states=None, world_from_ego=None, stage_versions="{}")
    names = {message.topic for message in episode_messages(human)}
    assert "/trajectories/perturbed" not in names and not any(name.startswith("/camera") for name in names)


def test_the_command_writes_one_file_or_every_nth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    write_table(out, [sample(i, "recovery", stage_versions="{}", world_from_ego=None) for i in range(4)])
    ids = sorted(Store(out).samples)
    assert main(["mcap", f"out={out}", "every=2", f"to={tmp_path / 'looks'}"]) == 0
    written = [Path(line) for line in capsys.readouterr().out.split()]
    assert [path.name for path in written] == [f"sample_{key}.mcap" for key in ids[::2]]
    assert read(written[0].read_bytes())["/sample"][0][1].attempt_id == ids[0]
    assert main(["mcap", f"out={out}", "sample=0", f"to={tmp_path / 'one.mcap'}"]) == 0
    assert (tmp_path / "one.mcap").read_bytes() == written[0].read_bytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["gif", "out={out}", "sample=0"], "one of mcap, mp4"),
        (["mcap", "out={out}"], "either sample=<id> or every=<n>"),
        (["mcap", "out={out}", "every=0"], "must be 1 or more"),
        (["mcap", "out={out}", "sample=nobody"], "no sample nobody"),
        (["mcap", "out={out}", "every=1", "to=one.mcap"], "name a folder"),
    ],
)
def test_what_cannot_be_exported_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    write_table(tmp_path, [sample(0, stage_versions="{}")])
    assert main([argument.format(out=tmp_path) for argument in arguments]) == 2
    assert said in capsys.readouterr().err
