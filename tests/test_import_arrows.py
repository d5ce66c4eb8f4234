"""Imports point one way: tasks <- factory <- planners, and inside a package from its upper rooms to its lower ones."""

import ast
import graphlib
import re
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from factory.commands.table import COMMANDS, PLANNERS

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {
    "tasks": {"factory", "planners", "ray", "hydra", "omegaconf", "deltalake", "pyarrow"},
    "factory": {"planners"},
    "planners": set(),
}
# Of each package the rooms from the ground up: a module imports from its own room and those below it.
ROOMS = {
    "tasks": (
        *("caches", "subscores", "stages", "settings", "kernels", "world", "rollout", "reward"),
        *(
            "quadratic",
            "experts",
            "perturb",
            "attempt",
            "hard_scenes",
            "trajectories",
            "bank_traffic",
            "bank",
            "bank_tensors",
        ),
        *("render.settings", "render.splatting", "render.scene", "render.rig", "render.fit", "render"),
    ),
    "factory": (
        *("exits", "wording", "files"),
        *("readers.settings", "config", "readers", "store"),
        *("graph", "datasets", "stages", "pipeline", "setup", "datasets.navsim", "views", "views.board"),
        *("alpasim", "run", "commands", "__main__"),
    ),
    "planners": (
        *("data", "models", "training", "published"),
        *("evaluation", "navsim", "alpasim", "drive", "traffic", "serve", "ab", "__main__"),
    ),
}
MOST_MODULES = 20  # in a room


@cache
def nodes(path: Path) -> list[ast.stmt]:
    """Imports and classes of a file, wherever they stand in it."""
    wanted = ast.Import, ast.ImportFrom, ast.ClassDef
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, wanted)]


def imported_modules(path: Path) -> set[str]:
    """First words of all absolute imports of a file, lazy ones included."""
    names = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_arrow_points_backwards(package: str) -> None:
    for path in sorted((ROOT / package).rglob("*.py")):
        wrong = imported_modules(path) & FORBIDDEN[package]
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def modules() -> dict[str, Path]:
    """Dotted name -> file of every module of the project; a package goes by the name of its folder."""
    paths = [path.relative_to(ROOT) for package in FORBIDDEN for path in (ROOT / package).rglob("*.py")]
    return {".".join(path.with_suffix("").parts).removesuffix(".__init__"): ROOT / path for path in paths}


def arrows() -> dict[str, set[str]]:
    """Module -> modules of the project that it imports, lazily or not."""
    known = modules()
    found: dict[str, set[str]] = {}
    for name, path in known.items():
        found[name] = set()
        for node in nodes(path):
            if isinstance(node, ast.Import):
                found[name] |= {alias.name for alias in node.names} & known.keys()
            elif isinstance(node, ast.ImportFrom) and node.module in known:
                inside = {f"{node.module}.{alias.name}" for alias in node.names} & known.keys()
                found[name] |= inside or {node.module}
    return found


def test_no_room_imports_from_one_above_it() -> None:
    floors = {f"{package}.{room}": i for package, rooms in ROOMS.items() for i, room in enumerate(rooms)}

    def floor(module: str) -> int:
        rooms = [room for room in floors if f"{module}.".startswith(f"{room}.")]
        assert rooms, f"{module} is in no room of ROOMS"
        return floors[max(rooms, key=len)]

    for name, imported in arrows().items():
        package, *inside = name.split(".")
        for other in imported if package in ROOMS and inside else ():
            if other.startswith(f"{package}."):
                assert floor(other) <= floor(name), f"{name} imports {other}, which is above it"


def test_imports_never_go_round_in_a_circle() -> None:
    circles = {name: imported for name, imported in arrows().items() if name.startswith(tuple(ROOMS))}
    list(graphlib.TopologicalSorter(circles).static_order())  # raises CycleError with the circle


def test_rooms_are_small_enough_to_be_looked_at() -> None:
    rooms = {path.parent for name, path in modules().items() if name.startswith(tuple(ROOMS))}
    for room in rooms:
        files = [path for path in room.glob("*.py") if path.stem != "__init__"]
        assert len(files) <= MOST_MODULES, f"{room.relative_to(ROOT)} has {len(files)} modules"


