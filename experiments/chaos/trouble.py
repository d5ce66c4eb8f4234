"""The machine behind experiments.chaos.outside: processes, the trouble made for them, and what is seen of them."""

import ctypes
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np

from factory.exits import COMPLETE
from factory.store.samples import Store
from factory.store.verify import verify
from tasks.caches import user_cache
from tests.pages import REPOSITORY

OVER_S, LEFT_S = 400.0, 60.0  # until a command has ended, and then what it began
NOBODY = 4242  # a user
TRACE = re.compile(r"Traceback|Exception ignored|Fatal Python error|core dumped|Aborted|panicked")
RAY_S_OWN = re.compile(r"^.*\((PlacementGroupCleaner|TrainController) pid=.*\n", re.M)  # Ray Train
GOES_ON = r"again|the same command goes on|free disk space|run it as a user|to=<another|out="  # how to go on
SAID = re.compile(r"^error: |again|^interrupted|the same command goes on|^OpenBLAS error|thread-local data: ABORT$")


# Processes.


def become_parent_of_orphans() -> None:
    """So that what a command leaves behind is ours: seen, ended, and its CPU time counted (Linux)."""
    ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER


def use_own_mounts() -> bool:
    """What is mounted from here on nobody else sees, and it goes with this process. False where we may not."""
    if os.getuid() != 0 or ctypes.CDLL(None).unshare(0x00020000):  # CLONE_NEWNS
        return False
    return subprocess.run(["mount", "--make-rprivate", "/"]).returncode == 0


@contextmanager
def mounted(folder: Path, n_bytes: int = 0, kind: str = "") -> Iterator[None]:
    """A file system of its own with so many bytes free; kind=ro: the folder itself, to be read alone."""
    folder.mkdir(parents=True, exist_ok=True)
    if kind == "ro":
        subprocess.run(["mount", "--bind", str(folder), str(folder)], check=True)
        subprocess.run(["mount", "-o", "remount,bind,ro", str(folder)], check=True)
    else:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={max(n_bytes, 4096)}", "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def below(pid: int) -> dict[int, str]:
    """Pid -> command line of every process that descends from one, itself left out."""
    parents: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:  # gone meanwhile
            continue
        parents.setdefault(parent, []).append(int(folder.name))
    found: dict[int, str] = {}
    left = [pid]
    while left:
        children = parents.get(left.pop(), [])
        left += children
        found |= {child: command_line(child) for child in children}
    return found


def command_line(pid: int) -> str:
    """Empty for one that is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""


def kill(pid: int, number: int = signal.SIGKILL) -> bool:
    """False where it is gone."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


PEERS = {  # part of the command line
    "guard": r"graph/guard\.py",
    "child": r"spawn_main|spawn_child|forkserver|compile_worker|-m factory|guard\.py",
    "worker": r"^ray::(?!.*Agent$)",
    "raylet": r"/raylet/raylet ",
    "gcs": r"/gcs_server",
    "agent": r"Agent$|dashboard/agent\.py|runtime_env/agent",
}


def peers(pid: int, kind: str) -> list[int]:
    """Processes of a kind below one."""
    return sorted(child for child, line in below(pid).items() if re.search(PEERS[kind], line))


# Trouble.


class TooLate(Exception):
    """The command had ended before there was trouble."""


@dataclass
class Scene:
    """Where a trial is made."""

    folder: Path
    port: int  # free
    rng: random.Random
    undisturbed: "Ended"
    start: Callable[[str, str], "Ended"]  # another command, by its name, on the same folders; what its output is called

    @property
    def out(self) -> Path:
        return self.folder / "out"


@dataclass
class Trouble:
    """How a command is started, and what is done while it runs."""

    prefix: Sequence[str] = ()
    environment: Mapping[str, str | None] = field(default_factory=dict)
    during: Callable[[subprocess.Popen[bytes]], None] | None = None
    stdout: str = ""  # a file, or "nobody" who reads it
    leaves: bool = False  # workers of a cluster that is not the command's


