"""One stage of a finished run again: the table is that of a run made so from the start, whatever ends it meanwhile."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from deltalake import DeltaTable

from factory.commands.table import COMMANDS
from factory.exits import BAD_CONFIG, COMPLETE
from factory.store.reader import SampleTable
from factory.store.remake import stage_of_change
from factory.store.samples import CURRENT_RUN, LAST_RUN, REMADE, Store
from factory.store.verify import verify
from tasks.caches import json_with_checksum
from tests.factory.tables import assert_same_rows, assert_same_tables, tables_of

pytestmark = pytest.mark.slow

# Two clips of the town with photos and lidar, so that there are photos, renderings and pictures that are refused.
WORDS = ["clips=synthetic", "clips.n_clips=2", "clips.settings.cameras=[ring_front_center]", "clips.settings.width=96"]
WORDS += ["clips.settings.height=54", "clips.settings.lidar_beams=32", "clips.settings.lidar_azimuths=450", "rounds=2"]
WORDS += ["render.scene=discs", "render.psnr_min=10", "render.camera_psnr_min=0", "render.width=96", "render.height=54"]
WORDS += ["render.frames=now", "vocabulary.k=512", "executor=local"]
CHANGED = {
    "render": ["render.width=64", "render.height=48"],
    "label": ["vocabulary.k=512"],  # and the file of the fixture
    "gate": ["reward.near_log=false", "reward.after=false", "reward.progress_above=0.8"],
}


def ask(command: str, *words: object) -> int:
    return COMMANDS[command].load()([str(word) for word in words])


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, and beside it a vocabulary to label."""
    out = tmp_path_factory.mktemp("remake") / "base"
    assert ask("vocabulary", "kinematic=true", "k=200", "seed=5", f"out={out.parent / 'others.npy'}") == COMPLETE
    assert ask("run", *WORDS, f"out={out}") == COMPLETE
    assert len(Store(out).samples) > 8 and "render" in Store(out).outcomes.read(["stage"])["stage"].to_pylist()
    return out


@pytest.fixture
def out(base: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(base, tmp_path / "out"))


def changed(base: Path, stage: str) -> list[str]:
    return [*CHANGED[stage], *([f"reward.label_vocabulary={base.parent / 'others.npy'}"] if stage == "label" else [])]


@pytest.fixture(scope="module")
def fresh(base: Path) -> dict[str, Path]:
    """Stage -> a run that was made so from the start, of the same prepared clips and scenes."""
    made = {stage: base.parent / stage for stage in CHANGED}
    for stage, folder in made.items():
        shutil.copytree(base / "cache", folder / "cache")
        assert ask("run", *WORDS, *changed(base, stage), f"out={folder}") == COMPLETE
    return made


def without_tries(tables: list[list[Any]]) -> list[list[dict[str, Any]]]:
    """Of a killed run the attempt in hand counts as tried once more."""
    return [[{name: value for name, value in row.items() if name != "tries"} for row in rows] for rows in tables]


def tasks_of(out: Path) -> dict[str, int]:
    """Stage -> tasks of the newest run."""
    return {stage: told["tasks"] for stage, told in Store(out).newest_run().last["seconds"].items()}


