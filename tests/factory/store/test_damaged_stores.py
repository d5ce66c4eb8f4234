"""verify survives every damage and names the file; a repair takes out what was damaged, and the run makes it again."""

import json
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pyarrow as pa
import pytest
from google.protobuf.timestamp_pb2 import Timestamp

from factory.commands.table import COMMANDS
from factory.exits import BAD_CONFIG, COMPLETE, DAMAGED
from factory.graph.driver import EpisodeSettings
from factory.graph.execute import Execution, execute
from factory.store.commit_copies import CommitCopies
from factory.store.episodes import Message, episode_bytes
from factory.store.location import DamagedFile, Location, write_shard
from factory.store.reader import SampleTable
from factory.store.samples import Store
from factory.store.schema import SAMPLES
from factory.store.table import AnotherWriter
from factory.store.verify import damaged_logs, restore_logs, verify
from tasks.caches import json_with_checksum
from tests.factory.damage import damaged
from tests.factory.data_folders import add_companions
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork, executed, refs

check = COMMANDS["verify"].load()


EPISODE = episode_bytes([Message("/a", 0, Timestamp(seconds=1))], {"id": "a"})


def run(out: Path, *, clips: int = 3) -> int:
    made = EpisodeSettings(1, lambda row, clip: EPISODE)
    experts, quiet = ["recovery", "human"], lambda line: None
    return execute(
        ToyWork(), refs(clips), experts, 2, Store(out), Execution("local", episodes=made), say=quiet
    ).exit_code


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("golden") / "out"
    assert run(out) == COMPLETE
    return out


@pytest.fixture
def out(golden: Path, tmp_path: Path) -> Path:
    shutil.copytree(golden, tmp_path / "out")
    return tmp_path / "out"


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    code = check(list(arguments))
    return code, capsys.readouterr().out


