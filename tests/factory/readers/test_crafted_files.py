"""Files made to do harm by what they say: each costs its own clips, or is refused by name, soon and in one line."""

import json
import os
import pickle
import resource
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from factory.datasets.navsim.pickles import RewardFile
from factory.files import DamagedFile
from factory.readers.base import BadClip
from factory.readers.pickles import load_plain
from factory.store.commit_copies import LOG
from factory.store.location import raising_damaged_file
from factory.store.table import DamagedLog, refuse_deep_commits
from factory.wording import printable, shown
from tests.factory.datasets.scenarionet.scenarionet_scenarios import nuscenes, save

REPOSITORY = Path(__file__).resolve().parents[3]
MEMORY_BYTES = 6 << 30
LEVELS = 60


def shared() -> tuple[object, ...]:
    """3^60 values to whatever walks through them, and 300 bytes of pickle."""
    value: tuple[object, ...] = ()
    for _ in range(LEVELS):
        value = (value, value, value)
    return value


def holding_itself() -> list[object]:
    value: list[object] = []
    value += [value, value]
    return value


DIGITS = 10**5000  # Python writes out 4,300 of an integer
CRAFTED = {"shared": shared(), "endless": holding_itself(), "digits": DIGITS}


def command(cwd: Path, *argv: str) -> subprocess.CompletedProcess[str]:
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))

    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(cwd)])}
    return subprocess.run(
        [sys.executable, *argv],
        cwd=cwd,
        env=env,
        capture_output=True,
        text=True,
        timeout=400,  # kernels are compiled once
        preexec_fn=limited,
    )


def run_of(cwd: Path, *words: str) -> subprocess.CompletedProcess[str]:
    plain = ["render=none", "experts=[human]", "executor=local", "vocabulary.k=16", "out=out"]
    return command(cwd, "-m", "factory", "run", f"clips.root={cwd / 'logs'}", *plain, *words)


@pytest.mark.slow
def test_a_log_with_a_crafted_value_is_a_failed_log_and_the_others_are_sampled(tmp_path: Path) -> None:
    wrong = {}
    for name, value in CRAFTED.items():
        for key in ("length", "sdc_id", "ts", "dataset"):
            scenario = nuscenes()
            (scenario if key == "length" else scenario["metadata"])[key] = value
            path = save(scenario, tmp_path / "logs", f"sd_{key}_{name}.pkl")
            wrong[path.stem] = f"{path}: pickle: "
    scenario = nuscenes()
    scenario["tracks"][None] = scenario["tracks"].pop("lead")
    save(scenario, tmp_path / "logs", "sd_nameless.pkl")  # read without that one
    save(nuscenes(), tmp_path / "logs", "sd_good.pkl")
    done = run_of(tmp_path, "clips=scenarionet")
    assert done.returncode == 3 and not done.stderr.count("Traceback"), done.stderr[-2000:]
    assert "6 accepted, 0 rejected, 12 failed" in done.stdout + done.stderr
    for log_id, says in wrong.items():
        assert f"  broken log {log_id}: {says}" in done.stdout


READER = """
from factory.datasets.scenarionet.reader import ScenarioNetReader
from struct import error

WRONG = {
    "Recursion": RecursionError("too deep"),
    "Overflow": OverflowError("too large"),
    "Value": ValueError("Exceeds the limit"),
    "Memory": MemoryError(),
    "Struct": error("cut off"),
    "Key": KeyError(10**5000),
    "File": PermissionError(13, "Permission denied", "@"),
}


class Reader(ScenarioNetReader):
    def drive(self, path):
        self._trip("early", path)
        return super().drive(path)

    def load(self, path):
        self._trip("late", path)
        return super().load(path)

    def _trip(self, when, path):
        _, at, what = (path.stem + "__").split("_")[:3]
        if at == when:
            if what == "File":
                raise PermissionError(13, "Permission denied", str(path))
            raise WRONG[what]


class Trusted(Reader):
    untrusted = False  # the index reads it in the process that runs
"""


@pytest.mark.slow
@pytest.mark.parametrize("reader", ["Reader", "Trusted"])
def test_whatever_a_reader_raises_over_a_log_fails_that_log_alone(tmp_path: Path, reader: str) -> None:
    (tmp_path / "tripping.py").write_text(READER)
    kinds = ("Recursion", "Overflow", "Value", "Memory", "Struct", "Key", "File")
    for what in kinds:
        save(nuscenes(), tmp_path / "logs", f"sd_early_{what}.pkl")
    for what in ("Value", "Key"):
        save(nuscenes(), tmp_path / "logs", f"sd_late_{what}.pkl")
    save(nuscenes(), tmp_path / "logs", "sd_good.pkl")
    done = run_of(tmp_path, "clips=custom", f"clips._target_=tripping.{reader}", "graph.isolated=never")
    said = done.stdout + done.stderr
    assert done.returncode == 3 and "Traceback" not in done.stderr, done.stderr[-2000:]
    assert "3 accepted, 0 rejected, 13 failed" in said  # seven logs that have no clips, two of three
    for what in kinds:
        assert f"  broken log sd_early_{what}: {tmp_path / 'logs' / f'sd_early_{what}.pkl'}: " in done.stdout
    failed = command(tmp_path, "-m", "factory", "failed", "out=out").stdout
    assert f"{tmp_path / 'logs' / 'sd_late_Key.pkl'}: reader: cannot be read: KeyError: an integer of" in failed


