"""Imports point one way: tasks <- factory <- planners."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {
    "tasks": {"factory", "planners", "ray", "hydra", "omegaconf", "deltalake", "pyarrow"},
    "factory": {"planners"},
    "planners": set(),
}


def imported_modules(path: Path) -> set[str]:
    """First words of all absolute imports of a file, lazy ones included."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
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


def test_only_the_graph_its_metrics_and_trainings_on_a_cluster_import_ray() -> None:
    users = {
        str(path.relative_to(ROOT))
        for package in ("factory", "planners")
        for path in (ROOT / package).rglob("*.py")
        if "ray" in imported_modules(path)
    }
    assert users == {"factory/graph.py", "factory/ray_metrics.py", "planners/on_ray.py"}


def test_no_module_shadows_the_standard_library() -> None:
    for package in FORBIDDEN:
        for path in (ROOT / package).rglob("*.py"):
            assert path.stem == "__init__" or path.stem not in sys.stdlib_module_names, path


def loaded_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(' '.join(sorted({{m.split('.')[0] for m in sys.modules}})))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(out.stdout.split())


def test_a_run_in_this_process_needs_no_ray() -> None:
    assert "ray" not in loaded_by("import factory.run, factory.execute, factory.metrics, factory.pipeline")


def test_importing_the_science_needs_numpy_only() -> None:
    heavy = {"numba", "osqp", "cv2", "shapely", "scipy", "torch", "ray", "pyarrow", "hydra"}
    assert not loaded_by("import tasks, tasks.world.clip, tasks.stages") & heavy
