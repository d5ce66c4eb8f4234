"""Folders that undisturbed runs leave."""

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from tests.factory.graph.runs import run


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The folder that an undisturbed run leaves, made once: to compare with."""

    @cache
    def made(rounds: int, n: int) -> Path:
        out = tmp_path_factory.mktemp("plain") / "out"
        run(out, rounds=rounds, n=n)
        return out

    return lambda rounds=2, n=4: made(rounds, n)


@pytest.fixture
def begun(plain: Callable[..., Path], tmp_path: Path) -> Callable[..., Path]:
    """A copy of such a folder, to go on in."""

    def copied(rounds: int = 2, n: int = 4) -> Path:
        return shutil.copytree(plain(rounds, n), tmp_path / "out")

    return copied