def mapping(folder: Path, value: object) -> None:
    save(nuscenes(), folder / "logs", "sd_good.pkl")
    (folder / "logs" / "dataset_summary.pkl").write_bytes(pickle.dumps({"sd_good.pkl": {}}))
    (folder / "logs" / "dataset_mapping.pkl").write_bytes(pickle.dumps({"sd_good.pkl": value}))


def scene_filter(folder: Path, text: str) -> None:
    (folder / "logs").mkdir()
    (folder / "small.yaml").write_text(text)


def aliases(last: str) -> str:
    """`all_mapping` of 60 levels of lists of three references each; `last`: what follows."""
    lines = ["&a0 [x]", *(f"&a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]" for k in range(1, LEVELS))]
    return "all_mapping:\n" + "".join(f"  - {line}\n" for line in lines) + last


def merges() -> str:
    """Mappings that take over three times the one before."""
    lines = ["&a0 {x: 1}", *(f"&a{k} {{<<: [*a{k - 1}, *a{k - 1}, *a{k - 1}]}}" for k in range(1, LEVELS))]
    return "all_mapping:\n" + "".join(f"  - {line}\n" for line in lines)


def checkpoint(path: Path, stream: bytes) -> None:
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("archive/data.pkl", stream)
        packed.writestr("archive/version", "3\n")
        packed.writestr("archive/byteorder", "little")


def nested_dicts(folder: Path) -> None:
    value: dict[str, object] = {}
    for _ in range(LEVELS):
        value = {"a": value, "b": value, "c": value}
    checkpoint(folder / "crafted.ckpt", pickle.dumps({"pipeline": value}, 2))


def unhashable_key() -> bytes:
    """A dictionary whose one key is a tuple that takes for ever to hash."""
    return b"\x80\x02}" + pickle.dumps(shared(), 2)[2:-1] + b"K\x01s."


FILTER = ("factory", "run", "clips=navsim", "clips.root=logs", "clips.maps=logs", "clips.scene_filter=small.yaml")
DRIVER_READS: dict[str, tuple[Callable[[Path], None], tuple[str, ...], str]] = {
    "mapping": (lambda at: mapping(at, shared()), ("factory", "run", "clips=scenarionet"), "dataset_mapping.pkl"),
    "summary": (
        lambda at: (
            mapping(at, ""),
            (at / "logs" / "dataset_summary.pkl").write_bytes(pickle.dumps({DIGITS: {}})),
        ),  # type: ignore[func-returns-value]
        ("factory", "run", "clips=scenarionet"),
        "dataset_summary.pkl",
    ),
    "filter with aliases": (lambda at: scene_filter(at, aliases("tokens: [*a59]\n")), FILTER, "small.yaml"),
    "filter with keys that share a hash": (
        lambda at: scene_filter(at, "tokens:\n" + "".join(f"  {k * (2**61 - 1)}: 0\n" for k in range(50_000))),
        FILTER,
        "small.yaml",
    ),
    "filter of merges": (lambda at: scene_filter(at, merges()), FILTER, "small.yaml"),
    "filter with digits": (lambda at: scene_filter(at, "max_scenes: -0x" + "f" * 5000), FILTER, "small.yaml"),
    "scene of shared dictionaries": (
        nested_dicts,
        ("factory", "scene", "import", "crafted.ckpt", "to=scene.safetensors"),
        "crafted.ckpt",
    ),
    "checkpoint of a planner": (
        lambda at: checkpoint(at / "crafted.ckpt", unhashable_key()),
        ("planners", "import", "crafted.ckpt", "planner=ltf_public", "out=planner"),
        "crafted.ckpt",
    ),
}


EACH = """
import json, os, sys
from factory.__main__ import main as factory
from planners.__main__ import main as planners

for folder, argv in json.loads(sys.argv[1]):
    os.chdir(folder)
    for name, fd in (("said", 1), ("told", 2)):
        os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY), fd)
    code = {"factory": factory, "planners": planners}[argv[0]](argv[1:])
    print(code, file=open("code", "w"), flush=True)
    sys.stdout.flush()
    sys.stderr.flush()
"""


