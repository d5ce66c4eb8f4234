"""The site of the pages: it builds without a warning, and what is made from the code says what the code says."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from factory.commands.table import DOORS
from tests.pages import REPOSITORY

pytest.importorskip("mkdocs", reason='the site needs pip install ".[docs]"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `make docs` builds it: a warning ends it with exit code 1."""
    to = tmp_path_factory.mktemp("site")
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "-q", "-d", str(to)]
    built = subprocess.run(command, cwd=REPOSITORY, env=env, capture_output=True, text=True, timeout=500)
    assert built.returncode == 0 and not built.stdout + built.stderr, built.stdout + built.stderr
    return to


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_site_builds_without_a_warning_and_lists_every_command(site: Path) -> None:
    assert (site / "docs/tutorials/nuscenes/index.html").is_file() and (site / "examples/csv_logs.py").is_file()
    told = (site / "docs/commands/index.html").read_text()
    lost = [name for commands in DOORS.values() for name in commands if f'<h3 id="{name}">' not in told]
    assert not lost
    assert "score_trajectories" in (site / "docs/python/index.html").read_text()
