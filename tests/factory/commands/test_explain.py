"""`explain` tells the run's own decisions: what is rejected before the attempts, and logs that cannot be read."""

import re
import shutil
from pathlib import Path

import pytest

from factory import pipeline
from factory.commands.table import COMMANDS
from factory.config.run import load_config
from factory.setup.settings import assemble

main = COMMANDS["explain"].load()


@pytest.fixture(scope="module")
def logs(small_town: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip's log and a copy of it with broken annotations."""
    folder = tmp_path_factory.mktemp("logs")
    (log,) = (path for path in small_town.iterdir() if path.is_dir())
    for name in (log.name, "broken"):
        shutil.copytree(log, folder / name)
    (folder / "broken" / "annotations.feather").write_bytes(b"no table")
    return folder


def arguments(logs: Path, out: Path, *more: str) -> list[str]:
    size = ["render.width=64", "render.height=36", "render.scene=discs", "vocabulary.k=300"]
    size += ["render.psnr_min=0", "render.gate.vehicle_min=0", "render.gate.guessed_max=1"]
    return ["clips=av2", f"clips.root={logs}", f"out={out}", *size, *more]


@pytest.mark.slow
def test_a_block_below_the_gate_is_why_there_are_no_candidates(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gated = arguments(logs, tmp_path, "render.psnr_min=60", f"to={tmp_path}")
    assert main([*gated, "clip=0"]) == 0
    said = capsys.readouterr().out
    assert "no candidates: rejected by render: psnr: " in said and "held-out photos at " in said and "below 60" in said
    assert main([*gated, "clip=0", "expert=human"]) == 0  # the human drive is a sample all the same
    told = capsys.readouterr().out
    assert "rejected by render: psnr" in told and "candidate -1  accepted" in told


@pytest.mark.slow
def test_a_clip_whose_route_ends_is_told_as_the_run_tells_it(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "has_route", lambda centerline: False)
    assert main([*arguments(logs, tmp_path), "clip=0"]) == 0
    assert "rejected by clip: route_ended: the log ends at the end of its route" in capsys.readouterr().out


def test_a_broken_log_is_found_and_told_in_the_index_s_words(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ((ref, said),) = assemble(load_config(arguments(logs, tmp_path))).index.broken.items()
    assert main([*arguments(logs, tmp_path), f"clip={ref.clip_id[:8]}"]) == 3
    assert capsys.readouterr().err == f"bad clip: {said}\n"


@pytest.mark.slow
def test_a_walk_that_ends_at_the_limit_says_so_and_how_to_go_on(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def told(*more: str) -> tuple[list[str], list[str]]:
        """(lines of candidates, lines on where the walk stopped)."""
        assert main([*arguments(logs, tmp_path), "render=none", "vocabulary.k=100", f"to={tmp_path}", *more]) == 0
        lines = capsys.readouterr().out.splitlines()
        return [line for line in lines if line.startswith("candidate ")], [line for line in lines if "stopped" in line]

    never = "reward.progress_above=2.0"
    tried, stopped = told(never, "tries=2")
    assert len(tried) == 2 and all("rejected by reward" in line for line in tried)
    (said,) = stopped
    match = re.fullmatch(r"none accepted: stopped after 2 of (\d+) candidates, tries=\1 goes on to the last", said)
    assert match, said
    n = int(match[1])
    tried, stopped = told(never, f"tries={n}")
    assert len(tried) == n > 2 and not stopped
    tried, stopped = told("tries=2", "reward.full=[]", "reward.progress_above=-1")
    assert len(tried) == 1 and tried[0].endswith("accepted") and not stopped, "it stopped because it had what it wanted"
