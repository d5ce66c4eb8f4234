"""What planners are ranked by equals the public scorer on the recorded scenes, from the raw log on.

The frames are prepared, driven and filtered by planners.evaluation.scoring alone; plans and numbers are the recorded
ones.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference_scenes import loader

from factory.datasets.av2.reader import AV2Reader, log_folders
from factory.readers.base import ClipRef
from planners.evaluation.frames import Pair
from planners.evaluation.scoring import PreparedFrame, Rules, among_other_traffic, drive, prepare_frame, score_pair
from tasks.reward.one_stage import COLUMNS, frame_scores
from tasks.rollout.simulate import TrafficScene, TrafficSettings
from tasks.subscores import RECORDS
from tasks.world.clip import NOW, STEP_S, scene_of_clip
from tasks.world.frames import to_local

WHOLE = ("7fab2350_20", "7fab2350_44", "adcf7d18_64")  # the log holds a whole clip there
REPLAY = TrafficSettings(mode="replay")
PUBLIC = {record.name: record.long_name for record in RECORDS if record.plans == 1}


@cache
def frame_of(root: Path, name: str, earlier_steps: int = 0) -> PreparedFrame:
    """The recorded frame, or one some steps of 0.1 s before it."""
    log, step = name.split("_")
    reader = AV2Reader(root / "data/av2/sensor/val")
    log_id = next(log_id for log_id in log_folders(reader.root) if log_id.startswith(log))
    start = round(1000 * STEP_S) * (int(step) - NOW - earlier_steps)
    return prepare_frame(scene_of_clip(reader.read(ClipRef("av2", log_id, start))), REPLAY, Rules().pdm, logged=True)


def among_recorded_traffic(frame: PreparedFrame, idm: dict[str, np.ndarray], proposal: int) -> PreparedFrame:
    """The frame with the public traffic's recorded answer to a proposal; the human stays scored among the log."""
    agents = frame.scene.agents
    rows = [agents.track_ids.index(str(token)) for token in idm["tokens"]]
    window = slice(frame.scene.step, frame.scene.step + 41)
    boxes, velocities, valid = agents.boxes.copy(), agents.velocities.copy(), agents.valid.copy()
    valid[window] = False
    boxes[window, rows] = idm[f"box_ego{proposal}"]
    velocities[window, rows] = idm[f"vel_ego{proposal}"]
    valid[window, rows] = idm[f"valid_ego{proposal}"]
    scene = replace(frame.scene, agents=replace(agents, boxes=boxes, velocities=velocities, valid=valid))
    return replace(frame, traffic=TrafficScene(scene, REPLAY, None, None))


@pytest.mark.parametrize("name", WHOLE)
def test_a_plan_against_pdm_closed_scores_as_the_public_scorer_says(shared_root: Path, name: str) -> None:
    folder, frame = shared_root / "reference" / name, frame_of(shared_root, name)
    with np.load(folder / "idm_agents.npz") as traffic:
        idm = dict(traffic)
    plans = loader(shared_root).proposals(name, 256)
    recorded: list[dict[str, Any]] = json.loads((folder / "official_pdm_score_rows.json").read_text())["rows"]
    assert {row["policy"] for row in recorded} == {"log_replay", "idm"}
    for row in recorded:
        k = row["proposal"]
        driven = drive(frame if row["policy"] == "log_replay" else among_recorded_traffic(frame, idm, k), plans[k])
        found = frame_scores(driven.scores, frame.human)
        for column, public in PUBLIC.items():
            ours = found.filtered[COLUMNS.index(column)]
            assert ours == pytest.approx(row[public], abs=1e-6), (name, k, row["policy"], column)
        assert found.unfiltered[-1] == pytest.approx(row["pdm_score"], abs=1e-6), (name, k, row["policy"])


@pytest.mark.parametrize("name", WHOLE)
def test_a_plan_among_the_public_traffic_of_our_own_making_scores_as_the_public_scorer_says(
    shared_root: Path, name: str
) -> None:
    """`traffic=navsim`, the human's drive among it too: the rows of the public reactive policy."""
    frame = among_other_traffic(frame_of(shared_root, name), TrafficSettings(mode="navsim"))
    plans = loader(shared_root).proposals(name, 256)
    rows = json.loads((shared_root / "reference" / name / "official_pdm_score_rows.json").read_text())["rows"]
    reactive = [row for row in rows if row["policy"] == "idm"]
    assert len(reactive) == 3
    for row in reactive:
        driven = drive(frame, plans[row["proposal"]])
        found = frame_scores(driven.scores, frame.human)
        for column, public in PUBLIC.items():
            ours = found.filtered[COLUMNS.index(column)]
            assert ours == pytest.approx(row[public], abs=1e-6), (name, row["proposal"], column)
        assert found.unfiltered[-1] == pytest.approx(row["pdm_score"], abs=1e-6), (name, row["proposal"])


@pytest.mark.parametrize("name", WHOLE[:2])
def test_extended_comfort_of_a_plan_and_the_humans_before_is_the_recorded_one(shared_root: Path, name: str) -> None:
    module = loader(shared_root)
    now, before = frame_of(shared_root, name), frame_of(shared_root, name, earlier_steps=5)
    recorded, plans = module.metrics(name, 256), module.proposals(name, 256)
    scene = before.scene
    human = to_local(scene.ego_state[:3], scene.clip.ego_states[scene.step + 1 : scene.step + 41, :3])
    expected = recorded["two_frame_extended_comfort"]
    some = np.concatenate([np.flatnonzero(expected == value)[:4] for value in (0.0, 1.0)])
    assert set(expected[some]) == {0.0, 1.0}
    for k in some:
        (of_now, _), (of_before, driven) = score_pair(Pair(now, before), (plans[k], human))
        np.testing.assert_allclose(driven.states, recorded["prev_human_simulated_states"], rtol=0, atol=1e-6)
        assert of_now.unfiltered[COLUMNS.index("ec")] == of_before.unfiltered[COLUMNS.index("ec")] == expected[k]
