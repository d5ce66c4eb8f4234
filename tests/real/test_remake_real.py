"""Stages of a run on a real log made again, one after the other: the rows of a run made so at once."""

import shutil
from pathlib import Path

import pytest

from factory.commands.table import COMMANDS
from factory.exits import COMPLETE
from factory.store.reader import SampleTable
from tests.factory.tables import assert_same_tables

pytestmark = pytest.mark.slow


def test_a_real_log_s_stages_made_again_are_as_if_the_run_had_been_made_so(shared_root: Path, tmp_path: Path) -> None:
    def ask(command: str, *words: object) -> None:
        assert COMMANDS[command].load()([str(word) for word in words]) == COMPLETE

    data = shared_root / "data"
    words = ["clips=av2", f"clips.root={data / 'av2/sensor'}", "render=map", "limit=2", "reward.labels=none"]
    words += ["experts=[pdm_closed,recovery]", "executor=local"]
    words += [f"vocabulary.file={data / 'vocabulary/human_8192x40x3.npy'}"]
    render = ["render.width=128"]
    remade, fresh, vocabulary = tmp_path / "remade", tmp_path / "fresh", tmp_path / "kinematic.npy"
    label = ["reward.labels=vocabulary", f"reward.label_vocabulary={vocabulary}"]
    gate = ["reward.progress_above=0.9", "reward.after=false"]
    ask("vocabulary", "kinematic=true", "k=200", f"out={vocabulary}")
    ask("run", *words, f"out={remade}")
    n_before = len(SampleTable(remade))
    for stage, given in (("render", render), ("label", label), ("gate", gate)):
        ask("remake", stage, f"out={remade}", *given)
    shutil.copytree(remade / "cache", fresh / "cache")  # scenes, which are the dear part, under their inputs' digests
    ask("run", *words, *render, *label, *gate, f"out={fresh}")
    assert_same_tables(remade, fresh)
    assert n_before and len(SampleTable(fresh))