Making = Callable[[Scene], AbstractContextManager[Trouble]]


def making(trouble: Callable[[Scene], Trouble]) -> Making:
    """Of trouble that leaves nothing."""

    @contextmanager
    def make(scene: Scene) -> Iterator[Trouble]:
        yield trouble(scene)

    return make


def meanwhile(do: Callable[[Scene, subprocess.Popen[bytes]], None]) -> Making:
    """What is done while the command runs."""
    return making(lambda scene: Trouble(during=partial(do, scene)))


def started_with(*prefix: str, stdout: str = "", **environment: str | None) -> Making:
    return making(lambda scene: Trouble(prefix, environment, None, stdout))


def wait_for(process: subprocess.Popen[bytes], is_so: Callable[[], object]) -> None:
    """Raises TooLate where the command ends before."""
    while process.poll() is None and not is_so():
        time.sleep(0.005)
    if process.poll() is not None:
        raise TooLate


def a_moment(scene: Scene, process: subprocess.Popen[bytes], share: float = 1.0) -> None:
    """Wait a part, drawn by chance, of what the command takes undisturbed, from when Python has begun."""
    end = time.monotonic() + scene.rng.uniform(0.0, share * scene.undisturbed.seconds)
    wait_for(process, lambda: _cpu_s(process.pid) >= 0.1)
    wait_for(process, lambda: time.monotonic() >= end)


def _cpu_s(pid: int) -> float:
    with suppress(OSError):
        user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    return 0.0


def signalled(number: signal.Signals, then: signal.Signals | None = None) -> Making:
    """At any moment; then: another, 3 s later."""

    def send(scene: Scene, process: subprocess.Popen[bytes]) -> None:
        a_moment(scene, process)
        process.send_signal(number)
        if then is not None:
            time.sleep(3.0)
            process.send_signal(then)

    return meanwhile(send)


def losing(kind: str, share: float = 0.5) -> Making:
    """A process of a kind that the command has begun is killed at any moment of its life."""

    def strike(scene: Scene, process: subprocess.Popen[bytes]) -> None:
        wait_for(process, lambda: peers(process.pid, kind))
        a_moment(scene, process, share)
        found = peers(process.pid, kind)
        if not found or not kill(scene.rng.choice(found)):
            raise TooLate

    return meanwhile(strike)


def full(where: str, most: int, least: int = 4096) -> Making:
    """Little space, drawn by chance, in `out`, a folder of the environment, or /dev/shm."""

    @contextmanager
    def make(scene: Scene) -> Iterator[Trouble]:
        place = {"out": scene.out, "shm": Path("/dev/shm")}.get(where, scene.folder / "place")
        n_bytes = int(np.exp(scene.rng.uniform(np.log(least), np.log(most))))
        kept = scene.folder / "kept"
        if where == "out" and scene.out.exists():  # what it begins with takes its part
            scene.out.rename(kept)
            n_bytes += sum(2 * 4096 + path.stat().st_size for path in kept.rglob("*"))
        with mounted(place, n_bytes):
            if kept.exists():
                shutil.copytree(kept, place, dirs_exist_ok=True)
                shutil.rmtree(kept)
            environment = {} if where in ("out", "shm") else {where: str(place)}
            yield Trouble(environment=environment)
            if where == "out":
                shutil.copytree(place, kept)
        if where == "out":
            place.rmdir()
            kept.rename(place)

    return make


@contextmanager
def read_only_out(scene: Scene) -> Iterator[Trouble]:
    with mounted(scene.out, kind="ro"):
        yield Trouble()


@contextmanager
def no_shared_memory(scene: Scene) -> Iterator[Trouble]:
    with mounted(Path("/dev/shm")):
        subprocess.run(["mount", "-o", "remount,ro", "/dev/shm"], check=True)
        yield Trouble()


