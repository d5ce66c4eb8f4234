"""The public scorer's recorded rows, scored by `evaluate` from a benchmark on disk to NAVSIM's table.

A frame of one stage for each recorded scene, among the log and among the public reactive traffic; the planners are the
recorded plans. What the recordings do not hold is a pair of stages: no two-stage row is among them.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference_scenes import loader
from test_scoring_real import WHOLE, frame_of

from factory.stages.benchmark import BENCHMARK_FILE
from factory.store.location import Location, SceneFiles, write_shard
from factory.store.samples import Store
from factory.store.schema import SAMPLES, sample_rows_to_table
from planners.evaluation.evaluate import main
from planners.evaluation.frames import FrameKey
from planners.evaluation.navsim import LONG, read_table
from tasks.hard_scenes import OneStageClip
from tasks.reward.aggregate import COLUMNS
from tasks.world.clip import scene_of_clip
from tests.planners.small_benchmark import sample

pytestmark = pytest.mark.slow  # three scenes, eight plans
PROPOSALS = (0, 1, 2, 40, 129, 137, 161, 200)
PLANS: dict[str, np.ndarray] = {}  # scene -> (256, 40, 3)


class Recorded:
    """Plans the recorded proposal of a scene, whose name its log has."""

    def __init__(self, proposal: int) -> None:
        self.proposal, self.digest = proposal, f"recorded-{proposal}"

    def plan(self, seen: Mapping[str, Any]) -> np.ndarray:
        return PLANS[seen["log_id"]][self.proposal]


PLANNERS: dict[str, Callable[[], Recorded]] = {f"plan_{k}": partial(Recorded, k) for k in PROPOSALS}
globals().update(PLANNERS)  # `evaluate` takes a planner by its name in a module


@pytest.fixture(scope="module")
def benchmark(shared_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    location, clips, shards = Location.parse(tmp_path_factory.mktemp("recorded")), [], []
    for name in WHOLE:
        PLANS[name] = loader(shared_root).proposals(name, 256)
        clip = replace(frame_of(shared_root, name).scene.clip, clip_id=name, log_id=name)
        SceneFiles(location.child("scenes")).store(OneStageClip(clip))
        clips.append({"clip_id": name, "log_id": name, "follow_ups": [], "tokens": [name], "before": None})
        row = sample(FrameKey.logged(name).now, scene_of_clip(clip))
        shards.append(write_shard(location.child("samples"), SAMPLES, sample_rows_to_table([row])))
    Store(location).samples.commit(shards)
    document = {"format": 1, "stages": 1, "clips": clips, "left_out": []}
    location.write(BENCHMARK_FILE, json.dumps(document).encode())
    return Path(location.uri)


@pytest.mark.parametrize(("policy", "traffic", "n_rows"), [("log_replay", "replay", 8), ("idm", "navsim", 3)])
def test_evaluate_makes_the_recorded_rows(
    shared_root: Path, benchmark: Path, tmp_path: Path, policy: str, traffic: str, n_rows: int
) -> None:
    named = ",".join(f"{name}: test_recorded_rows:{name}" for name in PLANNERS)
    words = [f"planners={{{named}}}", "bounds=false", f"traffic@one_stage_traffic={traffic}"]
    assert main([f"benchmark={benchmark}", *words, f"out={tmp_path}"]) == 0
    filtered, unfiltered = (
        {k: read_table(tmp_path / f"plan_{k}" / f"navsim_{which}.csv").logged for k in PROPOSALS}
        for which in ("filtered", "unfiltered")
    )
    for name in WHOLE:
        recorded = json.loads((shared_root / "reference" / name / "official_pdm_score_rows.json").read_text())["rows"]
        rows = [row for row in recorded if row["policy"] == policy]
        assert len(rows) == n_rows
        scales = []  # what the recorded progress is to ours: PDM-Closed's, by which both are divided
        for row in rows:
            k = row["proposal"]
            for column, public in LONG.items():
                found = filtered[k][name][COLUMNS.index(column)]
                if column == "ep" and found < 1.0:
                    scales.append(row[public] / found)
                elif column != "ec":
                    assert found == row[public], (name, k, column)
            assert unfiltered[k][name][-1] == pytest.approx(row["pdm_score"], abs=3e-7), (name, k)
        assert scales and np.ptp(scales) < 2e-11, name
        assert abs(scales[0] - 1.0) < 1e-6, name