@pytest.mark.slow
def test_a_crafted_file_that_a_command_reads_itself_is_refused_by_name_in_one_line(tmp_path: Path) -> None:
    asked = []
    for what, (write, argv, _) in DRIVER_READS.items():
        (folder := tmp_path / what).mkdir()
        write(folder)
        words = ("clips.root=logs", "out=out", "render=none", "executor=local") if argv[1] == "run" else ()
        asked.append((str(folder), [*argv, *words]))
    command(tmp_path, "-c", EACH, json.dumps(asked))
    for what, (_, argv, named) in DRIVER_READS.items():
        code, said, told = ((tmp_path / what / name).read_text() for name in ("code", "said", "told"))
        said = "".join(said.splitlines(keepends=True)[argv[1] == "run" :])  # a run says first what it is about to do
        assert code == "2\n" and not said, (what, said + told[-2000:])
        assert told.startswith("error: ") and told.count("\n") == 1, (what, told[-2000:])
        assert named in told and len(told) < 1000


def test_a_key_of_a_reward_file_that_never_hashes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "simcale_4_pdm_v1.0-0.pkl"
    path.write_bytes(b"\x80\x04}\x94(" + pickle.dumps(shared(), 4)[2:-1] + b"}\x94u.")
    with pytest.raises(BadClip, match=f"{path}: pickle: .*a key at byte .* is no text"):
        RewardFile(path)


@pytest.mark.parametrize("value", CRAFTED.values(), ids=CRAFTED)
def test_a_crafted_value_is_refused_by_its_file_and_told_of_in_a_few_words(value: object) -> None:
    with pytest.raises(BadClip, match=r"a\.pkl: pickle: .*refused"):
        load_plain(pickle.dumps({"x": [value]}), "a.pkl")
    assert len(shown(value)) < 200 and len(shown({"x" * 10_000: [value] * 10_000})) < 500


def test_values_that_logs_share_and_values_that_are_large_load() -> None:
    row = list(range(2000))
    for value in ([row] * 400, list(range(300_000)), {"ids": [2**255, -1]}, ["x" * 10_000] * 500):
        assert load_plain(pickle.dumps(value), "a.pkl") == value
    assert shown({"a": ["b", 1.5, None, True]}) == repr({"a": ["b", 1.5, None, True]})


@pytest.mark.parametrize("how", ["of a dict", "in a tuple", "of a set"])
def test_keys_that_share_a_hash_are_refused(how: str) -> None:
    """Python hashes integers modulo 2^61 - 1; building a dict of n that are equal there takes n^2 / 2 comparisons."""
    keys = [k * (2**61 - 1) for k in range(50_000)]
    longs = [pickle.dumps(key, 2)[2:-1] for key in keys]
    stream = {
        "of a dict": b"}(" + b"".join(key + b"N" for key in longs) + b"u.",
        "in a tuple": b"}(" + b"".join(key + b"\x85N" for key in longs) + b"u.",
        "of a set": b"cbuiltins\nset\n(](" + b"".join(longs) + b"etR.",
    }[how]
    with pytest.raises(BadClip, match=r"key of more than|integer too large"):
        load_plain(stream, "a.pkl")
    assert load_plain(pickle.dumps({2**63: {-(2**63)}}), "a.pkl") == {2**63: {-(2**63)}}


def test_what_a_file_says_is_shown_without_what_a_terminal_obeys() -> None:
    assert str(BadClip("a.pkl", "x\x1b[2J", "is no\nlane")) == "a.pkl: x\\x1b[2J: is no\\nlane"
    assert printable("Straße 5 €, 街") == "Straße 5 €, 街"
    with pytest.raises(DamagedFile) as told, raising_damaged_file("run/\x1b[2J" + "x" * 10**6):
        raise OSError("cut off")
    assert str(told.value).startswith("run/\\x1b[2Jxxx") and len(str(told.value)) < 5000


@pytest.mark.parametrize(
    ("text", "deep"),
    [
        (b"[" * 20_000, True),
        (b'{"]]":[\n' * 20_000, True),
        (b'"' + b"]" * 20_000 + b'"' + b"[" * 20_000, True),
        (b'"\\"' + b"[" * 20_000, False),  # a text that is cut off
        (b'{"add":{"stats":"{}"}}\n' * 20_000, False),
    ],
)
def test_a_commit_that_would_end_the_process_that_reads_it_is_refused(text: bytes, deep: bool, tmp_path: Path) -> None:
    (path := tmp_path / LOG / "0.json").parent.mkdir()
    path.write_bytes(text)
    with pytest.raises(DamagedLog, match=r"0\.json: more than 10,000 brackets") if deep else nullcontext():
        refuse_deep_commits(tmp_path)
