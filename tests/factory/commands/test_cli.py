"""The command line from anywhere: beside a stranger's tasks.py, without heavy imports, with plain errors."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from factory.run import main as run_main

REPOSITORY = Path(__file__).resolve().parents[3]


def python(cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    return subprocess.run([sys.executable, *arguments], cwd=cwd, env=env, capture_output=True, text=True, timeout=120)


@pytest.fixture
def strange_folder(tmp_path: Path) -> Path:
    """Python puts it first on the path, and its tasks.py is not ours."""
    (tmp_path / "tasks.py").write_text("raise RuntimeError('this is the wrong tasks')\n")
    return tmp_path


def test_help_and_settings_work_beside_a_stranger_s_tasks_py(strange_folder: Path) -> None:
    shown = python(strange_folder, "-m", "factory.run", "--cfg", "rounds=4")
    assert shown.returncode == 0, shown.stderr
    assert "rounds: 4" in shown.stdout
    assert list(strange_folder.iterdir()) == [strange_folder / "tasks.py"], "nothing is written"


@pytest.mark.slow
def test_the_whole_machine_loads_beside_a_stranger_s_tasks_py(strange_folder: Path) -> None:
    loaded = python(strange_folder, "-c", "import factory.pipeline, tasks; print(tasks.__file__)")
    assert loaded.stdout.strip() == str(REPOSITORY / "tasks" / "__init__.py"), loaded.stderr


def test_help_names_the_settings_and_loads_nothing_heavy(strange_folder: Path) -> None:
    code = (
        "import sys, factory.run; assert factory.run.main(['--help']) == 0; "
        "print('loaded', [m for m in ('torch', 'ray', 'hydra', 'numba', 'pyarrow', 'cv2') if m in sys.modules])"
    )
    done = python(strange_folder, "-c", code)
    assert done.stdout.splitlines()[-1] == "loaded []", done.stderr
    for word in ("rounds", "experts", "executor", "limit", "on_change", "scenarionet"):
        assert word in done.stdout


@pytest.mark.parametrize(
    ("override", "named"), [("round=3", "round"), ("render.width=0", "width"), ("perturb.epdms_min=1.5", "epdms_min")]
)
def test_a_bad_command_ends_with_two_names_the_key_and_writes_nothing(
    tmp_path: Path, override: str, named: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_main([override, "out=here"]) == 2
    assert named in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_what_main_returns_is_what_the_program_ends_with(tmp_path: Path) -> None:
    done = python(tmp_path, "-m", "factory.run", "round=3", "out=here")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
