"""Crafted files against the commands that read them: `python -m tests.chaos.hostile_files [cases=250] [minutes=150]
[to=build/hostile_files] [only=door:number,door:number]`.

Of each door so many cases; what is judged already, by the lines of verdicts.jsonl, is not tried again. Logs lie by 25
beside an innocent one and are read by one run; a run that is not well is tried again in halves, down to the files that
did it. A single file is read by a command in a process forked from one that has imported it, one in 50 by the command
as it is typed. Judged are exit code, words, the innocent's rows, CPU time and memory. Findings end it with 1.
"""

import atexit
import importlib
import json
import os
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq

from factory.datasets.scenarionet.photos import cameras_in, load_sidecar, read_photographs
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.exits import COMPLETE, EXIT_CODE_TEXT, INTERRUPTED
from factory.readers.base import BadClip
from factory.readers.pictures import jpeg_size
from factory.run import main as run
from factory.setup.vocabulary import load_recovery_table
from factory.stages.sensors import decode_image, opened_photos
from factory.store.episodes import check_episode
from factory.store.reader import SampleTable
from planners.data.images import _decode_jpeg
from tasks.world.clip import Camera, SensorFile
from tasks.world.frames import EGO_STATE_SIZE
from tests.chaos.damaged_files.mutants_of_files import rng_of
from tests.chaos.hostile_files import grammars
from tests.chaos.hostile_files.grammars import Crafted, Rng
from tests.chaos.trials import leave_by
from tests.factory.datasets.navsim.geopackage_writer import CITIES
from tests.factory.datasets.navsim.navsim_town import write_town
from tests.factory.datasets.py123d.py123d_logs import convert
from tests.factory.datasets.scenarionet.scenarionet_scenarios import nuscenes, save
from tests.pages import REPOSITORY
from tests.writable import load_writable

PLAIN = ("experts=[human]", "rounds=1", "render=none", "reward.labels=none", "executor=local", "vocabulary.k=16")


def write_innocents(folder: Path, doors: Collection[str]) -> int:
    """What stands beside the hostile files of these doors, or is what they are made like; what is there is kept."""
    if not (folder / "scenarionet").exists():
        save(nuscenes(), folder / "scenarionet", "sd_innocent.pkl")
    if not (folder / "towns").exists() and any(door.startswith(("av2", "navsim", "py123d", "yaml")) for door in doors):
        SyntheticReader(folder / "towns", 1, 0, TownSettings(("ring_front_center",), 64, 36, lidar_beams=0)).index()
        (town,) = (path for path in folder.glob("towns/*/*") if path.is_dir())
        shutil.copytree(town, folder / "av2" / "innocent")
        convert(town, folder / "py123d")
        write_town(folder / "navsim", "mini", town, next(iter(CITIES)))
    if not (folder / "run").exists() and any(door.startswith(("table", "shard")) for door in doors):
        return run(["clips=scenarionet", f"clips.root={folder / 'scenarionet'}", *PLAIN, f"out={folder / 'run'}"])
    return COMPLETE


@dataclass(frozen=True)
class Logs:
    """A folder of logs that a run reads, where many hostile ones lie beside an innocent one."""

    craft: Callable[..., Crafted]  # of a generator, before it of what is good
    put: Callable[[Path, Path, str, bytes | None], str]  # innocents, data, name, crafted or None, the innocent: its id
    words: str  # of the run
    good: Callable[[Path], Any] | None = None  # what it is made like, of the innocents


