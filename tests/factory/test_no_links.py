"""File systems without hard links or locks: refused before anything is written, or worked around."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from factory.exits import BAD_CONFIG, COMPLETE
from tests.chaos.file_steps import compiler
from tests.factory.datasets.navsim import simscale_writer
from tests.factory.graph.runs import run
from tests.pages import REPOSITORY

pytestmark = pytest.mark.skipif(compiler() is None, reason="links are refused on Linux, with a C compiler")
SOURCE = REPOSITORY / "tests" / "chaos" / "no_links.c"
Command = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def mount(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose file system has neither links nor locks, for commands alone."""
    return tmp_path_factory.mktemp("mount")


@pytest.fixture(scope="module")
def command(mount: Path, tmp_path_factory: pytest.TempPathFactory) -> Command:
    library = tmp_path_factory.mktemp("library") / "no_links.so"
    subprocess.run([str(compiler()), "-O1", "-shared", "-fPIC", "-o", library, SOURCE, "-ldl"], check=True)
    env = os.environ | {"LD_PRELOAD": str(library), "NO_LINKS_BELOW": str(mount)}

    def answered(*words: str) -> "subprocess.CompletedProcess[str]":
        arguments = [sys.executable, *words]
        return subprocess.run(arguments, cwd=REPOSITORY, env=env, capture_output=True, text=True, timeout=250)

    return answered


@pytest.fixture(scope="module")
def made(mount: Path) -> Path:
    """A run that was made on a better file system and copied there; one of the files that it keeps is damaged."""
    run(mount / "made")
    next((mount / "made" / "cache").rglob("*.clip")).write_bytes(b"")
    return mount / "made"


def all_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def said_of(folder: Path) -> str:
    return f"{folder} is on a file system without hard links (Operation not permitted), by which commits keep two runs "


@pytest.mark.slow
def test_a_new_folder_without_hard_links_is_refused_before_anything_is_written(
    command: Command, mount: Path, tmp_path: Path
) -> None:
    simscale_writer.write_log(tmp_path, "synthetic_reaction_pdm_v1.0-0", 1, 0)
    out = mount / "new" / "out"
    for words in (
        ["factory", "run", "clips.n_clips=1", "executor=local", "render=none"],
        ["factory", "import", "simscale", f"root={tmp_path}"],
        ["planners", "drive", "planner=constant_velocity"],
    ):
        done = command("-m", *words, f"out={out}")
        assert (done.returncode, done.stdout) == (BAD_CONFIG, ""), (words, done.stderr)
        assert (
            done.stderr
            == f"error: out={out}: {said_of(out)}apart: choose a folder on another one, or the URL of "
            + ("a bucket (s3://, gs://, abfs://)\n")
        )
        assert not (mount / "new").exists()


@pytest.mark.slow
def test_what_was_copied_there_can_be_read_and_is_not_changed(command: Command, made: Path) -> None:
    before = all_in(made)
    assert command("-m", "factory", "status", f"out={made}").returncode == COMPLETE
    for name, *words in (["compact"], ["clean", "older_than=0min"], ["verify", "repair=true"]):
        done = command("-m", "factory", name, f"out={made}", *words)
        assert (done.returncode, "taken out" in done.stdout) == (BAD_CONFIG, False), done.stderr
        assert done.stderr.startswith(f"error: {said_of(made)}")
        assert all_in(made) == before


@pytest.mark.slow
def test_a_block_is_built_by_one_process_at_a_time_where_the_file_system_has_no_locks(
    command: Command, mount: Path
) -> None:
    counter = mount / "counter"
    done = command("-c", COUNTED, str(mount / "cache" / "block-1.npz"), str(counter))
    assert done.returncode == 0, done.stderr
    assert counter.read_text() == "100"


COUNTED = """
import os, sys
from pathlib import Path
from factory.stages.assets import builder_lock

block, counter = map(Path, sys.argv[1:])
counter.write_text("0")
children = []
for _ in range(4):
    if child := os.fork():
        children.append(child)
        continue
    for _ in range(25):
        with builder_lock(block):
            counter.write_text(str(int(counter.read_text()) + 1))
    os._exit(0)
assert not any(os.waitpid(child, 0)[1] for child in children)
"""
