"""What `python -m factory show` answers, and its exit codes."""

import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from factory.commands.table import COMMANDS
from factory.readers.base import ClipRef
from factory.store.samples import Store
from tests.factory.toy import ToyWork, executed, refs

main = COMMANDS["show"].load()
status, failed = COMMANDS["status"].load(), COMMANDS["failed"].load()


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with samples, rejections, a broken clip and an attempt that raised."""
    folder = tmp_path_factory.mktemp("out")
    work = ToyWork(trouble={"log1:1000": "bad", "log0:2000:recovery:1": "bug"})
    executed(work, refs(5), ["recovery", "human"], 2, Store(folder))
    return folder


def ask(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main(arguments)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_status_counts_the_tables(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status([f"out={out}"]) == 0
    text, store = capsys.readouterr().out, Store(out)
    assert f"samples     {len(store.samples)} rows" in text
    assert f"outcomes    {len(store.outcomes)} rows" in text
    assert "failed 2" in text and "exit code 3: complete with failed attempts" in text
    assert "recovery" in text and "nc " in text


def test_list_gives_the_ids_that_sample_takes(out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, text, _ = ask(capsys, f"out={out}", "list=true")
    ids = text.split()
    assert code == 0 and ids == sorted(Store(out).samples)
    by_ordinal = ask(capsys, f"out={out}", "sample=1", f"to={tmp_path}")
    by_id = ask(capsys, f"out={out}", f"sample={ids[1]}", f"to={tmp_path}")
    by_prefix = ask(capsys, ids[1][:12], f"out={out}", f"to={tmp_path}")
    assert by_ordinal == by_id == by_prefix and by_id[0] == 0 and ids[1] in by_id[1]


def test_the_picture_lies_where_it_was_asked_for(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    first = sorted(Store(out).samples)[0]
    assert ask(capsys, f"out={out}", "sample=0")[0] == 0
    assert ask(capsys, f"out={out}", "sample=0", "to=new/x.png")[0] == 0
    for path in (tmp_path / f"sample_{first}.png", tmp_path / "new" / "x.png"):
        assert cv2.imread(str(path)).shape[0] >= 720
    assert ask(capsys, f"out={out}", "sample=0", "to=x.gif")[0] == 2
    assert ask(capsys, f"out={out}", "sample=0", f"to={tmp_path}/sample_{first}.png/x.png")[0] == 2


def test_failed_names_file_field_and_how_to_retry(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert failed([f"out={out}"]) == 0
    text = capsys.readouterr().out
    assert "2 failed: bug 1, input 1" in text
    assert "toy.feather: tx_m: holds NaN" in text and "ZeroDivisionError" in text
    assert text.count("factory retry out=") == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "out=<folder or URL of a run> is missing"),
        (("out={out}",), "python -m factory status shows the run"),
        (("out={out}", "sample=0", "list=true"), "choose one"),
        (("out={out}", "to=x.png", "list=true"), "give sample= too"),
        (("out={out}", "sample=zz"), "no sample zz"),
        (("out={out}", "sample=-1"), "no sample -1"),
    ],
)
def test_a_request_that_cannot_be_answered_ends_with_2_and_says_why(
    out: Path, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, error = ask(capsys, *(a.format(out=out) for a in arguments))
    assert code == 2 and not text and message in error


def test_an_attempt_that_is_no_sample_says_what_became_of_it(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    row = next(o for o in Store(out).outcomes.read().to_pylist() if o["kind"] == "rejected")
    code, _, error = ask(capsys, f"out={out}", f"sample={row['attempt_id']}")
    assert code == 2 and f"rejected attempt of recovery: reward.{row['reason']}" in error


def test_a_store_without_samples_shows_its_status_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    work = ToyWork(trouble={"log0:0": "standing"})
    executed(work, [ClipRef("toy", "log0", 0)], ["human"], 1, Store(tmp_path))
    assert status([f"out={tmp_path}"]) == 0 and capsys.readouterr().out
    for request in ("sample=0", "list=true"):
        code, _, error = ask(capsys, f"out={tmp_path}", request)
        assert code == 2 and "holds no sample" in error


def test_a_run_that_died_is_told_from_one_that_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    executed(ToyWork(), refs(1), ["human"], 1, Store(tmp_path))
    (tmp_path / "last_run.json").unlink()
    assert status([f"out={tmp_path}"]) == 0 and "running, last heard of" in capsys.readouterr().out


@pytest.mark.slow
def test_show_and_status_import_neither_ray_nor_torch(out: Path, tmp_path: Path) -> None:
    asked = [["show", f"out={out}", "sample=0", f"to={tmp_path}"], ["status", f"out={out}"]]
    script = (
        f"import sys; from factory.__main__ import main; codes = [main(argv) for argv in {asked}]; "
        "sys.exit(str(codes) if any(codes) or {'ray', 'torch'} & set(sys.modules) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
