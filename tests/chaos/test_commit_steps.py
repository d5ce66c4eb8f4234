"""A few of the faults of tests.chaos.commit_steps."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from factory.store import location
from tests.chaos.commit_steps import FINE, RUNS, Run, disturbed, new_store, undisturbed
from tests.chaos.file_steps import FAULTS, Stepped, compiler, stepping

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(compiler() is None, reason="steps are counted on Linux, with a C compiler"),
]
EACH = 2  # faults of a kind


@pytest.fixture(scope="module")
def stepped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stepped]:
    with stepping(tmp_path_factory.mktemp("library"), "tests.chaos.commit_steps") as process:
        yield process


@pytest.mark.parametrize("run", RUNS, ids=[run.name for run in RUNS])
def test_a_fault_at_any_step_leaves_old_or_new_and_the_same_command_ends_the_same(
    run: Run, stepped: Stepped, tmp_path: Path
) -> None:
    golden = undisturbed(run, tmp_path, stepped)
    steps = dict.fromkeys(FAULTS, golden.steps)
    steps["half written, then killed"] = [step for step in golden.steps if step.n_bytes > 1]
    for place, (fault, chosen) in enumerate(steps.items()):
        for step in chosen[(1 + place) * len(chosen) // 20 :: len(chosen) // EACH]:
            told = disturbed(golden, step.number, fault, tmp_path / "trial", stepped)
            assert told in FINE, f"{step} {fault}: {told}"


def test_steps_are_those_of_python_and_of_delta_rs(stepped: Stepped, tmp_path: Path) -> None:
    steps = undisturbed(RUNS[0], tmp_path, stepped).steps
    links = [step.path for step in steps if step.call == "link"]
    assert f"samples/_delta_log/{0:020}.json" in links and all("/_delta_log/" in path for path in links)
    renamed = [step.path for step in steps if step.call == "rename"]
    assert {"run.json", "last_run.json", f"samples/_commits/{0:020}.json"} <= set(renamed)


def in_place(out: str) -> int:
    """The run, with files that are written under their own names."""

    @contextmanager
    def no_draft(path: Path, n_bytes: int) -> Iterator[Path]:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield path

    location.atomic_file = no_draft
    return new_store(out)


in_place.__module__ = "tests.chaos.test_commit_steps"  # as another process imports it


def test_what_is_not_written_whole_is_told_of(stepped: Stepped, tmp_path: Path) -> None:
    golden = undisturbed(Run("in place", in_place), tmp_path, stepped)
    torn = next(step for step in golden.steps if step.call == "write" and step.path.startswith("run.json"))
    told = disturbed(golden, torn.number, "half written, then killed", tmp_path / "trial", stepped)
    assert "run.json" in told and told not in FINE, told
