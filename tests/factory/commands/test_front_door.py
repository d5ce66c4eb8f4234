"""`python -m factory ...`: one door, suggestions, completion, lineage, retry; exit codes."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
import yaml

from factory.__main__ import main
from factory.commands.completion import completions, setting_choices
from factory.commands.table import COMMANDS, DOORS, PLANNERS
from factory.config.arguments import ComposedCommand
from factory.exits import EXIT_CODE_TEXT
from factory.graph.driver import EpisodeSettings
from factory.graph.execute import Execution
from factory.store.commit_copies import COPIES
from factory.store.samples import CURRENT_RUN, Store
from factory.views.sample_text import prepared_episode
from factory.views.status import failure_summary
from planners.__main__ import main as planners_main
from tasks.caches import json_with_checksum
from tests.factory.filmed import FilmedWork
from tests.factory.toy import ToyWork, executed, refs

REPOSITORY = Path(__file__).resolve().parents[3]
HEAVY = ("numpy", "ray", "torch", "hydra", "omegaconf", "pyarrow", "deltalake", "numba", "cv2", "rich")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Samples with episodes, rejections, an attempt that raised."""
    folder = tmp_path_factory.mktemp("out")
    work = FilmedWork(trouble={"log0:2000:recovery:1": "bug"})
    given = ["executor=local", "episodes=all", f"out={folder}", "rounds=2"]
    store = Store(folder)
    executed(
        work,
        refs(4),
        ["recovery", "human"],
        2,
        store,
        Execution("local", episodes=EpisodeSettings(1, prepared_episode), command=given),
    )
    return folder


