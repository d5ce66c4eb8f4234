"""README.md and docs/configuration.md keep their word: python blocks run, commands are ones the programs take."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from factory.__main__ import main as door_main
from factory.arguments import parse
from factory.clips.synthetic.reader import SyntheticReader
from factory.config import compose, fill
from factory.dashboard import Request as DashboardRequest
from factory.explain import split_arguments
from factory.export import main as export_main
from factory.report import main as report_main
from factory.run import main as run_main
from factory.settings import load_config
from factory.show import main as show_main
from planners.agreement import AgreementSettings
from planners.analysis import AnalysisSettings
from planners.compare import CompareSettings
from planners.evaluate import settings_of as evaluate_settings
from planners.replay import settings_of as replay_settings
from planners.scaling import ScalingSettings
from planners.train import TrainConfig
from tasks.caches import user_cache
from tasks.kernels import cache_dir
from tests.factory.installs import SMALL, as_if_installed

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "CONTRIBUTING.md", "docs/configuration.md", "docs/dashboard.md", "docs/training.md")


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of that language ('' where none is named), in order."""
    text = (REPOSITORY / page).read_text()
    return [body for named, body in re.findall(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S) if named == language]


def commands(page: str) -> list[list[str]]:
    """The command lines of the unnamed blocks as lists of words: continued lines joined, comments left out."""
    joined = "\n".join(blocks(page, "")).replace("\\\n", " ")
    return [words for line in joined.splitlines() if (words := shlex.split(line, comments=True))]


ALL_COMMANDS = [command for page in PAGES for command in commands(page)]
PYTHON_BLOCKS = blocks("README.md", "python")


@pytest.fixture(scope="module")
def demo_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `runs/demo` as `make demo` leaves it, but of one clip and tiny pictures.

    `cache` is its user's cache; the town of three clips in it is the demo's, with the same tiny pictures.
    """
    home = tmp_path_factory.mktemp("readme")
    tiny = (
        "clips.n_clips=1",
        f"clips.cache_dir={home / 'towns'}",
        "clips.settings.width=64",
        "clips.settings.height=36",
        "clips.settings.cameras=[ring_front_center]",
        "vocabulary.k=64",
        "experts=[human]",
        "render.frames=now",
        "render.width=64",
        "render.height=36",
        "executor=local",
    )
    assert run_main([*tiny, f"out={home / 'runs' / 'demo'}"]) == 0
    asked_for = SyntheticReader(home / "cache" / user_cache().name / "towns", 3).root
    asked_for.parent.mkdir(parents=True)
    (drawn,) = (home / "towns").iterdir()  # one log, which holds three clips
    asked_for.symlink_to(drawn)
    return home


@pytest.mark.parametrize("block", PYTHON_BLOCKS, ids=range(len(PYTHON_BLOCKS)))
def test_python_runs_as_written_in_the_small_install(demo_home: Path, tmp_path: Path, block: str) -> None:
    path = f"{as_if_installed(SMALL, tmp_path)}{os.pathsep}{REPOSITORY}"
    env = os.environ | {"PYTHONPATH": path, "XDG_CACHE_HOME": str(demo_home / "cache")}
    env["NUMBA_CACHE_DIR"] = str(cache_dir().parent)  # a cache of its own for towns, but no second compilation
    done = subprocess.run(
        [sys.executable, "-c", block], cwd=demo_home, env=env, capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_a_run_leaves_the_card_of_its_data_set(demo_home: Path) -> None:
    text = (demo_home / "runs" / "demo" / "README.md").read_text()
    assert "license: apache-2.0\n" in text and "The run is complete." in text and "vocabulary.k=64" in text
    assert "`synthetic` is drawn test data" in text and "pseudo-expert, not" not in text, "one human sample"


@pytest.mark.parametrize("command", ALL_COMMANDS, ids=" ".join)
def test_every_command_is_one_its_program_takes(
    command: list[str], demo_home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if command[:3] == ["ray", "job", "submit"]:
        assert command[3:6] == ["--working-dir", ".", "--"]
        command = command[6:]
    match command:
        case ["make", target]:
            assert re.search(rf"^{target}:", (REPOSITORY / "Makefile").read_text(), re.M)
        case ["source", *_]:
            assert door_main(["completion", "bash"]) == 0
        case ["python", "-m", "factory"]:
            assert door_main(["--help"]) == 0
        case ["python", "-m", "factory", "plan" | "run", *arguments]:
            load_config(given(arguments))
        case ["python", "-m", "factory", *arguments]:
            monkeypatch.chdir(demo_home)
            assert door_main(arguments) == 0, capsys.readouterr().err
        case ["python", "-m", "factory.run", "--help"]:
            assert run_main(["--help"]) == 0
        case ["python", "-m", "factory.run", *arguments]:
            load_config(given(arguments))
        case ["python", "-m", "factory.explain", *arguments]:
            load_config(split_arguments(arguments)[1])
        case ["python", "-m", "factory.show", *arguments]:
            monkeypatch.chdir(demo_home)
            assert show_main(arguments) == 0, capsys.readouterr().err
        case ["python", "-m", "factory.export", *arguments]:
            monkeypatch.chdir(demo_home)
            assert export_main(arguments) == 0, capsys.readouterr().err
        case ["python", "-m", "factory.dashboard", *arguments]:
            parse(DashboardRequest, arguments)
        case ["python", "-m", "factory.report", *arguments]:
            monkeypatch.chdir(demo_home)
            assert report_main(arguments) == 0, capsys.readouterr().err
        case ["python", "-m", "planners.train", *arguments] | [
            "torchrun",
            "--nproc-per-node",
            "8",
            "-m",
            "planners.train",
            *arguments,
        ]:
            fill(TrainConfig, compose("train", given(arguments)), "train")
        case ["python", "-m", "planners.evaluate" | "planners.ensemble", *arguments]:
            evaluate_settings([argument for argument in arguments if not argument.startswith("models=")])
        case ["python", "-m", "planners.compare", *arguments]:
            fill(CompareSettings, compose("compare", arguments), "compare")
        case ["python", "-m", "planners.agreement", *arguments]:
            fill(AgreementSettings, dict(argument.split("=", 1) for argument in arguments), "agreement")
        case ["python", "-m", "planners.scaling", *arguments]:
            fill(ScalingSettings, compose("scaling", arguments), "scaling")
        case ["python", "-m", "planners.replay", *arguments]:
            replay_settings(arguments)
        case ["python", "-m", "planners.analysis", *arguments]:
            fill(AnalysisSettings, dict(argument.split("=", 1) for argument in arguments), "analysis")
        case _:
            pytest.fail(f"no program takes {' '.join(command)}")


def given(arguments: list[str]) -> list[str]:
    """Without what stands for the user's own, and what is no setting."""
    return [argument for argument in arguments if argument not in ("...", "--cfg")]


def test_there_is_something_to_check() -> None:
    assert len(PYTHON_BLOCKS) == 2
    assert len(ALL_COMMANDS) >= 20
