"""What a release hands out: the built files hold what they should, and work in an environment of their own."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from factory.store.samples import Store
from tasks.kernels.compiled import cache_dir
from tests.factory.filmed import FilmedWork
from tests.factory.installs import REPOSITORY, SMALL, link_closure
from tests.factory.toy import executed, refs

pytestmark = pytest.mark.slow

COPIED = (
    *("factory", "tasks", "planners", "conf", "tests"),
    *("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"),
)
BUILD = "import sys; from setuptools import build_meta; getattr(build_meta, sys.argv[1])(sys.argv[2])"
Answer = subprocess.CompletedProcess[str]
Call = Callable[..., Answer]  # program of the environment, its words


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """The sdist, the wheel from it and the checkout's wheel, by the calls that pip and build make.

    Built from a copy: setuptools leaves its traces beside the sources.
    """
    sources = tmp_path_factory.mktemp("sources")
    for name in COPIED:
        if (REPOSITORY / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(REPOSITORY / name, sources / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(REPOSITORY / name, sources / name)

    def build(what: str, of: Path, suffix: str) -> Path:
        dist = tmp_path_factory.mktemp("dist")
        command = [sys.executable, "-c", BUILD, what, str(dist)]
        done = subprocess.run(command, cwd=of, capture_output=True, text=True, timeout=200)
        assert done.returncode == 0, done.stderr
        assert not re.search(r"Warning: |Deprecat", done.stdout + done.stderr), "setuptools has nothing to complain of"
        (file,) = dist.glob(f"*{suffix}")
        return file

    sdist, unpacked = build("build_sdist", sources, ".tar.gz"), tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as archive:
        archive.extractall(unpacked, filter="data")
    (folder,) = unpacked.iterdir()
    return sdist, build("build_wheel", folder, ".whl"), build("build_wheel", sources, ".whl")


def environment(extra: str, wheel: Path, folder: Path) -> Call:
    """A venv with the wheel and what an install with that extra brings, and nothing else; an empty home.

    pip installs the wheel; what it would download is linked from here instead, file by file, and pip looks whether that
    is all. Of this user's the compiled kernels alone are found, where NUMBA_CACHE_DIR is not given as something else.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True, timeout=60)
    programs, home = folder / "venv" / "bin", folder / "home"
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    link_closure(extra, site)
    pip = [sys.executable, "-m", "pip", "--python", str(programs / "python")]
    subprocess.run([*pip, "install", "-q", "--no-index", "--no-deps", wheel], check=True, timeout=100)
    subprocess.run([*pip, "check"], check=True, timeout=100)
    home.mkdir()
    env = {"HOME": str(home), "PATH": os.defpath, "NUMBA_CACHE_DIR": str(cache_dir().parent)}

    def call(program: str, *words: str, cwd: Path, **more: str) -> Answer:
        command = [programs / program, *words]
        return subprocess.run(command, cwd=cwd, env=env | more, capture_output=True, text=True, timeout=200)

    return call


def test_the_wheel_holds_every_module_every_setting_and_no_test(built: tuple[Path, Path, Path]) -> None:
    sdist, wheel, of_checkout = built
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
    first, second = (
        {name: archive.read(name) for name in archive.namelist()}
        for archive in map(zipfile.ZipFile, (wheel, of_checkout))
    )
    assert first == second, "from the sdist as from the checkout"
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in first)
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert names >= inside | {"CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md"}
    assert not any(name.startswith(("tests", "experiments", "runs")) for name in names)