def ask(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main(arguments)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def light(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs it where nothing heavy may be imported."""
    script = f"import sys\n{code}\nassert not set({HEAVY}) & set(sys.modules), set({HEAVY}) & set(sys.modules)"
    env = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    return subprocess.run([sys.executable, "-c", script, *arguments], env=env, capture_output=True, text=True)


def test_every_command_is_listed_and_helps_itself_without_heavy_imports() -> None:
    listed = light("from factory.__main__ import main; assert main(['--help']) == 0")
    assert listed.returncode == 0, listed.stderr
    assert all(f"  {name} " in listed.stdout and command.about in listed.stdout for name, command in COMMANDS.items())
    shown = light(
        f"from factory.__main__ import main\nfor name in {list(COMMANDS)}: assert main([name, '--help']) == 0, name"
    )
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.lower().count("exit codes") >= len(COMMANDS)


SHOW_ALL = """
import contextlib, io, os, sys
from factory.commands.table import DOORS, dispatch
for door in DOORS.values():
    for command in door.values():
        command.load()
STARTS = ("subprocess.Popen", "os.posix_spawn", "os.fork", "os.system", "os.exec", "socket.bind", "socket.connect")
WRITES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate")
def watch(event, arguments):
    writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    assert not writes and event not in STARTS + WRITES, (event, arguments)
sys.addaudithook(watch)
for package, door in DOORS.items():
    for name in door:
        with contextlib.redirect_stdout(io.StringIO()) as shown:
            code = dispatch([name, *sys.argv[1:]], door, "")
        print(package, name, code, len(shown.getvalue()))
"""


@pytest.mark.slow
def test_every_command_shows_its_settings_and_neither_writes_nor_starts_anything(tmp_path: Path) -> None:
    env = os.environ | {"PYTHONPATH": str(REPOSITORY), "PYTHONDONTWRITEBYTECODE": "1"}
    script = [sys.executable, "-c", SHOW_ALL, "--cfg"]
    done = subprocess.run(script, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [line[:2] for line in lines] == [[package, name] for package, door in DOORS.items() for name in door]
    assert [line for line in lines if line[2] != "0" or line[3] == "0"] == []
    assert not list(tmp_path.iterdir())


def test_settings_are_shown_as_they_are_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for door, command, shown in (
        (planners_main, "drive --cfg planner=human clips.n_clips=3", {"planner": "human", "seconds": 5.5}),
        (planners_main, "train planner=custom -c job steps=7", {"steps": 7, "seed": 0}),
        (main, "run clips=av2 --cfg rounds=5", {"rounds": 5, "executor": "ray"}),
        (main, "explain --cfg tries=9 traffic=replay", {"clip": "0", "tries": 9, "rounds": 1}),
        (main, "retry out=runs/a --cfg workers=3", {"out": "runs/a", "workers": 3}),
        (main, "show --cfg 3 film=true", {"out": "???", "sample": "3", "film": True}),
    ):
        assert door(command.split()) == 0
        found = yaml.safe_load(capsys.readouterr().out)
        assert {key: found.get(key) for key in shown} == shown
    assert not list(tmp_path.iterdir())


def test_a_plan_is_the_run_s_own_and_makes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[tuple[str, ...], bool]] = []
    monkeypatch.setattr(
        "factory.run.run", lambda asked_of, only_plan: asked.append((asked_of.overrides, only_plan)) or 0
    )
    for name in ("plan", "run"):
        assert main([name, "rounds=2", f"out={tmp_path / 'none'}"]) == 0
    assert asked == [(("rounds=2", f"out={tmp_path / 'none'}"), name == "plan") for name in ("plan", "run")]


def test_a_run_with_failures_ends_with_what_failed_how_often_and_what_shows_all(out: Path) -> None:
    clip_id = next(row["clip_id"] for row in Store(out).outcomes.read().to_pylist() if row["kind"] == "failed")
    assert failure_summary(Store(out)).splitlines() == [
        f"1 failed (bug 1), the first, recovery on clip {clip_id}: ZeroDivisionError: a bug in a stage",
        f"all of them: python -m factory failed out={out}",
    ]


def test_the_page_says_what_every_exit_code_means() -> None:
    page = (REPOSITORY / "docs" / "configuration.md").read_text().partition("## Exit codes")[2]
    rows = re.findall(r"^\| (\d) \| (.*?) \|", page, re.M)
    assert {int(code): meaning for code, meaning in rows} == EXIT_CODE_TEXT


def test_each_door_lists_its_commands_and_names_those_of_the_other(capsys: pytest.CaptureFixture[str]) -> None:
    assert planners_main(["--help"]) == 0
    shown = capsys.readouterr().out
    code, ours, _ = ask(capsys, "--help")
    assert code == 0 and "python -m planners <command>" in ours
    for name, command in PLANNERS.items():
        assert f"  {name} " in shown and f"  {name} " in ours and command.about in shown
        assert callable(command.load())
    modules = {command.module for command in PLANNERS.values() if isinstance(command.function(), ComposedCommand)}
    runnable = {
        ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
        for path in (REPOSITORY / "planners").rglob("*.py")
        if re.search(r"^(@|\w+ = )command\b", path.read_text(), re.M)
    }
    assert modules == runnable, "every command that can be run is listed"
    assert planners_main(["evalute"]) == 2
    assert "did you mean evaluate?" in capsys.readouterr().err
    assert planners_main(["run", "rounds=5"]) == 2
    assert "python -m factory run" in capsys.readouterr().err


def test_lineage_goes_from_the_run_to_the_file(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = Store(out)
    row = next(
        row
        for row in store.samples.read(["attempt_id", "clip_id", "expert", "round", "candidate_index"]).to_pylist()
        if row["expert"] == "recovery" and row["candidate_index"] > row["round"]
    )
    code, text, _ = ask(capsys, "lineage", row["attempt_id"][:12], f"out={out}")
    assert code == 0
    titles = [line for line in text.splitlines() if not line.startswith(" ")]
    assert titles == ["run", "clip", "candidate", "attempt", "sample"]
    facts = dict(line.strip().split(None, 1) for line in text.splitlines() if line.startswith("  "))
    assert facts["clip"] == row["clip_id"] and facts["attempt"] == row["attempt_id"]
    assert facts["round"] == str(row["round"]) and "rejected by reward." in facts["tried"]
    assert Path(facts["file"]).is_file() and (out / facts["episode"]).is_file()
    assert (out / facts["prepared"].split()[-1]).is_file() or "prepared clip" in text


def test_lineage_of_what_is_no_sample_says_what_became_of_it(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rejected = next(o for o in Store(out).outcomes.read().to_pylist() if o["kind"] == "rejected")
    code, text, _ = ask(capsys, "lineage", f"out={out}", f"sample={rejected['attempt_id']}")
    assert code == 0 and "no sample" in text and f"reward.{rejected['reason']}" in text
    assert ask(capsys, "lineage", "zz", f"out={out}")[0] == 2


# Of root alone: it may write whatever its capabilities, which are dropped here, let it.
DROPPED = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"] if os.getuid() == 0 else []
DENIED = "cannot be written: Permission denied"
INSTEAD = "run it as a user who may, or on a copy"


@pytest.fixture(scope="module")
def read_only(out: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The same samples where nobody may write, with a leftover, and something to repair."""
    if DROPPED and shutil.which("setpriv") is None:
        pytest.skip("root may write everywhere, and there is no setpriv to take that away")
    folder = tmp_path_factory.mktemp("read_only") / "run"
    shutil.copytree(out, folder)
    leftover = folder / ".report.html.0.tmp"
    leftover.touch()
    os.utime(leftover, (0, 0))
    copy = folder / "candidates" / COPIES / f"{0:020}.json"
    copy.write_bytes(copy.read_bytes()[:-9])
    rights = {place: place.stat().st_mode for place in (folder, *folder.rglob("*"))}
    for place, mode in rights.items():
        place.chmod(mode & 0o555)
    yield folder
    for place, mode in rights.items():
        place.chmod(mode)


ASK_ALL = """
import contextlib, io, json, sys
from factory.__main__ import main
for argv in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(io.StringIO()):
        code = main(argv)
    print(json.dumps([code, said.getvalue()]))
"""


@pytest.mark.slow
def test_a_run_that_nobody_may_write_to_is_read_and_what_would_write_says_so_in_a_line(
    read_only: Path, tmp_path: Path
) -> None:
    wanted = {
        "report": f"{read_only}/report.html: {DENIED}; {INSTEAD}, or give to=<another place>",
        "clean": f"{read_only}: {DENIED}; {INSTEAD}",
        "compact": f"{read_only}: {DENIED}; {INSTEAD}",
        "verify repair=true": f"{read_only}/candidates/{COPIES}/{0:020}.json: {DENIED}; {INSTEAD}",
        **dict.fromkeys(
            ["retry", "run executor=local", f"import simscale root={read_only}"],
            f"out={read_only}: {DENIED}; {INSTEAD}, or with another out=",
        ),
        "export mcap sample=0 to=.": "",
        "status": "",
    }
    asked = json.dumps([[*words.split(), f"out={read_only}"] for words in wanted])
    script = [*DROPPED, sys.executable, "-c", ASK_ALL, asked]
    env = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(script, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    told = dict(zip(wanted, map(json.loads, done.stdout.splitlines())))
    assert told == {words: [2, f"error: {said}\n"] if said else [0, ""] for words, said in wanted.items()}, done.stderr


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The arguments of every run that a command would begin; none is begun."""
    found: list[list[str]] = []

    def run(argv: Sequence[str]) -> int:
        found.append(list(argv))
        return 0

    monkeypatch.setattr("factory.run.main", run)
    return found


def test_retry_says_what_and_how_and_leaves_the_rest_alone(
    out: Path, asked: list[list[str]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(out)
    code, text, _ = ask(capsys, "retry", f"out={out}")
    assert code == 0 and "1 failed: bug 1" in text and "ZeroDivisionError" in text
    assert f"python -m factory run executor=local episodes=all rounds=2 out={out} retry_failed=true" in text
    assert asked.pop() == ["executor=local", "episodes=all", "rounds=2", f"out={out}", "retry_failed=true"]
    assert ask(capsys, "retry", f"out={out}", "workers=1")[0] == 0
    assert asked == [["executor=local", "episodes=all", "rounds=2", "workers=1", f"out={out}", "retry_failed=true"]]


def test_retry_calls_no_code_that_a_table_alone_names(
    out: Path, asked: list[list[str]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(out)
    location, named = Store(out).location, "+expert.mine._target_=my_package.MyExpert"
    kept = location.read(CURRENT_RUN)
    document = {"folder": str(out), "command": ["rounds=2", named]}
    location.write(CURRENT_RUN, json_with_checksum(document).encode())
    try:
        code, _, error = ask(capsys, "retry", f"out={out}")
        assert code == 2 and named in error and not asked
        assert ask(capsys, "retry", f"out={out}", named)[0] == 0
    finally:
        location.write(CURRENT_RUN, kept or b"{}")
    assert asked == [["rounds=2", named, f"out={out}", "retry_failed=true"]]


def test_retry_of_a_run_without_failures_or_without_a_record_does_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    executed(ToyWork(), refs(1), ["human"], 1, Store(tmp_path / "fine"))
    assert ask(capsys, "retry", f"out={tmp_path / 'fine'}")[:2] == (0, "0 failed\n")
    work = ToyWork(trouble={"log0:0:human:-1": "bug"})
    executed(work, refs(1), ["human"], 1, Store(tmp_path / "old"))
    code, _, error = ask(capsys, "retry", f"out={tmp_path / 'old'}")
    assert code == 2 and "records no settings" in error


def test_completion_knows_commands_keys_groups_and_choices() -> None:
    assert set(completions([], "")) == set(COMMANDS)
    assert {"clips=", "rounds=", "render.width=", "vocabulary.file="} <= set(completions(["run"], ""))
    assert "rounds=" not in completions(["run", "rounds=5"], "")
    assert set(completions(["run"], "clips=")) >= {"clips=av2", "clips=synthetic"}
    assert set(completions(["run"], "executor=")) == {"executor=ray", "executor=local"}
    assert set(completions(["plan"], "on_change=")) == {"on_change=stop", "on_change=keep", "on_change=redo"}
    assert "clips.root=" in completions(["run", "clips=av2"], "") and "clips.root=" not in completions(["run"], "")
    assert set(completions(["show"], "film=")) == {"film=true", "film=false"}
    assert set(completions(["export"], "m")) == {"mcap", "mp4", "navsim"}
    assert {"out=", "workers="} <= set(completions(["retry"], ""))
    assert {"clip=", "clips=", "tries="} <= set(completions(["explain"], ""))
    assert set(completions(["scene"], "")) == {"info", "export", "import", "build", "film", "serve"}
    assert not list(completions(["nothing"], ""))


@pytest.mark.parametrize("package", DOORS)
def test_no_command_does_several_runs_at_once(package: str, capsys: pytest.CaptureFixture[str]) -> None:
    door = {"factory": main, "planners": planners_main}[package]
    for name in DOORS[package]:
        assert door([name, "--multirun", "x=1,2"]) == 2
        assert capsys.readouterr().err.startswith("error: --multirun: a run fills one folder, so several runs are"), (
            name
        )


def test_every_key_that_is_completed_is_one_the_run_takes() -> None:
    from factory.config.run import compose_run

    def has(tree: object, key: str) -> bool:
        for part in key.split("."):
            if not isinstance(tree, dict) or part not in tree:
                return False
            tree = tree[part]
        return True

    groups, settings = {"preset"}, compose_run([])
    unknown = [key for key in setting_choices([]) if key not in groups and not has(settings, key)]
    assert unknown == []


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_the_end_of_the_line(tmp_path: Path) -> None:
    script = tmp_path / "ask.bash"
    script.write_text(
        f'source <("{sys.executable}" -m factory completion bash)\n'
        'asked() { COMP_LINE=$1 COMP_POINT=${#1}; COMPREPLY=(); $2 2>/dev/null; echo "${COMPREPLY[*]}"; }\n'
        "asked 'factory sta' _factory_complete\nasked 'python -m factory run executor=l' _factory_python\n"
        "asked 'factory run clips=sc' _factory_complete\nasked 'python setup.py ' _factory_python\n"
        "asked 'python -m factory.run preset=de' _factory_python\nasked 'planners eva' _factory_complete\n"
    )
    env = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(["bash", str(script)], env=env, capture_output=True, text=True)
    assert done.stdout.splitlines() == ["status", "local", "scenarionet", "", "demo", "evaluate"], done.stderr