@contextmanager
def of_another_user(scene: Scene) -> Iterator[Trouble]:
    """Files and folders of `out` are another's, and this one's rights are no longer those of root."""
    scene.out.mkdir(exist_ok=True)
    places = [scene.out, *scene.out.rglob("*")]
    for place in places:
        os.chown(place, NOBODY, NOBODY)
    yield Trouble(["setpriv", "--bounding-set", "-dac_override,-dac_read_search,-fowner,-chown"])
    for place in [scene.out, *scene.out.rglob("*")]:
        os.chown(place, 0, 0)


@making
def short_of_memory(scene: Scene) -> Trouble:
    return Trouble(["prlimit", f"--as={(scene.undisturbed.peak_kb - 512 * 1024) * 1024}"])


@contextmanager
def jumping_clock(scene: Scene) -> Iterator[Trouble]:
    library = scene.folder / "clock.so"
    source = str(Path(__file__).with_name("clock.c"))
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), source, "-ldl"], check=True)
    seconds = scene.rng.choice([-86400, -7200, 7200, 86400])
    yield Trouble(environment={"LD_PRELOAD": str(library), "CLOCK_JUMP_S": str(seconds), "CLOCK_EVERY_MS": "700"})


@meanwhile
def clients_leave(scene: Scene, process: subprocess.Popen[bytes]) -> None:
    """Of the dashboard: in the middle of what they ask, and of what they are answered."""
    wait_for_page(scene.port, process)
    for _ in range(30):
        with socket.create_connection(("127.0.0.1", scene.port), timeout=10.0) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, bytes([1, 0, 0, 0, 0, 0, 0, 0]))  # a reset
            asked = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
            client.sendall(asked[: scene.rng.randint(0, len(asked))])
            if scene.rng.random() < 0.5:
                client.settimeout(0.2)
                with suppress(TimeoutError):
                    client.recv(10)


@meanwhile
def half_questions(scene: Scene, process: subprocess.Popen[bytes]) -> None:
    """Who asks `planners serve` leaves after some bytes."""
    assert process.stdin is not None
    process.stdin.write(scene.rng.randbytes(scene.rng.randint(0, 200)))
    process.stdin.close()


def another_driver(name: str) -> Making:
    """Of the same `out`, at any moment from when the first has begun there: it goes on, and the first ends."""

    def begin(scene: Scene, process: subprocess.Popen[bytes]) -> None:
        wait_for(process, (scene.out / "current_run.json").exists)
        a_moment(scene, process, 0.5)
        ended = scene.start(name, "second")
        assert ended.code == COMPLETE, f"the second driver ended with {ended.code}: {ended.err}"

    return meanwhile(begin)


STANDING = {"RAY_AUTH_MODE": "token", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}  # as the runbook begins one
OF_NODES = STANDING | {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "1"}  # without, Ray lets no other node join


@contextmanager
def standing_node(folder: Path, port: int, is_head: bool, with_env: Mapping[str, str]) -> Iterator[list[int]]:
    """Ray's processes of a node on this machine that nobody's run has begun; not the head: of the cluster there."""
    before = set(below(os.getpid()))
    words = [str(Path(sys.executable).with_name("ray")), "start", "--num-cpus=1", "--object-store-memory=200000000"]
    words += ["--disable-usage-stats", f"--node-ip-address=127.0.0.{1 if is_head else 2}"]
    words += ["--head", f"--port={port}", "--include-dashboard=false"] if is_head else [f"--address=127.0.0.1:{port}"]
    words += [f"--temp-dir={folder}"] if is_head else []
    subprocess.run(words, check=True, capture_output=True, cwd=REPOSITORY, env=os.environ | with_env)
    try:
        yield sorted(set(below(os.getpid())) - before)
    finally:
        for pid in set(below(os.getpid())) - before:
            kill(pid)
        end_orphans(before, 10.0)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def losing_a_node(kind: str) -> Making:
    """Of a standing cluster, while a run is on it; kind: head, second of two, or one of the head's processes."""

    @contextmanager
    def make(scene: Scene) -> Iterator[Trouble]:
        port, ray = free_port(), OF_NODES if kind == "second" else STANDING
        with ExitStack() as stack:
            pids = stack.enter_context(standing_node(scene.folder / "ray", port, True, ray))
            if kind == "second":
                pids = stack.enter_context(standing_node(scene.folder / "ray", port, False, ray))

            def strike(process: subprocess.Popen[bytes]) -> None:
                wait_for(process, lambda: peers(process.pid, "child"))
                a_moment(scene, process, 0.9)
                chosen = [pid for pid in pids if kind not in PEERS or re.search(PEERS[kind], command_line(pid))]
                assert sum(map(kill, chosen)), "no such process"

            yield Trouble(environment=ray | {"RAY_ADDRESS": f"127.0.0.1:{port}"}, during=strike, leaves=True)

    return make