@pytest.mark.parametrize("stage", CHANGED)
def test_a_stage_made_again_is_as_if_the_run_had_been_made_so(
    out: Path, base: Path, fresh: dict[str, Path], stage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before, words = Store(base).samples.read().sort_by("attempt_id"), changed(base, stage)
    assert ask("remake", stage, f"out={out}", *words) == COMPLETE
    assert_same_tables(out, fresh[stage])
    made, n_samples = tasks_of(out), len(Store(out).samples)
    assert made.get("render", 0) < tasks_of(base)["render"] if stage != "render" else made["render"] >= n_samples
    assert made.get("labels", 0) == n_samples if stage == "label" else made.get("labels", 0) < n_samples
    assert stage == "gate" or made["reward"] < tasks_of(base)["reward"]  # what was refused is not driven again

    (record,) = [record[REMADE] for record in Store(out).runs() if REMADE in record]
    assert record["stages"] == [stage] and record["settings_hash"] == before["settings_hash"][0].as_py()
    old = SampleTable(out, version=record["versions"]["samples"])
    assert_same_rows(old.table(), before)
    capsys.readouterr()
    assert ask("lineage", 0, f"out={out}") == COMPLETE
    assert f"samples {record['versions']['samples']}" in capsys.readouterr().out

    assert ask("run", *WORDS, *words, f"out={out}") == COMPLETE
    assert "and 0 attempts" in capsys.readouterr().out
    assert ask("remake", stage, f"out={out}", *words) == COMPLETE
    assert "every row is of these settings already" in capsys.readouterr().out
    assert ask("run", *WORDS, f"out={out}") == BAD_CONFIG
    assert ask("status", f"out={out}") == ask("show", 0, f"out={out}", f"to={out.parent}") == COMPLETE

    assert not DeltaTable(str(out / "samples")).vacuum(dry_run=True)
    assert ask("clean", f"out={out}", "older_than=0min") == COMPLETE
    assert_same_rows(SampleTable(out, version=record["versions"]["samples"]).table(), before)
    assert not verify(Store(out)).damage and not verify(Store(out)).orphans
    assert ask("clean", f"out={out}", "older_than=0min", "replaced=true") == COMPLETE
    with pytest.raises(OSError):
        SampleTable(out, version=record["versions"]["samples"])
    assert_same_tables(out, fresh[stage])


def test_two_stages_one_after_the_other_or_at_once_are_the_same(out: Path, base: Path, tmp_path: Path) -> None:
    both = Path(shutil.copytree(out, tmp_path / "both"))
    assert ask("remake", "label", f"out={out}", *changed(base, "label")) == COMPLETE
    assert ask("remake", "gate", f"out={out}", *changed(base, "gate")) == COMPLETE
    assert ask("remake", "label", "gate", f"out={both}", *changed(base, "label"), *CHANGED["gate"]) == COMPLETE
    assert_same_tables(out, both)
    assert [record[REMADE]["stages"] for record in Store(out).runs()[1:]] == [["label"], ["gate"]]


@pytest.mark.parametrize(("stage", "commits"), [("label", 0), ("gate", 1), ("label", 2)])
def test_killed_at_any_moment_the_same_command_makes_the_same_rows(
    out: Path, base: Path, fresh: dict[str, Path], stage: str, commits: int
) -> None:
    """Killed before its first commit of rows, or behind so many."""
    words = ["remake", stage, f"out={out}", *changed(base, stage), "shard_seconds=0.01"]
    process = subprocess.Popen([sys.executable, "-m", "factory", *words], stdout=subprocess.DEVNULL)
    try:
        while not any(REMADE in record for record in Store(out).runs()):
            assert process.poll() is None
            time.sleep(0.01)
        (versions,) = [record[REMADE]["versions"] for record in Store(out).runs() if REMADE in record]
        while commits and (Store(out).samples.version or 0) < versions["samples"] + 1 + commits:
            assert process.poll() is None
            time.sleep(0.01)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    left = Store(out).samples.read(["settings_hash"])["settings_hash"].to_pylist()
    assert Store(out).runs()[0]["settings_hash"] in left
    assert ask("run", *WORDS, *changed(base, stage), f"out={out}") == BAD_CONFIG  # half of it is of other settings
    assert ask("clean", f"out={out}", "older_than=0min", "replaced=true") == BAD_CONFIG
    assert ask(*words) == COMPLETE
    (samples, *others), (wanted, *others_wanted) = tables_of(out), tables_of(fresh[stage])
    assert_same_rows(samples, wanted)
    assert without_tries(others) == without_tries(others_wanted)
    assert not verify(Store(out)).damage


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["render", "reward.near_log=false"], "reward.near_log: True -> False: of gate, not render: remake gate too"),
        (["gate", "render.width=64"], "render.width: 96 -> 64: of render, not gate"),
        (["label", "seed=3"], "seed: 0 -> 3: the drives depend on it, so this is a new run"),
        (["gate", "reward.after=false", "rounds=1"], "rounds=2 of expert pdm_closed, this asks for 1"),
        (["gate", "reward.after=false", "experts=[human]"], "this asks for 0"),
        (["gate", "reward.after=false", "limit=1"], "1 of its clips"),
        (["pictures", "render.width=64"], "the stages are render, label, gate"),
    ],
)
def test_what_is_no_remake_of_the_stage_is_refused_in_one_line(
    out: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    version = Store(out).samples.version
    assert ask("remake", *words, f"out={out}") == BAD_CONFIG
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert Store(out).samples.version == version


def test_a_run_that_goes_on_or_is_not_finished_is_refused(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    location, asked = Store(out).location, ["remake", "gate", f"out={out}", "reward.after=false"]
    current, last = (Store(out).document(name) for name in (CURRENT_RUN, LAST_RUN))
    location.write(LAST_RUN, json_with_checksum(last | {"exit_code": 4}).encode())
    assert ask(*asked) == BAD_CONFIG and "its run is not finished" in capsys.readouterr().err
    now = {"began_ms": int(time.time() * 1000)}
    location.write(CURRENT_RUN, json_with_checksum(current | now).encode())
    assert ask(*asked) == BAD_CONFIG and "a run is writing here" in capsys.readouterr().err


def test_each_change_is_of_one_stage_or_of_the_drives() -> None:
    named = {"render.gate.enabled": "render", "stage version render": "render", "reward.labels": "label"}
    named |= {"reward.label_vocabulary": "label", "reward.full": "gate"}
    assert {name: stage_of_change(f"{name}: a -> b") for name in named} == named
    for name in ("perturb.k", "vocabulary", "traffic.mode", "stage version reward", "inputs of expert recovery"):
        assert stage_of_change(f"{name}: a -> b") is None