def test_a_class_s_name_means_one_thing() -> None:
    """A module of a command has its own Request; a Protocol may bear the name of the class that it describes."""
    where: dict[str, list[str]] = {}
    for module, path in modules().items():
        for node in nodes(path):
            if isinstance(node, ast.ClassDef) and "Protocol" not in map(ast.unparse, node.bases):
                where.setdefault(node.name, []).append(module)
    asked = {command.module for command in (*COMMANDS.values(), *PLANNERS.values())}
    others = [module for module in where.pop("Request") if module not in asked]
    assert not others, f"{others} take a command's word for what it was asked"
    twice = {name: found for name, found in where.items() if len(found) > 1}
    assert not twice, f"one word for one thing, docs/glossary.md: {twice}"


def test_only_the_graph_its_metrics_and_trainings_on_a_cluster_import_ray() -> None:
    users = {
        str(path.relative_to(ROOT))
        for package in ("factory", "planners")
        for path in (ROOT / package).rglob("*.py")
        if "ray" in imported_modules(path)
    }
    graph = {"factory/graph/on_ray/graph.py"}
    assert users == graph | {"planners/training/on_ray.py"}


def test_nothing_but_a_data_set_s_own_folder_and_navsim_s_agent_names_a_data_set() -> None:
    """What the rest asks of one, factory.config.datasets finds by the folder's name."""
    own = "factory/datasets/", "planners/navsim/"
    paths = [path for path in modules().values() if not path.relative_to(ROOT).as_posix().startswith(own)]
    naming = [path.relative_to(ROOT) for path in paths if re.search(r"factory[./]datasets[./]\w", path.read_text())]
    assert len(paths) > 200 and not naming


def test_no_module_shadows_the_standard_library() -> None:
    for package in FORBIDDEN:
        for path in (ROOT / package).rglob("*.py"):
            assert path.stem == "__init__" or path.stem not in sys.stdlib_module_names, path


def loaded_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(' '.join(sorted({{m.split('.')[0] for m in sys.modules}})))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(out.stdout.split())


@pytest.mark.slow
def test_a_run_in_this_process_needs_no_ray() -> None:
    assert "ray" not in loaded_by("import factory.run, factory.graph.execute, factory.graph.progress, factory.pipeline")


def test_importing_the_science_needs_numpy_only() -> None:
    heavy = {"numba", "daqp", "cv2", "shapely", "scipy", "torch", "ray", "pyarrow", "hydra"}
    assert not loaded_by("import tasks, tasks.world.clip, tasks.stages") & heavy


NOT_OURS = {  # what the benchmarks' peers need, in environments of their own
    "tests.bench.peer_navsim": "navsim",
    "tests.bench.peer_simagents": "tensorflow",
    "tests.bench.peer_traffic": "navsim",
}
IMPORTING = """
import importlib, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except ImportError as error:
        print(name, error.name, error, sep=": ")
"""


@pytest.mark.slow
def test_every_program_of_the_tests_imports() -> None:
    """Benchmarks and trials that no test runs break unseen otherwise."""
    files = sorted(path.relative_to(ROOT) for path in (ROOT / "tests").rglob("*.py"))
    names = [".".join(path.with_suffix("").parts) for path in files if not path.name.startswith(("test_", "conftest"))]
    assert {"tests.bench.__main__", "tests.bench.bench_reward", "tests.chaos.commit_steps"} <= set(names)
    words = [sys.executable, "-c", IMPORTING, *names]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    failed = dict(line.split(": ", 2)[:2] for line in done.stdout.splitlines())
    assert failed.items() <= NOT_OURS.items(), done.stdout


def test_every_program_that_the_makefile_runs_is_there() -> None:
    named = re.findall(r"-m ((?:tests|factory|planners|experiments)[\w.]*)", (ROOT / "Makefile").read_text())
    assert len(named) >= 10 and all(map(find_spec, named))