NEED_RUN = (
    "run preset=demo",
    "run preset=demo --cfg",
    "explain preset=demo clip=0",
    "vocabulary clips=synthetic out=v.npy",
)
ASK_ALL = f"""
import contextlib, io, json
from factory.__main__ import main
for words in {NEED_RUN}:
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(words.split())
    print(json.dumps([code, said.getvalue(), "run"]))
"""
LOOK = """
from factory.__main__ import main
from factory.store.reader import SampleTable
for words in ("status", "failed", "lineage sample=0", "show sample=0 to=.", "report", "verify", "export mcap sample=0"):
    assert main([*words.split(), "out=out"]) == 0, words
assert main(["vocabulary", "--help"]) == main(["run", "--help"]) == 0
assert SampleTable("out")[0]["label_2hz"].shape == (8, 3)
"""
COMPILE = "from tasks.world.geometry import to_segment; print(to_segment(0.0, 2.0, 0.0, 0.0, 4.0, 0.0))"


def test_the_small_install_looks_at_a_finished_run_and_names_the_extra_that_it_lacks(
    built: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    call, work, kernels = environment(SMALL, built[1], tmp_path), tmp_path / "work", tmp_path / "kernels"
    work.mkdir()
    asked = call("python", "-c", ASK_ALL, cwd=work)
    told = [json.loads(line) for line in asked.stdout.splitlines()]
    assert len(told) == len(NEED_RUN), asked.stderr
    nonsense = call("factory", "explian", cwd=work)
    assert nonsense.returncode == 2 and nonsense.stderr.endswith("did you mean explain?\n"), nonsense.stderr
    for planners in (("python", "-m", "planners.training.train", "out=x"), ("planners", "train")):
        trained = call(*planners, cwd=work)
        told.append([trained.returncode, trained.stderr, "planners"])
    for code, said, extra in told:
        assert code == 2 and said.startswith("error: ") and said.count("\n") == 1, said
        assert f'pip install "driving-data-factory[{extra}]"' in said, said
    assert call("python", "-c", COMPILE, cwd=work, NUMBA_CACHE_DIR=str(kernels)).stdout == "(2.0, 0.0)\n"
    assert [*kernels.rglob("tasks/world/geometry/to_segment*.kernel")]
    assert "explain" in call("factory", "--help", cwd=work).stdout
    assert not [*work.iterdir()], "nothing is written"
    executed(FilmedWork(), refs(2), ["recovery", "human"], 1, Store(work / "out"))
    looked = call("python", "-c", LOOK, cwd=work)
    assert looked.returncode == 0, looked.stderr
    assert {path.suffix for path in work.iterdir()} >= {".png", ".mcap"}


TINY = """
clips.n_clips=1 clips.settings.cameras=[ring_front_center] clips.settings.width=64 clips.settings.height=36
clips.settings.steps_per_photo=5 clips.settings.lidar_beams=0
render=painter render.width=64 render.height=36 vocabulary.k=64 experts=[recovery,human] workers=1
"""
READ = """
import sys, factory, tasks
from factory.store.reader import SampleTable, image_of
table = SampleTable("out")
print(sorted(table[i]["expert"] for i in range(len(table))), image_of(table[0], "ring_front_center", 0.0).shape)
print(all(module.__file__.startswith(sys.prefix) for module in (factory, tasks)))
"""


@pytest.mark.ray
def test_the_install_that_runs_makes_samples_beside_a_stranger_s_tasks_py(
    built: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    call, work = environment("run", built[1], tmp_path), tmp_path / "work"
    work.mkdir()
    (work / "tasks.py").write_text("raise RuntimeError('this is the wrong tasks')\n")
    shown = call("factory", "run", "--cfg", "rounds=4", "clips=av2", "clips.root=/logs", cwd=work)
    assert "rounds: 4" in shown.stdout, shown.stderr
    assert "scenarionet" in call("python", "-m", "factory.run", "--help", cwd=work).stdout
    assert [*work.iterdir()] == [work / "tasks.py"], "nothing is written"
    made = call("factory", "run", *TINY.split(), "out=out", cwd=work)
    assert made.returncode == 0, made.stderr
    read = call("python", "-c", READ, cwd=work)
    assert read.stdout == "['human', 'recovery'] (36, 64, 3)\nTrue\n", read.stdout + read.stderr
