"""`perturb.starts`: which tables are refused, and a run whose rows follow the table, by name and after a resume."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from factory import run
from factory.config.run import load_config
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.exits import BAD_CONFIG, COMPLETE
from factory.setup.settings import run_identity
from factory.setup.vocabulary import StartTrajectories, load_start_trajectories
from factory.store.samples import Store
from factory.views.sample_text import lineage
from tasks.world.arrays import Array
from tasks.world.vocabulary import FIRST_START, Vocabulary, kinematic_trajectories

TRAJECTORIES = kinematic_trajectories(256, seed=0)


def written(path: Path, rows: list[tuple[Any, Any]]) -> Path:
    lists = [one.tolist() if isinstance(one, np.ndarray) else one for _, one in rows]
    pq.write_table(pa.table({"clip_id": [clip_id for clip_id, _ in rows], "trajectory": lists}), path)
    return path


def test_starts_come_back_by_clip_in_the_order_of_the_file(tmp_path: Path) -> None:
    """And the digest is of what leads where, not of the order of clips or of the file's name."""
    a, b, c = TRAJECTORIES[:3]
    one = load_start_trajectories(str(written(tmp_path / "one", [("y", a), ("x", b), ("y", c)])))
    np.testing.assert_array_equal(one.of_clip["y"], [a, c])
    np.testing.assert_array_equal(one.of_clip["x"], [b])
    assert (
        load_start_trajectories(str(written(tmp_path / "other", [("x", b), ("y", a), ("y", c)]))).digest == one.digest
    )
    assert (
        load_start_trajectories(str(written(tmp_path / "turned", [("x", b), ("y", c), ("y", a)]))).digest != one.digest
    )


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([], "shape"),
        ([("x", TRAJECTORIES[0, :39])], "expected"),
        ([("x", TRAJECTORIES[0]), ("x", TRAJECTORIES[0, :39])], "40 times x, y, heading"),
        ([("x", "fast")], "40 times x, y, heading"),
        ([("x", TRAJECTORIES[0] * np.nan)], "NaN or infinity"),
        ([(7, TRAJECTORIES[0])], "clip_id must be text"),
        ([("x", TRAJECTORIES[k][:, [1, 0, 2]]) for k in range(9)], "motion begins 90 deg off x"),
        ([("no clip of this run", TRAJECTORIES[0])], "none of its 1 clips"),
    ],
)
def test_a_table_of_anything_else_is_refused_in_one_line(
    rows: list[tuple[Any, Any]], said: str, towns: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    starts = written(tmp_path / "starts.parquet", rows)
    assert run.main(words(towns, tmp_path / "out", f"perturb.starts={starts}")) == BAD_CONFIG
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: perturb.starts") and said in line
    assert not (tmp_path / "out" / "samples").exists()


def test_what_is_no_such_file_is_refused_and_so_is_one_beside_the_log_alone(
    towns: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text").write_text("clip_id,trajectory")
    pq.write_table(pa.table({"clip_id": ["x"], "course": [1.0]}), tmp_path / "named")
    wrong = [("gone", "gone"), ("text", "arquet"), ("named", "no column trajectory; it has clip_id, course")]
    for name, said in wrong:
        assert run.main(words(towns, tmp_path / "out", f"perturb.starts={tmp_path / name}")) == BAD_CONFIG
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: perturb.starts={tmp_path / name}: ") and said in line
    assert run.main(words(towns, tmp_path / "out", "perturb.starts=x", "perturb.at_log=true")) == BAD_CONFIG
    assert "leave one out" in capsys.readouterr().err
    assert run.main(words(towns, tmp_path / "out", "perturb.at_log=true", "reward.near_log=true")) == BAD_CONFIG
    assert "reward.near_log" in capsys.readouterr().err


def test_with_starts_clips_are_prepared_anew_and_attempts_have_other_names() -> None:
    """And without, nothing tells that there could be some; where the file lies is no matter."""
    config, vocabulary = load_config([]), Vocabulary(TRAJECTORIES)

    def named(one: StartTrajectories | None) -> tuple[str, str, str]:
        made = run_identity(config, vocabulary, None, one)
        return made.prepare_digest, made.vocabulary_digest, made.settings_hash

    assert named(None)[1] == vocabulary.digest
    assert "perturb.starts" not in run_identity(config, vocabulary, None).settings
    for a, b in ((None, StartTrajectories({}, "0a")), (StartTrajectories({}, "0a"), StartTrajectories({}, "0b"))):
        assert all(x != y for x, y in zip(named(a), named(b), strict=True))


@pytest.fixture(scope="module")
def towns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips of a town without sensors, written once."""
    folder = tmp_path_factory.mktemp("towns")
    SyntheticReader(folder, 2, settings=TownSettings(cameras=(), lidar_beams=0, steps_per_photo=1)).index()
    return folder


def words(towns: Path, out: Path, *more: str) -> list[str]:
    clips = [f"clips.cache_dir={towns}", "clips.n_clips=2", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0"]
    quick = ["experts=[pdm_closed]", "render=none", "reward.labels=none", "vocabulary.k=256", "executor=local"]
    takes_all = ["reward.full=[]", "reward.progress_above=-1", "reward.off_route=false", "reward.after=false"]
    takes_all += ["reward.near_log=false"]
    return [*clips, *quick, *takes_all, f"out={out}", *more]


def lists(store: Store) -> dict[str, list[dict[str, Any]]]:
    """clip_id -> its candidates in order."""
    return {row["clip_id"]: row["candidates"] for row in store.candidates.read().to_pylist()}


def without_place(candidates: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [one | {"index": 0} for one in candidates]


def courses(of: list[dict[str, Any]]) -> Array:
    """Of what the vocabulary led to, the trajectories, last first."""
    return TRAJECTORIES[[one["vocabulary_index"] for one in reversed(of)]]


@pytest.mark.slow
def test_rows_follow_the_table_and_the_same_command_makes_none_again(
    towns: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of two clips has starts: the candidates that it has anyway, the last first."""
    assert run.main(words(towns, tmp_path / "plain")) == COMPLETE
    plain = Store(tmp_path / "plain")
    own, other = sorted(lists(plain))
    starts = written(tmp_path / "starts.parquet", [(own, one) for one in courses(lists(plain)[own])])
    asked = words(towns, tmp_path / "out", f"perturb.starts={starts}")
    capsys.readouterr()
    assert run.main(asked) == COMPLETE
    assert "1 of the 2 clips have some" in capsys.readouterr().out
    store = Store(tmp_path / "out")
    made, n = lists(store), len(lists(plain)[own])
    assert without_place(made[other]) == without_place(lists(plain)[other])
    assert without_place(made[own][n:]) == without_place(lists(plain)[own])
    assert [one["vocabulary_index"] for one in made[own][:n]] == [FIRST_START - i for i in range(n)]
    led_to = [one | {"vocabulary_index": 0} for one in without_place(made[own][:n])]
    assert led_to == [one | {"vocabulary_index": 0} for one in reversed(without_place(lists(plain)[own]))]

    rows = {
        row["clip_id"]: row for row in store.samples.read(["attempt_id", "clip_id", "vocabulary_index"]).to_pylist()
    }
    assert rows[own]["vocabulary_index"] == FIRST_START
    told = {name: str(value) for _, facts in lineage(store, rows[own]["attempt_id"]) for name, value in facts}
    assert (
        told["perturbed by"] == f"start 0 of the clip in perturb.starts {load_start_trajectories(str(starts)).digest}"
    )
    assert not set(store.samples.keys().tolist()) & set(plain.samples.keys().tolist())

    files = sorted(path.name for path in (tmp_path / "out" / "samples").rglob("*.parquet"))
    assert run.main(asked) == COMPLETE
    assert sorted(path.name for path in (tmp_path / "out" / "samples").rglob("*.parquet")) == files
    capsys.readouterr()
    assert run.main(words(towns, tmp_path / "out")) == BAD_CONFIG
    assert "perturb.starts" in capsys.readouterr().err