def files(out: Path, pattern: str) -> list[Path]:
    return sorted(path for path in out.glob(pattern) if path.is_file())


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["_delta_log", "_commits"])
def test_every_damage_of_a_log_is_named_and_put_back(out: Path, folder: str) -> None:
    location = Store(out).location
    for path in files(out, f"*/{folder}/*"):
        whole, name = path.read_bytes(), str(path.relative_to(out))
        copies = [*damaged(whole, every=max(50, len(whole) // 20)), None]
        for content in copies:
            path.unlink() if content is None else path.write_bytes(content)
            if content is None and folder == "_commits" and not path.name.startswith("0" * 20):
                path.write_bytes(whole)  # the newest copy is gone: its writer was killed before it wrote it
                continue
            assert [found.name for found in damaged_logs(location)] == [name]
            assert restore_logs(location) == [name] and path.read_bytes() == whole and not damaged_logs(location)


@pytest.mark.parametrize("seed", range(4))
def test_one_pass_names_every_flipped_bit_and_one_repair_heals_them_all(
    out: Path, golden: Path, seed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of nearly all files, logs and their copies at once among them; pages for people are made anew in any case."""
    rng = random.Random(seed)
    kept = [path for path in files(out, "**/*") if path.suffix != ".html" and path.name != "README.md"]
    hit = rng.sample(kept, len(kept) * 2 // 3)
    for path in hit:
        content = bytearray(path.read_bytes())
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        path.write_bytes(content)
    code, said = told(capsys, str(out))
    assert code == DAMAGED and [path for path in hit if str(path.relative_to(out)) not in said] == []
    code, said = told(capsys, str(out), "repair=true")
    assert (code, "DAMAGED" in said) == (COMPLETE, False), said
    assert told(capsys, str(out))[0] == COMPLETE
    assert run(out) == COMPLETE
    assert_same_tables(out, golden)


def test_the_command_says_so_and_repairs_a_log(out: Path, golden: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = files(out, "samples/_delta_log/*.json")[-1]
    whole = path.read_bytes()
    for content in (b"\xff" * 100, whole.replace(b'"size":', b'"sire":'), whole[:-30], None):
        path.unlink() if content is None else path.write_bytes(content)
        code, said = told(capsys, str(out))
        assert code == DAMAGED and f"DAMAGED samples/_delta_log/{path.name}: is " in said
        code, said = told(capsys, str(out), "repair=true")
        assert code == COMPLETE and f"put back samples/_delta_log/{path.name}" in said
    assert_same_tables(out, golden)


@pytest.mark.parametrize("path", ["../../kept", "", "{}/kept", "file://{}/kept", "round=0/../../../kept"])
def test_no_file_outside_a_table_is_of_it_and_none_is_taken_out(
    out: Path, path: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (kept := out.parent / "kept").write_bytes(b"of somebody else")
    shutil.rmtree(out / "samples" / "_commits")  # a stranger may make them match the log as well
    log = files(out, "samples/_delta_log/*.json")[-1]
    log.write_text(re.sub(r'(?<="path":)"[^"]*"', json.dumps(path.format(out.parent)), log.read_text()))
    code, said = told(capsys, str(out), "repair=true")
    assert kept.exists(), said
    assert code == DAMAGED and "names a file that is not in its folder" in said


def test_verify_prints_what_a_terminal_shows_and_a_person_reads(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for n in range(300):
        (out / "samples" / f"\n\x1b[2J{n:0200}").touch()
    code, said = told(capsys, str(out))
    assert code == COMPLETE and "\x1b" not in said and "orphan  samples/\\n\\x1b[2J000" in said
    assert said.count("\n") == 102 and "and 200 more" in said and "0 damages, 300 orphans" in said


def test_a_lost_last_commit_is_noticed_by_the_run_too(out: Path, golden: Path) -> None:
    files(out, "samples/_delta_log/*.json")[-1].unlink()
    assert len(Store(out).samples) < len(Store(golden).samples)
    summary = executed(ToyWork(), refs(3), ["recovery", "human"], 2, Store(out))
    assert summary.exit_code == BAD_CONFIG
    assert "commit 3 is gone from the table's log; python -m factory verify out=" in summary.message
    assert check([str(out), "repair=true"]) == COMPLETE
    assert_same_tables(out, golden)


def test_a_writer_that_was_killed_before_its_copy_is_no_damage(out: Path) -> None:
    files(out, "samples/_commits/*.json")[-1].unlink()
    assert verify(Store(out)).damage == ()
    store = Store(out)
    store.samples.claim()
    assert len(files(out, "samples/_commits/*.json")) == len(files(out, "samples/_delta_log/*.json"))
    assert verify(Store(out)).damage == ()


def test_a_table_without_copies_is_whole_and_gets_them(out: Path) -> None:
    for folder in out.glob("*/_commits"):
        shutil.rmtree(folder)
    assert verify(Store(out)).damage == ()
    Store(out).samples.claim()
    assert len(files(out, "samples/_commits/*.json")) == len(files(out, "samples/_delta_log/*.json"))


@pytest.mark.slow
def test_checkpoints_are_held_too(out: Path) -> None:
    table = Store(out).samples
    while not files(out, "samples/_delta_log/*.parquet"):
        table.claim()
    (checkpoint,), last = files(out, "samples/_delta_log/*.parquet"), out / "samples/_delta_log/_last_checkpoint"
    location = Store(out).location
    for path in (checkpoint, last):
        whole = path.read_bytes()
        for content in damaged(whole, every=max(1, len(whole) // 15)):
            path.write_bytes(content)
            assert [found.name for found in damaged_logs(location)] == [f"samples/_delta_log/{path.name}"]
            restore_logs(location)
            assert path.read_bytes() == whole
    for path in files(out, "samples/_delta_log/*.json")[:50]:
        path.unlink()  # as delta-rs tidies commits that a checkpoint holds
    assert not damaged_logs(location) and len(Store(out).samples)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["samples/*/*/*.parquet", "outcomes/*.parquet", "candidates/*.parquet"])
def test_a_damaged_file_of_a_table_is_taken_out_and_made_again(
    out: Path, golden: Path, part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = files(out, part)[0]
    whole, name = path.read_bytes(), path.relative_to(out)
    for content in damaged(whole, every=len(whole) // 12):
        path.write_bytes(content)
        first, *_ = verify(Store(out)).damage
        assert first.startswith(f"{name}: ")
    others = {other: other.read_bytes() for other in files(out, "*/**/*.parquet") if other != path}
    code, said = told(capsys, str(out), "repair=true")
    assert code == COMPLETE and f"taken out {name}" in said and not path.exists()
    assert {other: other.read_bytes() for other in files(out, "*/**/*.parquet")} == others
    assert run(out) == COMPLETE
    assert_same_tables(out, golden)
    assert verify(Store(out)).damage == ()
    path.unlink() if path.exists() else files(out, part)[0].unlink()
    code, said = told(capsys, str(out))
    assert code == DAMAGED and ": is missing" in said


@pytest.mark.slow
@pytest.mark.parametrize("part", ["episodes/*.mcap", "cache/prepared/*.clip", "run.json", "current_run.json"])
def test_damage_beside_the_tables_is_named_and_taken_out(
    out: Path, golden: Path, part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = files(out, part)[0]
    whole, name = path.read_bytes(), path.relative_to(out)
    for content in (whole[:-9], whole[: len(whole) // 2], b"\xff" * 40, whole[:30] + b"\0" + whole[31:]):
        path.write_bytes(content)
        code, said = told(capsys, str(out))
        assert code == DAMAGED and str(name) in said, content
    code, said = told(capsys, str(out), "repair=true")
    assert code == COMPLETE and f"{'put back' if part == 'run.json' else 'taken out'} {name}" in said
    if part == "run.json":
        assert path.read_bytes() == whole
    assert run(out) == COMPLETE
    assert_same_tables(out, golden)
    if "run" not in part:
        assert path.is_file() is part.startswith("episodes")  # a clip whose attempts are done is not prepared again


@pytest.mark.parametrize(
    ("part", "commands"),
    [
        ("candidates/*.parquet", ["status", "report", "lineage"]),
        ("plans/*.parquet", ["status", "report"]),
        ("samples/*/*/*.parquet", ["status", "report", "lineage", "show 0", "export mcap sample=0"]),
        ("samples/_delta_log/*2.json", ["status", "report", "failed", "retry", "compact", "run executor=local"]),
        ("run.json", ["status", "report", "lineage", "failed", "retry"]),
        ("report.json", ["report"]),
    ],
)
def test_a_command_that_meets_damage_says_which_file_why_and_what_names_and_mends_all(
    out: Path, part: str, commands: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    sample = SampleTable(out)[0]["attempt_id"]
    (out / "report.json").write_text(json_with_checksum({}))
    path = files(out, part)[-1]
    for content in (path.read_bytes()[:-9], None):
        path.unlink() if content is None else path.write_bytes(content)
        for name, *words in map(str.split, commands if content or part.endswith("parquet") else []):
            asked = [*words, f"out={out}", *([f"sample={sample}"] if name == "lineage" else [])]
            assert COMMANDS[name].load()(asked) == BAD_CONFIG, asked
            said = capsys.readouterr().err
            assert said.startswith("error: ") and said.count("\n") == 1 and path.name in said, said
            assert ("is missing" in said) == (content is None) and "python -m factory verify out=" in said


def test_the_reader_refuses_with_the_file_s_name(out: Path) -> None:
    path = files(out, "samples/*/*/*.parquet")[0]
    whole, refused = path.read_bytes(), 0
    expected = list(map(str, SampleTable(out)))
    for content in damaged(whole, every=len(whole) // 15):
        path.write_bytes(content)
        try:
            assert list(map(str, SampleTable(out))) == expected, "what nothing was read from, such as an index of pages"
        except OSError as error:
            assert path.name in str(error)
            refused += 1
    assert refused >= 10


def test_nothing_is_repaired_while_a_run_writes(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = files(out, "samples/*/*/*.parquet")[0]
    path.write_bytes(b"")
    (out / "last_run.json").write_text(json_with_checksum({"began_ms": 1}))
    for name, more in (("verify", ["repair=true"]), ("clean", []), ("compact", [])):
        assert COMMANDS[name].load()([f"out={out}", *more]) == BAD_CONFIG
        assert "a run is writing here; wait until it has ended" in capsys.readouterr().err
    assert path.exists()


def test_a_run_that_was_quiet_for_long_commits_nothing_after_its_leftovers_went(out: Path) -> None:
    quiet = Store(out)
    quiet.begin_run(quiet.runs())  # it writes a shard and does not come to its commit
    rows = quiet.samples.read().slice(0, 1)
    changed = rows.set_column(0, "attempt_id", pa.array(["0" * 16]))
    shard = write_shard(quiet.samples.location, SAMPLES, changed)
    assert COMMANDS["clean"].load()([f"out={out}", "older_than=0min", "say=true"]) == 0
    assert Store(out).samples.version == quiet.samples.version
    assert COMMANDS["clean"].load()([f"out={out}", "older_than=0min"]) == 0
    assert not (out / "samples" / shard.path).exists()
    with pytest.raises(AnotherWriter):
        quiet.samples.commit([shard])
    assert verify(Store(out)).damage == ()


def test_nothing_behind_a_link_is_cleaned_away_and_companions_are_no_damage(
    out: Path, golden: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add_companions(out)
    for begun in [*out.rglob("*.part"), *out.rglob("*.crdownload"), *out.rglob("*~")]:
        begun.unlink()  # would be orphans as any file that no commit names
    theirs = tmp_path / "theirs" / ".work.tmp"
    theirs.parent.mkdir()
    theirs.write_text("of somebody else")
    (out / "samples" / "theirs").symlink_to(theirs.parent)
    (out / "cache" / "round").symlink_to(out)
    assert COMMANDS["clean"].load()([f"out={out}", "older_than=0min"]) == 0
    assert capsys.readouterr().out == "0 files older than 0min\n"
    assert theirs.exists()
    code, said = told(capsys, str(out))
    assert (code, said.count("orphan"), said.count("DAMAGED")) == (COMPLETE, 1, 0), said
    assert verify(Store(out)) == verify(Store(golden))


def test_leftovers_go_once_they_are_old(out: Path, golden: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean = COMMANDS["clean"].load()
    shard = files(out, "samples/*/*/*.parquet")[0]
    left = [shard.with_name(f"part-{'0' * 32}.parquet"), out / "cache/.x.clip.12345678.tmp", out / "episodes/x.mcap"]
    for path in left:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x")
    assert clean([f"out={out}"]) == 0 and all(path.exists() for path in left)
    assert clean([f"out={out}", "older_than=0min", "say=true"]) == 0 and all(path.exists() for path in left)
    said = capsys.readouterr().out
    assert all(f"leftover  {path.relative_to(out)}" in said for path in left)
    assert clean([f"out={out}", "older_than=0min"]) == 0 and not any(path.exists() for path in left)
    assert_same_tables(out, golden)
    assert verify(Store(out)) == verify(Store(golden)) and files(out, "episodes/*")
    assert clean([f"out={out}", "older_than=soon"]) == BAD_CONFIG
    assert "must be a number of days, hours or minutes" in capsys.readouterr().err


@pytest.mark.slow
def test_compacting_merges_files_and_changes_no_sample(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, whole = tmp_path / "out", tmp_path / "whole"
    for n in (1, 3, 5):  # three runs, a file each in every round and expert
        run(out, clips=n)
    run(whole, clips=5)
    before, facts = list(map(str, SampleTable(out))), Store(out).samples.file_facts()
    opened = SampleTable(out)
    assert COMMANDS["compact"].load()([f"out={out}"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split() for line in said][2] == ["samples", "9", "files,", "now", "3"]
    after = Store(out).samples.file_facts()
    assert len(after) == 3 and max(f.written_ms for f in after.values()) == max(f.written_ms for f in facts.values())
    assert sorted(map(str, SampleTable(out))) == sorted(before) and sorted(map(str, opened)) == sorted(before)
    assert_same_tables(out, whole)
    found = verify(Store(out))
    assert found.damage == () and len([name for name in found.orphans if name.startswith("samples")]) == 9
    assert run(out, clips=5) == COMPLETE and COMMANDS["compact"].load()([f"out={out}"]) == 0
    assert capsys.readouterr().out.splitlines()[2].split() == ["samples", "3", "files,", "now", "3"]


@pytest.mark.slow
def test_files_whose_rows_are_large_are_merged_some_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, whole = tmp_path / "out", tmp_path / "whole"
    for n in (1, 3, 5, 7):
        run(out, clips=n)
    run(whole, clips=7)
    table = Store(out).samples
    largest = max(table.read_file(path, partition).nbytes for path, partition in table.live_files().items())
    monkeypatch.setattr("factory.store.verify.HELD_BYTES", largest + 1)
    for _ in range(2):  # the second finds nothing to merge that could be held
        assert COMMANDS["compact"].load()([f"out={out}"]) == 0
    counts = Counter(tuple(partition.items()) for partition in Store(out).samples.live_files().values())
    assert set(counts.values()) <= {1, 2, 3} and max(counts.values()) > 1
    assert_same_tables(out, whole)


def test_a_damaged_log_is_named_by_whoever_opens_the_table(out: Path) -> None:
    path = files(out, "samples/_delta_log/*.json")[0]
    path.write_bytes(path.read_bytes().replace(b"schemaString", b"schemaStrinh"))
    with pytest.raises(OSError, match=f"samples: _delta_log/{path.name} is not what was written"):
        Store(out)


def test_drafts_that_a_killed_writer_left_are_no_damage(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.samples.claim()
    copy = tmp_path / "samples/_commits" / f"{1:020}.json"
    (copy.parent / f".{2:020}.json.0123abcd.tmp").write_bytes(copy.read_bytes())
    for folder in ("cache/prepared", "scenes"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / ".x.clip.0123abcd.tmp").write_bytes(b"half")
    assert verify(Store(tmp_path)).damage == ()


def test_a_commit_s_copy_under_another_s_name_is_no_copy_of_it(out: Path) -> None:
    """It is made again of the log, which is not written over."""
    log, (first, second, *_) = files(out, "samples/_delta_log/*.json"), files(out, "samples/_commits/*.json")
    whole, logged = second.read_bytes(), [path.read_bytes() for path in log]
    second.write_bytes(first.read_bytes())
    assert [damage.name for damage in damaged_logs(Location(str(out)))] == [f"samples/_commits/{second.name}"]
    check([f"out={out}", "repair=true"])
    assert second.read_bytes() == whole and [path.read_bytes() for path in log] == logged


class Killed(BaseException):
    """A writer, there and then."""


@pytest.mark.parametrize("copied", range(3))
def test_a_writer_killed_while_it_copies_a_checkpoint_is_no_damage_then_or_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, copied: int
) -> None:
    table, copy, names = Store(tmp_path).samples, CommitCopies._copy, list[str]()
    table.claim()
    table.set_property("delta.checkpointInterval", "4")

    def until_killed(copies: CommitCopies, name: str) -> bool:
        if len(names) == copied:
            raise Killed
        names.append(name)
        return copy(copies, name)

    monkeypatch.setattr(CommitCopies, "_copy", until_killed)
    with pytest.raises(Killed):
        table.claim()
    monkeypatch.undo()
    assert files(tmp_path, f"samples/_delta_log/{3:020}.checkpoint.parquet")
    assert verify(Store(tmp_path)).damage == ()
    Store(tmp_path).samples.claim()
    assert verify(Store(tmp_path)).damage == ()
    assert {path.name for path in files(tmp_path, "samples/_commits/*")} >= {
        f"{3:020}.checkpoint.parquet",
        f"{3:020}.json",
    }


READ_FLIPPED = """
import random, sys
from pathlib import Path
from factory.store.location import DamagedFile, Location, read_parquet
from factory.store.schema import SCHEMA

folder, name = Path(sys.argv[1]), sys.argv[2]
whole, rng, read = (folder / name).read_bytes(), random.Random(0), 0
footer = int.from_bytes(whole[-8:-4], "little")
for _ in range(600):
    changed = bytearray(whole)
    changed[len(whole) - 8 - rng.randrange(1, footer)] ^= 1 << rng.randrange(8)
    (folder / name).write_bytes(changed)
    try:
        read_parquet(Location(str(folder)), name, SCHEMA, ("round", "expert"))
        read += 1
    except DamagedFile:
        pass
print(read)
"""


def test_a_bit_flipped_in_a_shard_s_footer_never_ends_who_reads_it(tmp_path: Path) -> None:
    """What Arrow's bindings make of a column's metadata ends the process, of one flip in 150 in pyarrow 26."""
    out = Store(tmp_path / "out")
    executed(ToyWork(), refs(1), ["human"], 1, out)
    shard = next((tmp_path / "out" / "samples").rglob("*.parquet"))
    command = [sys.executable, "-c", READ_FLIPPED, str(shard.parent), shard.name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-500:]
    assert 0 < int(done.stdout) < 600


def test_a_member_that_a_flipped_bit_renames_is_damage_and_not_null(tmp_path: Path) -> None:
    """A cast to the table's own type takes what has another name for absent."""
    out = Store(tmp_path / "out")
    executed(ToyWork(), refs(1), ["recovery"], 1, out)
    shard = next((tmp_path / "out" / "samples").rglob("*.parquet"))
    whole = shard.read_bytes()
    changed = whole.replace(b"why", b"whx")
    assert changed != whole and list(SampleTable(tmp_path / "out"))
    shard.write_bytes(changed)
    for read in (lambda: list(SampleTable(tmp_path / "out")), lambda: Store(tmp_path / "out").samples.read()):
        with pytest.raises(DamagedFile, match=rf"{shard.name}: cannot be read: column cameras_left_out is .*whx"):
            read()