# Trials.


@dataclass(frozen=True)
class Command:
    """One of a program's, as it is tried. {out} is what it works on or writes, {made} what was made for all."""

    words: str
    at: str = ""  # of {made}: what {out} is a copy of when it begins
    goes_on: bool = False  # the same command resumes; of the others nothing is half there
    ends: bool = True  # by itself


@dataclass(frozen=True)
class Row:
    """A promise, and how it is tried."""

    promise: str
    make: Making
    commands: Sequence[str]
    codes: Sequence[int] = (COMPLETE,)
    says: str = GOES_ON  # in the line of a code that is neither 0 nor a signal's
    needs_root: bool = False
    each_once: bool = False  # the trouble is always the same: no command is tried twice


@dataclass
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str
    seconds: float
    peak_kb: int = 0  # of address space


@dataclass(frozen=True)
class Undisturbed:
    """What a command comes to without trouble."""

    ended: Ended
    stable: Mapping[str, str]  # name -> digest of what it makes, or empty where that differs from time to time


def product(out: Path) -> dict[str, str]:
    """Name -> digest: of files, and of the columns of tables, in the order of their keys."""
    from deltalake import DeltaTable

    tables = sorted(log.parent for log in out.rglob("_delta_log"))
    paths = [path for path in sorted(out.rglob("*")) if path.is_file() and not {*path.parents} & {*tables}]
    found = {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    for folder in tables:
        rows = DeltaTable(str(folder)).to_pyarrow_table()
        key = next((key for key in ("attempt_id", "drive_id", "clip_id", "plan_id") if key in rows.column_names), None)
        rows = rows.sort_by(key) if key else rows
        for name in set(rows.column_names) - {"tries"}:  # runs that a kill ended count
            words = repr(rows[name].to_pylist())
            found[f"{folder.relative_to(out)}:{name}"] = hashlib.sha256(words.encode()).hexdigest()
    return found


def settled(out: Path) -> int:
    """Attempts that the tables of a run have done."""
    store = Store(out)
    kinds = store.outcomes.read(["kind"])["kind"].to_pylist() if len(store.outcomes) else []
    return len(store.samples) + kinds.count("rejected")


def wait_for_page(port: int, process: subprocess.Popen[bytes]) -> None:
    """Until the dashboard answers."""
    end = time.monotonic() + OVER_S
    while process.poll() is None and time.monotonic() < end:
        with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/", timeout=10.0) as answer:
            assert answer.status == 200 and b"</html>" in answer.read().lower(), "no page"
            return
        time.sleep(0.1)


def end_orphans(before: set[int], seconds: float) -> list[str]:
    """Waits for what a command has left behind; the command lines of what had to be ended."""
    end, told = time.monotonic() + seconds, list[str]()
    while left := {pid: line for pid, line in below(os.getpid()).items() if pid not in before}:
        for pid in left:
            with suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)
        if time.monotonic() > end:
            told += [line for pid, line in left.items() if line and kill(pid)]
        time.sleep(0.05)
    return told


