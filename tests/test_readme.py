"""Every page keeps its word: python blocks run, and commands are ones that the programs take.

A command that shows what a run holds is run, on a tiny run as `make demo` makes them. One that makes something is read
by its program's own settings, which refuse what they do not know. What is left out, and why, stands in LEFT_OUT.
"""

import os
import re
import subprocess
import sys
import tomllib
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from examples.csv_logs import write_log
from factory.__main__ import main as door_main
from factory.commands.exchange import ExportRequest, ImportRequest, SceneRequest
from factory.commands.keep import RemakeRequest
from factory.commands.look import DashboardRequest, ExplainRequest
from factory.commands.table import COMMANDS, PLANNERS
from factory.config.arguments import parse
from factory.config.compose import compose, conf_dir, fill
from factory.config.plugins import GROUPS
from factory.config.run import load_config
from factory.datasets.town.reader import SyntheticReader
from factory.run import main as run_main
from factory.stages.warm import PARTS
from planners.__main__ import main as planners_main
from planners.ab.settings import settings_of as ab_settings
from planners.drive.settings import settings_of as drive_settings
from planners.evaluation.compare import CompareSettings
from planners.evaluation.evaluate import settings_of as evaluate_settings
from planners.evaluation.replay import settings_of as replay_settings
from planners.models.settings import settings_of
from planners.published.import_planner import config_of as import_config
from planners.serve import Request as ServeRequest
from planners.training.train import TrainConfig
from tasks.caches import user_cache
from tasks.kernels.compiled import cache_dir
from tasks.render.settings import FitSettings
from tests.bench import bench_gpus
from tests.factory.installs import SMALL, as_if_installed
from tests.pages import PAGES, REPOSITORY, Command, blocks, commands, named_in_prose

ALL_COMMANDS = [command for page in PAGES for command in commands(page)]
IN_PROSE = list(dict.fromkeys(command for page in PAGES for command in named_in_prose(page)))
LOOKS, TRAINS = blocks("README.md", "python")
RUN_ELSEWHERE = {
    "docs/bank.md": "tests/tasks/test_bank.py trains with its step",
    "docs/queries.md": "tests/test_queries.py runs them",
}
LEFT_OUT = {  # program, and why its commands are not read here; the files that they name have to be there
    "kubectl": "needs a cluster; tests/deploy holds its files against their schemas",
    "prometheus": "needs its server; experiments/dashboards runs it",
    "rsync": "copies a folder",
    "export": "sets the shell's variables",
    "echo": "writes to a file of the kernel",
    "git": "makes or moves a checkout",
    "pip": "installs",
    ".venv/bin/pip": "installs",
}
RAY_COMMANDS = {"start", "stop", "status", "up", "dashboard", "get-auth-token"}  # and `ray job`
JOB_COMMANDS = {"submit", "logs", "stop", "list", "status"}
JOB_OPTIONS = {"--address", "--submission-id", "--working-dir", "--no-wait", "--follow"}
MAKE_TARGETS = set(re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.M))
FIT = {field.name for field in fields(FitSettings)} | {"out", "threads"}  # keys of the benches that fit a scene
RUN_HERE = {"runs/demo", "/data/demo", "/archive/demo"}  # what a page calls the folder of its run


