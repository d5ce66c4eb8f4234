"""examples/ do what they say: each is run through the command that its first lines name."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.csv_logs import CsvReader, write_log
from examples.keep_gap import KeepGap
from examples.keep_lane import KeepLane
from examples.linear_planner import LinearPlanner
from factory.config.compose import compose, fill
from factory.config.run import load_config
from factory.readers.base import BadClip
from factory.run import main as run_main
from factory.setup.settings import open_reader
from factory.store.reader import SampleTable
from planners.models.planner import build_planner
from planners.models.settings import PlannerChoice
from planners.training.checkpoint import load_planner
from planners.training.train import main as train_main
from tasks.experts.protocol import Plan
from tasks.kernels.compiled import cache_dir
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out, traffic_record
from tasks.stages import Rejected
from tasks.world.clip import scene_of_clip
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track
from tests.tasks.streets import street_clip

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted(path for path in (ROOT / "examples").glob("*.py"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The samples of one log of the CSV reader, driven by the example's expert and the human."""
    home = tmp_path_factory.mktemp("examples")
    write_log(home / "logs" / "street")
    own = "clips=custom clips._target_=examples.csv_logs.CsvReader experts=[keep_lane,human] "
    own += "+expert.keep_lane._target_=examples.keep_lane.KeepLane +expert.keep_lane.settle_m=12"
    small = "render=none reward.labels=none vocabulary.k=256 executor=local limit=1"
    assert run_main([*own.split(), *small.split(), f"+clips.root={home / 'logs'}", f"out={home / 'out'}"]) == 0
    return home


@pytest.mark.slow
def test_the_reader_and_the_expert_make_samples_of_a_map_of_one_s_own(made: Path) -> None:
    table = SampleTable(made / "out")
    rows = [table[i] for i in range(len(table))]
    assert {row["expert"] for row in rows} == {"keep_lane", "human"}
    assert {row["dataset"] for row in rows} == {"csv"} and {row["licence"] for row in rows} == {"yours"}
    kept = next(row for row in rows if row["expert"] == "keep_lane")
    assert set(kept["route_lane_ids"]) == {"left", "right"}


def test_the_planner_trains_on_them(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = "planner=custom planner.name=examples.linear_planner:LinearPlanner +planner.settings.history=true"
    small = "planner.training.batch_size=2 steps=3 workers=1 device=cpu"
    data = [f"data.real=[{made / 'out'}]", f"data.sim=[{made / 'out'}]", f"out={made / 'linear'}"]
    assert train_main([*own.split(), *small.split(), *data]) == 0, capsys.readouterr().err
    assert type(load_planner(made / "linear")) is LinearPlanner  # as planners.evaluation.evaluate loads it


def test_a_data_set_is_a_reader_and_a_file_of_its_settings(tmp_path: Path) -> None:
    write_log(tmp_path / "logs" / "street")
    (tmp_path / "conf" / "clips").mkdir(parents=True)
    settings = "name: csv\n_target_: examples.csv_logs.CsvReader\nroot: ???\nstride_s: 0.5\n"
    (tmp_path / "conf" / "clips" / "csv.yaml").write_text(settings)
    config = load_config([f"--config-dir={tmp_path / 'conf'}", "clips=csv", f"clips.root={tmp_path / 'logs'}"])
    reader, index = open_reader(config.clips)
    assert isinstance(reader, CsvReader) and {ref.dataset for ref in index.refs} == {"csv"}
    assert [ref.start_ms for ref in index.refs] == [0, 500, 1000, 1500, 2000]


def test_a_planner_is_its_class_and_a_file_of_its_settings(tmp_path: Path) -> None:
    (tmp_path / "planner").mkdir()
    settings = "name: examples.linear_planner:LinearPlanner\nsettings: {history: false}\n"
    (tmp_path / "planner" / "linear.yaml").write_text(settings + "training: {epochs: 3}\n")
    composed = compose("train", [f"--config-dir={tmp_path}", "planner=linear"])["planner"]
    choice = fill(PlannerChoice, {key: composed[key] for key in ("name", "settings")}, "planner")
    planner = build_planner(choice, {})
    assert type(planner) is LinearPlanner and planner.settings.history is False


def test_a_traffic_policy_is_a_class_that_the_settings_name() -> None:
    """It slows down behind the ego that stands ahead, its rear at x = 20.9, and keeps its speed where nobody does."""
    settings = TrafficSettings(mode="custom", policy="examples.keep_gap:KeepGap")
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=8.0), ego=(22.0, 0.0, 0.0))
    ego = np.repeat(scene.ego_state[None], 41, axis=0)
    behind, free = (
        roll_out(prepare_traffic(scene, settings), ego + away).agents for away in (0.0, [0.0, 500.0] + [0.0] * 9)
    )
    assert free.velocities[:, 0, 0] == pytest.approx(8.0) and free.boxes[-1, 0, 0] == pytest.approx(32.0)
    assert behind.velocities[-1, 0, 0] < 1.0 and behind.boxes[-1, 0, 0] + 2.3 < 20.8
    assert traffic_record(settings)["policy"] == f"examples.keep_gap:KeepGap {KeepGap().digest()}"


