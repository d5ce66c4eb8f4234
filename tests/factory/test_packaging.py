"""The wheel holds the right packages and the configuration files, and works far from the checkout."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGED = ("factory", "tasks", "planners", "conf", "tests", "pyproject.toml", "README.md", "LICENSE")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy of the sources: setuptools leaves its traces beside them."""
    pytest.importorskip("setuptools", minversion="77", reason="building without isolation needs setuptools here")
    sources, dist = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("dist")
    for name in PACKAGED:
        if (REPOSITORY / name).is_dir():
            shutil.copytree(REPOSITORY / name, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(REPOSITORY / name, sources / name)
    command = [sys.executable, "-m", "pip", "wheel", "-v", "--no-deps", "--no-build-isolation", "-w", str(dist), "."]
    built = subprocess.run(command, cwd=sources, capture_output=True, text=True, timeout=200)
    assert built.returncode == 0, built.stderr
    assert not re.search(r"Warning: |Deprecat", built.stdout + built.stderr), "setuptools has nothing to complain of"
    return next(dist.glob("*.whl"))


@pytest.mark.slow
def test_the_wheel_holds_every_module_every_setting_and_no_test(wheel: Path) -> None:
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    modules = {
        path.relative_to(REPOSITORY).as_posix()
        for package in ("factory", "tasks", "planners")
        for path in (REPOSITORY / package).rglob("*.py")
    }
    settings = {
        f"factory/conf/{path.relative_to(REPOSITORY / 'conf').as_posix()}"
        for path in (REPOSITORY / "conf").rglob("*.yaml")
    }
    typed = {f"{package}/py.typed" for package in ("factory", "tasks", "planners")}
    page = {path.relative_to(REPOSITORY).as_posix() for path in (REPOSITORY / "factory/views/board/static").iterdir()}
    assert inside == modules | settings | typed | page


@pytest.mark.slow
def test_installed_it_works_beside_a_stranger_s_tasks_py(wheel: Path, tmp_path: Path) -> None:
    target, work = tmp_path / "site", tmp_path / "work"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target)  # what `pip install --no-deps --target` does with a pure wheel
    work.mkdir()
    (work / "tasks.py").write_text("raise RuntimeError('this is the wrong tasks')\n")

    def python(*arguments: str) -> str:
        env = os.environ | {"PYTHONPATH": str(target)}
        done = subprocess.run(
            [sys.executable, *arguments], cwd=work, env=env, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "scenarionet" in python("-m", "factory.run", "--help")
    assert "rounds: 4" in python("-m", "factory.run", "--cfg", "rounds=4", "clips=av2", "clips.root=/logs")
    found = python("-c", "import factory.pipeline, tasks; print(factory.__file__); print(tasks.__file__)").split()
    assert found == [str(target / "factory" / "__init__.py"), str(target / "tasks" / "__init__.py")]
    assert list(work.iterdir()) == [work / "tasks.py"], "nothing is written"
