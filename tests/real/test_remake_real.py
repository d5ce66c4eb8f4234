"""Pictures, labels and gate made again of runs on real logs, one after the other: the rows of a run made so at once."""

import shutil
from pathlib import Path

import pytest

from factory.commands.table import COMMANDS
from factory.exits import COMPLETE
from factory.store.reader import SampleTable
from tests.factory.tables import assert_same_tables

pytestmark = pytest.mark.slow

LOG = "sd_nuscenes_v1.0-mini_scene-0103.pkl"


def runs_of(data: Path, name: str) -> tuple[list[str], list[str]]:
    """A run's settings, and other ones of its pictures."""
    human = f"vocabulary.file={data / 'vocabulary/human_8192x40x3.npy'}"
    common = [human, "experts=[pdm_closed,recovery]", "executor=local", "reward.labels=none"]
    if name == "av2":
        clips = ["clips=av2", f"clips.root={data / 'av2/sensor'}", "render=map", "limit=2"]
        return [*clips, *common], ["render.width=128"]
    clips = ["clips=scenarionet", f"clips.root={data / name / LOG}", f"clips.cameras={data / name}", "limit=2"]
    drawn = ["render.scene=discs", "render.psnr_min=0", "render.gate.enabled=false", "render.frames=now"]
    sizes = [[f"render.width={width}", f"render.height={height}"] for width, height in ((128, 72), (96, 54))]
    return [*clips, *drawn, *sizes[0], *common], sizes[1]


@pytest.mark.parametrize("name", ["av2", "nuscenes_front"])
def test_a_real_log_s_stages_made_again_are_as_if_the_run_had_been_made_so(
    shared_root: Path, tmp_path: Path, name: str
) -> None:
    def ask(command: str, *words: object) -> None:
        assert COMMANDS[command].load()([str(word) for word in words]) == COMPLETE

    words, render = runs_of(shared_root / "data", name)
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