@pytest.mark.slow
def test_the_script_scores_plans_without_ray_or_hydra() -> None:
    code = "import examples.score_plans, sys\nassert not {'ray', 'hydra', 'torch'} & set(sys.modules)"
    env = os.environ | {"NUMBA_CACHE_DIR": str(cache_dir().parent)}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = {line[:20].strip(): line.split()[-6:] for line in done.stdout.splitlines()[1:5]}
    nc, dac, score = ({name: float(row[i]) for name, row in told.items()} for i in (0, 1, 5))
    assert nc["rams the car ahead"] == 0.0 and dac["leaves the road"] == 0.0
    assert max(score, key=lambda name: score[name]) == "goes on" and score["stands"] < 0.7
    assert "stands, alone in its batch: ep 1.00" in done.stdout


def test_keep_lane_is_on_the_centreline_after_some_seconds_and_refuses_what_is_off_the_route() -> None:
    clip = street_clip()
    scene = scene_of_clip(clip)
    beside = scene.ego_history.copy()
    beside[:, 1] = 1.0
    plan = KeepLane().plan(replace(scene, ego_history=beside), np.random.default_rng(0))
    assert isinstance(plan, Plan) and plan.poses.shape == (40, 3)
    np.testing.assert_allclose(plan.poses[:, 0], 0.8 * np.arange(1, 41), atol=1e-6)
    np.testing.assert_allclose(plan.poses[:, 1], np.exp(-0.8 * np.arange(1, 41) / 15.0), atol=1e-6)
    beside[:, 1] = 8.0
    refused = KeepLane().plan(replace(scene, ego_history=beside), np.random.default_rng(0))
    assert refused == Rejected("expert", "off_route", "8.0 m beside the centreline")


def test_the_reader_names_file_and_field_of_what_is_wrong(tmp_path: Path) -> None:
    write_log(tmp_path / "street")
    (ref, *_) = CsvReader(tmp_path).index().refs
    for name, old, new, told in (
        ("map.json", '"right": [[', '"rigth": [[', r"map\.json: map: KeyError\('right'\)"),
        ("ego.csv", ",0,0,8.0", ",north,0,8.0", r"ego\.csv: y: expected a column of numbers: .*north"),
    ):
        file = tmp_path / "street" / name
        file.write_text((whole := file.read_text()).replace(old, new))
        with pytest.raises(BadClip, match=told):
            CsvReader(tmp_path).read(ref)
        file.write_text(whole)


def test_every_example_says_how_it_is_run_and_is_short() -> None:
    assert len(EXAMPLES) == 5
    for path in EXAMPLES:
        text = path.read_text()
        assert re.search(r"python -m (factory\.|planners |examples\.)", text.split('"""')[1]), path.name
        assert len(text.splitlines()) < 220, path.name