@dataclass
class Harness:
    """All that trials share."""

    folder: Path
    commands: Mapping[str, Command]
    makers: Mapping[str, str]  # folder of what commands work on -> the command that makes it
    write_files: Callable[[Path], None]  # the other folders
    rng: random.Random
    keeps: bool
    known: dict[str, Undisturbed] = field(default_factory=dict)

    @property
    def made(self) -> Path:
        return self.folder / "made"

    def make(self, command: Command) -> None:
        """What a command works on, where it is not there yet."""
        for name in {*re.findall(r"\{made\}/(\w+)", command.words), command.at} - {""}:
            if (self.made / name).exists():
                continue
            if words := self.makers.get(name):
                self.make(Command(words.replace(f"{{made}}/{name}", "")))
                ended = self.run(Command(words), self.made, Trouble(), "made")
                assert ended.code == COMPLETE, ended
            else:
                self.write_files(self.made)

    def undisturbed(self, name: str) -> Undisturbed:
        """Twice: what differs then is not looked at later. Kept beside what is made once."""
        kept = self.made / f"{name.replace(' ', '-')}.json"
        if kept.exists() and name not in self.known:
            ended, stable = json.loads(kept.read_text())
            self.known[name] = Undisturbed(Ended(**ended), stable)
        if name not in self.known:
            self.make(self.commands[name])
            found = []
            for number in (1, 2):
                folder = self.folder / f"{name.replace(' ', '-')}{number}"
                self._begin(self.commands[name], folder)
                ended = self.run(self.commands[name], folder, Trouble(), "first")
                assert ended.code == COMPLETE, (name, ended)
                assert not TRACE.search(ended.out + ended.err), (name, ended)
                found.append((ended, product(folder / "out")))
                shutil.rmtree(folder)
            (_, one), (ended, other) = found
            stable = {key: one[key] if one[key] == other[key] else "" for key in one.keys() & other.keys()}
            self.known[name] = Undisturbed(ended, stable)
            kept.write_text(json.dumps([asdict(ended), stable]))
        return self.known[name]

    def _begin(self, command: Command, folder: Path) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "tmp").mkdir(parents=True)
        if command.at:
            shutil.copytree(self.made / command.at, folder / "out")

    def run(self, command: Command, folder: Path, trouble: Trouble, tag: str, port: int = 0) -> Ended:
        """A command in a process of its own, until it has ended with all that it began. Raises AssertionError."""
        port = port or free_port()
        words = [word.format(out=folder / "out", made=self.made, port=port) for word in command.words.split()]
        given: dict[str, str | None] = {
            "TMPDIR": str(folder / "tmp" if (folder / "tmp").exists() else self.folder),
            "XDG_CACHE_HOME": str(self.folder / "cache"),
            "NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", str(user_cache())),
            "RAY_ADDRESS": None,
            **trouble.environment,
        }
        environment = {key: value for key, value in (os.environ | given).items() if value is not None}
        before, began, peak_kb = set(below(os.getpid())), time.monotonic(), 0
        said, warned = folder / f"{tag}.out", folder / f"{tag}.err"
        with ExitStack() as stack:
            to: Any = stack.enter_context(open(trouble.stdout if trouble.stdout.startswith("/") else said, "wb"))
            if trouble.stdout == "nobody":
                read, to = os.pipe()
                os.close(read)
                stack.callback(os.close, to)
            process = subprocess.Popen(
                [*trouble.prefix, sys.executable, "-m", *words],
                cwd=REPOSITORY,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=to,
                stderr=stack.enter_context(warned.open("wb")),
                start_new_session=True,
            )
        try:
            if trouble.during is not None:
                trouble.during(process)
            with suppress(OSError):
                process.stdin.close()  # type: ignore[union-attr]
            if not command.ends and process.poll() is None:
                wait_for_page(port, process)
                process.send_signal(signal.SIGINT)
            while process.poll() is None and time.monotonic() - began < OVER_S:
                time.sleep(0.03)
                with suppress(OSError, StopIteration):
                    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
                    peak_kb = next(int(line.split()[1]) for line in lines if line.startswith("VmPeak:"))
            assert process.poll() is not None, f"no end in {OVER_S:.0f} s: {warned.read_text()[-500:]}"
        finally:
            process.kill()
            process.wait()
            left = end_orphans(before, 0.0 if trouble.leaves else LEFT_S)
        assert not left or trouble.leaves, f"left behind after {LEFT_S:.0f} s: {left}"
        told = said.read_text(errors="replace") if said.exists() else ""
        err = RAY_S_OWN.sub("", warned.read_text(errors="replace"))
        return Ended(process.returncode, told, err, time.monotonic() - began, peak_kb)

    def trial(self, name: str, row: Row, number: int) -> None:
        """One command in trouble, and again without. Raises AssertionError with what is wrong, TooLate."""
        command, known = self.commands[name], self.undisturbed(name)
        folder = self.folder / f"t{number}"
        self._begin(command, folder)
        port = free_port()
        scene = Scene(
            folder,
            port,
            self.rng,
            known.ended,
            lambda other, tag: self.run(self.commands[other], folder, Trouble(), tag),
        )
        with row.make(scene) as trouble:
            ended = self.run(command, folder, trouble, "first", port)
        all_said = ended.out + ended.err
        assert not (trace := TRACE.search(all_said)), f"{trace}: {all_said[-1500:]}"
        assert ended.code in row.codes, f"exit code {ended.code}: {all_said[-1500:]}"
        if ended.code > 0:
            lines = [line for line in all_said.splitlines() if SAID.search(line)]
            assert len(lines) == 1, f"not one line: {lines}; {all_said[-1500:]}"
            assert re.search(row.says, lines[0]), f"exit code {ended.code} and the line does not say how: {lines[0]}"
        if ended.code == COMPLETE:
            self.compare(name, folder / "out", known)
            return
        done = settled(folder / "out") if (folder / "out" / "samples").exists() and "import" not in name else None
        again = self.run(command, folder, Trouble(), "again")
        assert again.code == COMPLETE, f"exit code {again.code} of the same command again: {again.err[-1500:]}"
        if done is not None and (found := re.search(r"found (\d+) attempts done", again.out)):
            assert int(found[1]) == done, f"{done} attempts were committed, {found[1]} are not made again"
        self.compare(name, folder / "out", known)

    def compare(self, name: str, out: Path, known: Undisturbed) -> None:
        """What is there against what undisturbed commands make. Raises AssertionError."""
        made = product(out)
        missing = sorted(known.stable.keys() - made.keys())
        assert not missing, f"missing: {missing[:5]}"
        differ = sorted(key for key, digest in known.stable.items() if digest and made[key] != digest)
        assert not differ, f"not as of an undisturbed command: {differ[:5]}"
        if (out / "run.json").exists():
            assert (found := verify(Store(out)).damage) == (), f"damage: {found}"

    def row(self, name: str, row: Row, trials: int, only: str) -> tuple[int, int, float]:
        """(trials, held, CPU seconds) of all its commands, or one; findings are told at once."""
        commands = [only] if only else row.commands
        wanted = min(trials, len(commands)) if row.each_once else trials
        order = self.rng.sample(commands, min(wanted, len(commands)))
        for one in order:
            self.undisturbed(one)
        began, made, held, late = cpu_s(), 0, 0, 0
        while made < wanted and late < 10 * wanted:
            one = order[(made + late) % len(order)]
            try:
                self.trial(one, row, made)
                held += 1
            except TooLate:
                late += 1
                continue
            except AssertionError as error:
                print(f"{name}, {one}: {error}\n", file=sys.stderr, flush=True)
                if self.keeps:
                    kept = self.folder / f"{name}-{one.replace(' ', '-')}-{made}"
                    shutil.rmtree(kept, ignore_errors=True)
                    (self.folder / f"t{made}").rename(kept)
            made += 1
            shutil.rmtree(self.folder / f"t{made - 1}", ignore_errors=True)
        return made, held, cpu_s() - began


def cpu_s() -> float:
    """Of all processes below that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