@pytest.fixture(scope="module")
def demo_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `runs/demo` as `make demo` leaves it, but of one clip and tiny pictures.

    `cache` is its user's cache; the town of three clips in it is the demo's, with the same tiny pictures.
    """
    home = tmp_path_factory.mktemp("readme")
    town = {"width": 64, "height": 36, "cameras": "[ring_front_center]", "steps_per_photo": 5}
    town |= {"lidar_beams": 16, "lidar_azimuths": 200}
    tiny = "clips.n_clips=1 vocabulary.k=64 experts=[human] render.frames=now render.width=64 render.height=36"
    words = [*tiny.split(), "executor=local", *(f"clips.settings.{key}={value}" for key, value in town.items())]
    assert run_main([*words, f"clips.cache_dir={home / 'towns'}", f"out={home / 'runs' / 'demo'}"]) == 0
    asked_for = SyntheticReader(home / "cache" / user_cache().name / "towns", 3).root
    asked_for.parent.mkdir(parents=True)
    (drawn,) = (home / "towns").iterdir()  # one log, which holds three clips
    asked_for.symlink_to(drawn)
    return home


@pytest.mark.slow
def test_python_that_looks_runs_as_written_in_the_small_install(demo_home: Path, tmp_path: Path) -> None:
    path = f"{as_if_installed(SMALL, tmp_path)}{os.pathsep}{REPOSITORY}"
    env = os.environ | {"PYTHONPATH": path, "XDG_CACHE_HOME": str(demo_home / "cache")}
    env["NUMBA_CACHE_DIR"] = str(cache_dir().parent)  # a cache of its own for towns, but no second compilation
    done = subprocess.run(
        [sys.executable, "-c", LOOKS], cwd=demo_home, env=env, capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", ["as written", "torch.nn.Sequential(torch.nn.Linear(8, 32), torch.nn.Linear(32, 24))"]
)
def test_the_loop_trains_its_model_and_one_of_the_readers_own(
    demo_home: Path, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    monkeypatch.chdir(demo_home)
    before, loop, passes = TRAINS.partition("for batch in ")
    assert "torch.nn.Linear(8, 24)" in before
    names: dict[str, Any] = {}
    exec(before if model == "as written" else before.replace("torch.nn.Linear(8, 24)", model), names)

    def distance() -> float:
        batch = names["data"].collate([names["data"][0]])
        return float((names["model"](batch["status"]) - batch["label_2hz"].flatten(1)).abs().mean().detach())

    at_first = distance()
    for _ in range(50):
        exec(loop + passes, names)
    assert distance() < 0.99 * at_first


@pytest.mark.slow
def test_a_run_leaves_the_card_of_its_data_set(demo_home: Path) -> None:
    text = (demo_home / "runs" / "demo" / "README.md").read_text()
    assert "license: apache-2.0\n" in text and "The run is complete." in text and "vocabulary.k=64" in text
    assert "`synthetic` is drawn test data" in text and "pseudo-expert, not" not in text, "one human sample"


@pytest.mark.parametrize("command", ALL_COMMANDS, ids=str)
def test_every_command_is_one_its_program_takes(
    command: Command, demo_home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = list(command.words)
    assert not (lost := lost_files(words)), f"{lost} are not there"
    if words[:3] == ["ray", "job", "submit"]:
        assert set(options_of(words[: words.index("--")])) <= JOB_OPTIONS
        words = words[words.index("--") + 1 :]
    monkeypatch.chdir(demo_home)
    for given_as in RUN_HERE:
        words = [re.sub(rf"^(out=)?{given_as}$", r"\1runs/demo", word) for word in words]
    match words:
        case ["make", target, *_]:
            assert target in MAKE_TARGETS
        case ["source", *_]:
            assert door_main(["completion", "bash"]) == 0
        case ["python", "-m", "factory"]:
            assert door_main(["--help"]) == 0
        case ["python", "-m", "planners"]:
            assert planners_main(["--help"]) == 0
        case ["python", "-m", "factory", "plan" | "run", *arguments]:
            load_config(given(arguments))
        case ["python", "-m", "factory", "explain", *arguments]:
            load_config(parse(ExplainRequest, arguments).settings)
        case ["python", "-m", "factory", "dashboard", *arguments]:
            parse(DashboardRequest, arguments)  # it would serve until it is stopped
        case ["python", "-m", "factory", "warm", *arguments]:
            assert set(arguments) <= PARTS.keys()
        case ["python", "-m", "factory", "vocabulary", *arguments]:
            assert door_main(["vocabulary", "--help"]) == 0
        case ["python", "-m", "factory", "export", *arguments] if "out=/data/samples" in arguments:
            parse(ExportRequest, arguments)  # a run of NAVSIM's logs
        case ["python", "-m", "factory", "import", *arguments]:
            parse(ImportRequest, arguments)  # its folders are a user's
        case ["python", "-m", "factory", "scene", *arguments]:
            parse(SceneRequest, arguments)  # its files are a user's
        case ["python", "-m", "factory", "remake", *arguments]:
            load_config(parse(RemakeRequest, arguments).settings)  # it would change the others' demo
        case ["python", "-m", "factory", *arguments]:
            assert door_main(arguments) == 0, capsys.readouterr().err
        case ["python", "-m", "factory.run", "--help"]:
            assert run_main(["--help"]) == 0
        case ["python", "-m", "factory.run" | "tests.bench.bench_label_ends", *arguments]:
            load_config(given(arguments))
        case ["python", "-m", "planners", "train", *arguments] | [
            "torchrun",
            "--nproc-per-node",
            "8",
            "-m",
            "planners",
            "train",
            *arguments,
        ]:
            fill(TrainConfig, compose("train", given(arguments)), "train")
        case ["python", "-m", "planners", "import", *arguments]:
            settings_of(import_config(given(arguments)).planner)
        case ["python", "-m", "planners", "evaluate", *arguments]:
            evaluate_settings(arguments)
        case ["python", "-m", "planners", "compare", *arguments]:
            fill(CompareSettings, compose("compare", arguments), "compare")
        case ["python", "-m", "planners", "ab", *arguments]:
            ab_settings(arguments)
        case ["python", "-m", "planners", "replay", *arguments]:
            replay_settings(arguments)
        case ["python", "-m", "planners", "drive", *arguments]:
            drive_settings(arguments)
        case ["python", "-m", "planners", "serve", *arguments]:
            parse(ServeRequest, arguments)  # it would serve until it is stopped
        case ["python", "-m", "tests.bench.bench_scenes", *arguments]:
            assert set(pairs(given(arguments))) <= {"openscene", "front", "kitti", "town", "out", "iterations"}
        case ["python", "-m", "tests.bench.bench_kitti", _, *arguments]:
            assert set(pairs(given(arguments))) <= FIT | {"validate", "first", "last", "by"}
        case ["python", "-m", "tests.bench.bench_gpus", *arguments]:
            parse(bench_gpus.Request, arguments)
        case ["python", "-m", "tests.bench.bench_gate", *arguments]:
            assert set(pairs(arguments)) <= {"chosen", "held", "clips", "out", "drives", "every"}
        case ["python", "-m", "tests.bench.bench_guess", *arguments]:
            assert set(pairs(given(arguments))) <= {"front", "rig", "town", "out"}
        case ["python", "-m", "tests.bench.bench_town", *arguments]:
            assert set(pairs(given(arguments))) <= FIT | {"log", "width", "height", "lpips"}
        case ["python", "-m", "tests.bench.bench_alpasim", _, _, *arguments]:
            assert set(pairs(given(arguments))) <= {"root", "width", "instants"}
        case ["python", "-m", "examples.csv_logs", folder]:
            write_log(Path(folder) / "street")  # what it does, see tests/test_extending.py
        case ["python", "-m", module] if module.startswith("tests.bench."):
            assert find_spec(module) is not None  # it measures for minutes
        case ["ray", "job", action, *rest]:
            assert action in JOB_COMMANDS and set(options_of(rest)) <= JOB_OPTIONS
        case ["ray", action, *_]:
            assert action in RAY_COMMANDS
        case [program, *_]:
            assert program in LEFT_OUT, f"no program takes {' '.join(words)}"


@pytest.mark.parametrize("command", IN_PROSE, ids=str)
def test_every_command_named_in_prose_is_there(command: Command) -> None:
    match list(command.words):
        case ["make", "bench", *named]:
            modules = [word.replace("NAME=", "tests.bench.bench_") for word in named if word.startswith("NAME=")]
            assert all(find_spec(module) for module in modules)
        case ["make", target, *_]:
            assert target in MAKE_TARGETS
        case ["python", "-m", "factory", subcommand, *_]:
            assert subcommand in COMMANDS or subcommand == "--version"
        case ["python", "-m", "planners", subcommand, *_]:
            assert subcommand in PLANNERS
        case ["python", "-m", module, *_]:
            assert find_spec(module) is not None
        case ["ray", "job", action, *_]:
            assert action in JOB_COMMANDS


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python") and page != "README.md"])
def test_python_of_other_pages_is_run_elsewhere_or_compiles(page: str) -> None:
    assert page in RUN_ELSEWHERE
    for block in blocks(page, "python"):
        compile(block, page, "exec")


def test_the_groups_of_entry_points_are_those_that_are_looked_for() -> None:
    (block,) = blocks("docs/extend.md", "toml")
    assert set(tomllib.loads(block)["project"]["entry-points"]) == set(GROUPS.values())


def test_the_table_of_groups_lists_every_choice() -> None:
    text = (REPOSITORY / "docs/configuration.md").read_text()
    table = text[text.index("| group | choices |") :].partition("\n\n")[0]
    told = {row[1].strip(" `"): set(re.findall(r"`(\w+)`", row[2])) for row in split_rows(table)[2:]}
    there = {name: {path.stem for path in (conf_dir() / name).glob("*.yaml")} for name in told}
    assert told == there
    in_run = {path.name for path in conf_dir().iterdir() if path.is_dir()} - {"mix", "planner"}  # those of planners
    assert set(told) == in_run


def split_rows(table: str) -> list[list[str]]:
    return [re.split(r"(?<!\\)\|", line) for line in table.splitlines()]


def test_defaults_in_the_tables_of_settings_are_the_settings_own() -> None:
    text = (REPOSITORY / "docs/configuration.md").read_text()
    told = dict(re.findall(r"^\| `([\w.]+)=([\w.]+)` \(default\)", text, re.M))
    told |= dict(re.findall(r"^\| `([\w.]+)=[^`]*` \|[^|]*`(\w+)` \(default\)", text, re.M))
    assert len(told) >= 4, told
    config = load_config([])
    for key, value in told.items():
        owner: Any = config
        for part in key.split("."):
            owner = getattr(owner, part)
        assert type(owner)(value) == owner, key


def lost_files(words: list[str]) -> list[str]:
    """Files of this project that a command reads and that are not there; what a run writes is none of them."""
    named = (word.rpartition("=")[2] for word in words if not word.startswith(("out=", "report=", "to=")))
    return [name for name in named if name.startswith(("deploy/", "docs/")) and not (REPOSITORY / name).exists()]


def options_of(words: list[str]) -> list[str]:
    return [word for word in words if word.startswith("--")]


def given(arguments: list[str]) -> list[str]:
    """Without what stands for the user's own, and what is no setting."""
    return [argument for argument in arguments if argument not in ("...", "--cfg")]


def pairs(arguments: list[str]) -> dict[str, str]:
    return dict(argument.split("=", 1) for argument in arguments)


def test_there_is_something_to_check() -> None:
    assert len(ALL_COMMANDS) >= 60 and len(IN_PROSE) >= 40
    assert {"README.md", "docs/extend.md", "deploy/RUNBOOK.md"} <= {command.page for command in ALL_COMMANDS}