def _pickled(good: str, place: str, innocents: Path, data: Path, name: str, crafted: bytes | None) -> str:
    source, path = next(innocents.glob(good)), data / place.format(name)
    path = path if crafted is not None else path.with_name(source.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(source.read_bytes() if crafted is None else crafted.replace(b"hostile", name.encode()))
    return path.stem


def _log(folder: Path) -> Path:
    """The one log below it: the folder with files in it."""
    return next(path for path in sorted(folder.rglob("*")) if path.suffix in (".feather", ".arrow")).parent


def _of_log(patterns: Sequence[str], log: Path, rng: Rng) -> Crafted:
    """One file of a log in several; its name stands before the bytes."""
    path = grammars.pick(rng, sorted(log.glob(grammars.pick(rng, patterns))))
    if path.suffix == ".json":
        what, crafted = grammars.json_text(json.loads(path.read_bytes()), rng)
    else:
        packed = rng.random() < 0.1 and path.suffix == ".arrow"
        good = pyarrow.feather.read_table(path, memory_map=False, use_threads=False)
        what, crafted = (_packed if packed else grammars.arrow)(good, rng)
    return f"{path.name} {what}", str(path.relative_to(log)).encode() + b"\n" + crafted


def _packed(good: pa.Table, rng: Rng) -> Crafted:
    """msgpack within Arrow's metadata."""
    size, n = grammars.pick(rng, grammars.SIZES), min(grammars.pick(rng, grammars.MANY), 9999)
    kind = grammars.pick(rng, ("f8", "O", "V99", "(9999,)f8"))
    values: dict[str, bytes] = {
        "array": msgpack.packb({b"__ndarray__": True, b"dtype": kind, b"shape": [size], b"data": b"x" * 8}),
        "deep": msgpack.packb(grammars.nested(400)),
        "texts": msgpack.packb({f"{k}{grammars.FORGED}": "x" for k in range(n)}),
        "length": b"\xdd" + struct.pack(">I", size & 0xFFFFFFFF),
    }
    name, packed = grammars.one_of("msgpack", values, rng)
    pyarrow.feather.write_feather(good.replace_schema_metadata({b"metadata": packed}), sink := pa.BufferOutputStream())
    return name, sink.getvalue().to_pybytes()


def _linked(folder: str, innocents: Path, data: Path, name: str, crafted: bytes | None) -> str:
    """A log like the innocent one, by links, but for one file."""
    log = _log(innocents / folder)
    here = data / log.relative_to(innocents / folder).with_name(name)
    part, _, content = (crafted or b"").partition(b"\n")
    for path in (path for path in log.rglob("*") if path.is_file()):
        (to := here / path.relative_to(log)).parent.mkdir(parents=True, exist_ok=True)
        if to == here / part.decode():
            to.write_bytes(content)
        else:
            to.symlink_to(path.resolve())
    return name


def _folders(clips: str, *files: str) -> Logs:
    words, put = READ.format(clips), partial(_linked, clips)
    return Logs(partial(_of_log, files), put, words, lambda innocents: _log(innocents / clips))


SCENARIO, FRAMES = "scenarionet/*.pkl", "navsim/navsim_logs/mini/*.pkl"
READ = "clips={} clips.root={{data}}"
MAPPED = (
    "clips=navsim clips.root={data}/navsim_logs/mini clips.maps={innocents}/navsim/maps clips.cache_dir={data}/kept"
)
AV2_FILES = ("annotations.feather", "city_SE3_egovehicle.feather", "calibration/intrinsics.feather", "map/*.json")
LOGS: Mapping[str, Logs] = {
    "scenarionet": Logs(grammars.scenario, partial(_pickled, SCENARIO, "sd_{}.pkl"), READ.format("scenarionet")),
    "navsim": Logs(
        grammars.frames,
        partial(_pickled, FRAMES, "navsim_logs/mini/{}.pkl"),
        MAPPED,
        lambda innocents: [f | {"log_name": "hostile"} for f in load_writable(next(innocents.glob(FRAMES)))],
    ),
    "av2": _folders("av2", *AV2_FILES),
    "py123d": _folders("py123d", "*.arrow"),
}


@dataclass(frozen=True)
class Single:
    """A file that a command of the product, or a public function of it, reads."""

    craft: Callable[..., Crafted]  # as of Logs
    name: str  # of the file
    reads: str | Callable[[Path], Any]  # a command, factory or planners, and its words; a function of the file
    refusals: tuple[type[Exception], ...] = (BadClip, ValueError)  # of the function
    like: str = ""  # what of the innocents the file lies in a copy of
    named: str | None = ""  # what a refusal must name; empty: the file; None: nothing, of a function of bytes alone
    good: Callable[[Path], Any] | None = None


def _good_commit(innocents: Path) -> list[dict[str, Any]]:
    """All of a good log in one commit."""
    files = sorted((innocents / "run/samples/_delta_log").glob("*.json"))
    actions = [json.loads(line) for path in files for line in path.read_text().splitlines()]
    return [action for action in actions if "commitInfo" not in action]


def _good_shard(innocents: Path) -> pa.Table:
    return pq.ParquetFile(next((innocents / "run/samples").glob("*/*/*.parquet"))).read(use_threads=False)


def _read_batch(path: Path) -> Any:
    return _decode_jpeg(np.frombuffer(data := path.read_bytes(), np.uint8), jpeg_size(data)[::-1])


def _read_sidecar(path: Path) -> Any:
    cameras_in(load_sidecar(path)[0], str(path))
    return read_photographs(path, path.parent, np.zeros((121, EGO_STATE_SIZE)))


def _read_samples(path: Path) -> Any:
    table = SampleTable(next(parent for parent in path.parents if parent.name == "run"))
    return [len(table[k]) for k in range(len(table))]


PHOTO = SensorFile("front", "hostile.jpg", 0.0, np.eye(4))
FRONT = Camera("front", 64, 36, np.eye(3), np.zeros(5), np.eye(4))
CAMERA: dict[str, Any] = {"width": 64, "height": 36, "ego_from_camera": np.eye(4).tolist()}
CAMERA |= {"K": [[50.0, 0, 32], [0, 50, 18], [0, 0, 1]]}
SIDECAR = {"cameras": {"front": CAMERA}, "frames": [{"camera": "front", "file": "a.jpg", "time_s": 0.1}]}
RUN, IMPORT = f"factory run {' '.join(PLAIN)} out=out ", "factory scene import {} to=scene.safetensors"
FILTERED = RUN + "clips=navsim clips.root=navsim/navsim_logs/mini clips.maps=navsim/maps clips.scene_filter={}"
WITH_VOCABULARY = RUN + "clips=scenarionet clips.root=scenarionet vocabulary.file={}"
SHARD, COMMIT = "run/samples/round=0/expert=human/hostile.parquet", f"run/samples/_delta_log/{0:020}.json"
LOG = partial(Single, grammars.commit, COMMIT, refusals=(Exception,), like="run", named="run", good=_good_commit)
ROWS = partial(Single, grammars.parquet, SHARD, refusals=(Exception,), like="run", good=_good_shard)
SINGLES: Mapping[str, Single] = {
    "yaml filter": Single(grammars.yaml_text, "hostile.yaml", FILTERED, like="navsim"),
    "vocabulary": Single(grammars.array_file, "hostile.npy", WITH_VOCABULARY, like="scenarionet"),
    "recovery table": Single(grammars.npz, "hostile.npz", load_recovery_table),
    "scene ply": Single(grammars.ply, "hostile.ply", IMPORT),
    "scene spz": Single(grammars.spz, "hostile.spz", IMPORT),
    "scene checkpoint": Single(grammars.checkpoint, "hostile.ckpt", IMPORT),
    "scene file": Single(grammars.safetensors, "hostile.safetensors", "factory scene info {}"),
    "planner checkpoint": Single(grammars.checkpoint, "h.ckpt", "planners import {} planner=ltf_public out=planner"),
    "picture": Single(grammars.picture, "h.jpg", lambda path: decode_image(path.read_bytes(), str(path))),
    "photo": Single(grammars.picture, "hostile.jpg", lambda _: list(opened_photos([PHOTO], [FRONT]))),
    "picture of a batch": Single(grammars.jpeg, "hostile.jpg", _read_batch, named=None),
    "episode": Single(grammars.mcap, "hostile.mcap", lambda path: check_episode(path.read_bytes()), named=None),
    "sidecar": Single(partial(grammars.json_text, SIDECAR), "hostile.json", _read_sidecar),
    "table, status": LOG("factory status out=run"),
    "table, verify": LOG("factory verify run"),
    "table, read": LOG(_read_samples),
    "shard, verify": ROWS("factory verify run"),
    "shard, read": ROWS(_read_samples, named="run"),
}


def crafted(door: str, innocents: Path, number: int) -> Crafted:
    """Attack and file of a case."""
    way: Logs | Single = LOGS.get(door) or SINGLES[door]
    return way.craft(*([way.good(innocents)] if way.good else []), rng_of(door, number))


def put_single(single: Single, innocents: Path, folder: Path, crafted: bytes) -> Path:
    """The file in a folder of its own; a run's log is remade to be one commit, which names a hostile shard."""
    folder.mkdir()
    if single.like:
        shutil.copytree(innocents / single.like, folder / single.like)
    if single.like == "run":
        shutil.rmtree(folder / "run/samples/_commits")  # a stranger's run has none, or made to match
        for old in (folder / "run/samples/_delta_log").iterdir():
            old.unlink()
        told = {"path": SHARD.partition("samples/")[2], "size": len(crafted)}
        adds = [a | {"add": a["add"] | told} if "add" in a else a for a in _good_commit(innocents)]
        (folder / COMMIT).write_text("\n".join(map(json.dumps, adds)))
    (path := folder / single.name).write_bytes(crafted)
    return path


# Cases tried and judged.

BATCH = 25  # logs beside an innocent one
CPU_S, GB = 8.0, 1.0  # beyond what it takes without the file
LIMIT_S, LIMIT_CPU_S, LIMIT_BYTES = 600, 20, 6 << 30  # of one process that would take all of the machine
MOST_SAID = 20_000  # characters that a file makes a command say
EVERY = 50  # single files, of which one is read by the command as it is typed
# Before the first fork. Who has opened a table is not to be forked: Delta's threads stay behind.
LOADED = ("factory.commands.exchange", "factory.graph.execute", "factory.pipeline", "factory.setup.settings")
LOADED += ("factory.views.board.gallery", "tasks.experts.pdm_closed", "tasks.render.fit.reconstruct")
LOADED += ("planners.published.import_planner",)


@dataclass(frozen=True)
class Told:
    """How a process ended."""

    code: int  # below 0: by a signal
    said: str  # on both outputs
    cpu_s: float  # of it and all below it
    gb: float  # of the largest of them


@dataclass(frozen=True)
class Verdict:
    """Of one case; of logs `cpu_s` and `gb` are those of the run that it was in."""

    door: str
    number: int
    attack: str
    how: str  # read, refused
    finding: str  # what is wrong; empty: nothing
    cpu_s: float  # beyond the baseline
    gb: float


def in_fork(work: Callable[[], int], folder: Path, cpu_s: int = LIMIT_CPU_S) -> Told:
    """Of a fork of this process, at work in a folder: what is imported here costs it nothing, no memory either."""
    here_kb = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024
    if not (pid := os.fork()):
        leave_by(partial(_limited, work, folder, cpu_s), folder / "said")
    end = time.monotonic() + LIMIT_S
    while not (ended := os.wait4(pid, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.killpg(pid, signal.SIGKILL)
        time.sleep(0.005)
    _, status, used = ended
    said, gb = (folder / "said").read_bytes().decode(errors="replace"), max(0, used.ru_maxrss - here_kb) / 2**20
    return Told(os.waitstatus_to_exitcode(status), said, used.ru_utime + used.ru_stime, gb)


def _limited(work: Callable[[], int], folder: Path, cpu_s: int) -> int:
    os.setsid()
    os.chdir(folder)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for kind, most in ((resource.RLIMIT_DATA, LIMIT_BYTES), (resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(kind, (most, most))
    try:
        return work()
    finally:
        atexit._run_exitfuncs()


def as_typed(argv: Sequence[str], folder: Path, cpu_s: int = LIMIT_CPU_S) -> Told:
    """Of the command itself."""
    command, environment = [sys.executable, "-m", *argv], os.environ | {"PYTHONPATH": str(REPOSITORY)}
    return in_fork(lambda: os.execve(sys.executable, command, environment), folder, cpu_s)


def what_is_wrong(told: Told, before: Told, codes: Collection[int]) -> str:
    """With a process that a hostile file was given to, beside one that had none."""
    cpu_s, gb = told.cpu_s - before.cpu_s, told.gb - before.gb
    if told.code not in codes:
        return f"ended with {told.code}: {told.said[-600:]}"
    if "Traceback (most recent call last)" in told.said or "panicked at" in told.said:
        return f"a traceback: {told.said[-600:]}"
    if forged := re.search(rf"(?m)^FORGED|{re.escape(grammars.ESCAPE)}", told.said):
        return f"wrote to the terminal as the file asked: {told.said[max(0, forged.start() - 200) :][:300]!r}"
    if len(told.said) > MOST_SAID:
        return f"said {len(told.said):,} characters: {told.said[:300]!r}"
    return f"{cpu_s:.1f} s of CPU time more" if cpu_s > CPU_S else f"{gb:.2f} GB more" if gb > GB else ""


def rows_of(out: Path, table: str = "samples") -> dict[str, list[str]]:
    """Of each log the rows that a run has just written, all columns as text. Delta's reader would not fork."""
    found: dict[str, list[str]] = {}
    for path in sorted((out / table).glob("**/*.parquet")):
        for row in pq.ParquetFile(path).read(use_threads=False).sort_by("attempt_id").to_pylist():
            found.setdefault(row["log_id"], []).append(repr(row))
    return {log_id: sorted(rows) for log_id, rows in found.items()}


@cache
def innocent_alone(innocents: Path, door: str) -> tuple[Told, list[str]]:
    """How a run without a hostile log ends, and its rows."""
    folder = innocents.parent / f"alone {door}"
    shutil.rmtree(folder, ignore_errors=True)
    told, name = _run(innocents, folder, door, {})
    if told.code or not (rows := rows_of(folder / "out").get(name)):
        raise RuntimeError(f"{door}: the innocent log alone ended with {told.code}: {told.said[-2000:]}")
    return told, rows


def _run(innocents: Path, folder: Path, door: str, hostile: Mapping[str, bytes]) -> tuple[Told, str]:
    (data := folder / "data").mkdir(parents=True)
    name, *_ = [LOGS[door].put(innocents, data, *log) for log in (("innocent", None), *hostile.items())]
    words = [word.format(innocents=innocents, data=data) for word in LOGS[door].words.split()]
    command = ["factory", "run", *PLAIN, *words, f"out={folder / 'out'}"]
    cpu_s = LIMIT_CPU_S if hostile else LIMIT_S  # the innocent alone may compile kernels
    return as_typed(command, folder, cpu_s), name


def judge_logs(innocents: Path, folder: Path, door: str, files: Mapping[int, Crafted]) -> list[Verdict]:
    """All beside one innocent log; where that is not well, in halves."""
    before, rows = innocent_alone(innocents, door)
    here = folder / "-".join(map(str, (min(files), max(files), len(files))))
    told, name = _run(innocents, here, door, {f"h{n:06}": content for n, (_, content) in files.items()})
    wrong, how = what_is_wrong(told, before, (0, 3)), dict[int, str]()
    if not wrong:
        found, failed = rows_of(here / "out"), rows_of(here / "out", "outcomes")
        if found.get(name) != rows:
            wrong = f"the innocent log has {len(found.get(name, []))} rows of {len(rows)}, or others"
        for n in files:
            ids = {f"h{n:06}", f"sd_h{n:06}"}
            how[n] = "read" if ids & found.keys() else "refused"
            if not (wrong or ids & (found.keys() | failed.keys()) or re.search(rf"\b(sd_)?h{n:06}\b", told.said)):
                wrong = f"log h{n:06} is not named"
    shutil.rmtree(here)
    if wrong and len(files) > 1:
        numbers, half = list(files), len(files) // 2
        parts = ({n: files[n] for n in part} for part in (numbers[:half], numbers[half:]))
        return [verdict for part in parts for verdict in judge_logs(innocents, folder, door, part)]
    more = told.cpu_s - before.cpu_s, told.gb - before.gb
    return [Verdict(door, n, attack, how.get(n, ""), wrong, *more) for n, (attack, _) in files.items()]


def _answer(single: Single, path: Path, words: Sequence[str]) -> int:
    """Of a command, or of the function that reads the file: 0, or 2 with the line of its refusal."""
    if words:
        return importlib.import_module(f"{words[0]}.__main__").main(words[1:])
    try:
        single.reads(path)
    except single.refusals as error:
        print(f"{type(error).__name__} {error}", file=sys.stderr)
        return 2
    return 0


def judge_singles(innocents: Path, folder: Path, door: str, files: Mapping[int, Crafted]) -> Iterator[Verdict]:
    """Each in a folder of its own."""
    single, refused = SINGLES[door], EXIT_CODE_TEXT.keys() - {INTERRUPTED}
    words = single.reads.format(single.name).split() if isinstance(single.reads, str) else ()
    for n, (attack, content) in files.items():
        path = put_single(single, innocents, here := folder / str(n), content)
        typed = words and n % EVERY == 0
        told = as_typed(words, here) if typed else in_fork(partial(_answer, single, path, words), here)
        wrong = what_is_wrong(told, Told(0, "", 0.0, 0.0), refused)
        if not wrong and told.code and (path.name if single.named == "" else single.named or "") not in told.said:
            wrong = f"refused without its name: {told.said[-400:]}"
        shutil.rmtree(here)
        yield Verdict(door, n, attack, "refused" if told.code else "read", wrong, told.cpu_s, told.gb)


def main(cases: str = "250", minutes: str = "150", to: str = "build/hostile_files", only: str = "") -> int:
    end, kept = time.monotonic() + 60.0 * float(minutes), Path(to).absolute() / "verdicts.jsonl"
    (innocents := kept.with_name("innocents")).mkdir(parents=True, exist_ok=True)
    told = [Verdict(**json.loads(line)) for line in kept.read_text().splitlines()] if kept.exists() else []
    known = {(verdict.door, verdict.number) for verdict in told}
    given = [case.rpartition(":")[::2] for case in re.split(r"(?<=\d),", only)] if only else []
    wanted = {door: [int(n) for other, n in given if other == door] for door in dict(given)}
    wanted = wanted or {door: list(range(int(cases))) for door in (*LOGS, *SINGLES)}
    left = {door: [n for n in numbers if (door, n) not in known] for door, numbers in wanted.items()}
    for name in LOADED:
        importlib.import_module(name)
    if (made := in_fork(lambda: write_innocents(innocents, left), kept.parent, LIMIT_S)).code:
        raise RuntimeError(made.said[-2000:])
    with kept.open("a") as file:
        for at in range(0, max(map(len, left.values())), BATCH):  # a part that ends early has some of every kind
            for door, numbers in left.items():
                if not (part := numbers[at : at + BATCH]) or time.monotonic() > end:
                    continue
                files, folder = {n: crafted(door, innocents, n) for n in part}, Path(tempfile.mkdtemp())
                for new in (judge_logs if door in LOGS else judge_singles)(innocents, folder, door, files):
                    if new.finding:
                        print(f"{door} {new.number} ({new.attack}): {new.finding}", file=sys.stderr, flush=True)
                    print(json.dumps(new.__dict__), file=file, flush=True)
                    told.append(new)
                shutil.rmtree(folder)
    print(table_of(told))
    return sum(bool(verdict.finding) for verdict in told)


def table_of(told: Sequence[Verdict]) -> str:
    lines = ["| door | cases | attacks | read | refused | findings | CPU s | GB |", "|---|---|---|---|---|---|---|---|"]
    for door in dict.fromkeys(verdict.door for verdict in told):
        some = [verdict for verdict in told if verdict.door == door]
        hows, found = [verdict.how for verdict in some], sum(bool(verdict.finding) for verdict in some)
        counts = len(some), len({verdict.attack for verdict in some}), hows.count("read"), hows.count("refused"), found
        most = f"{max(verdict.cpu_s for verdict in some):.1f} | {max(verdict.gb for verdict in some):.2f}"
        lines.append(f"| {door} | {' | '.join(map(str, counts))} | {most} |")
    return "\n".join([*lines, f"{len(told):,} cases"])


if __name__ == "__main__":
    sys.exit(bool(main(**dict(word.split("=", 1) for word in sys.argv[1:]))))
