"""Compiles every kernel once, into the on-disk cache, before workers start."""

import gc
import hashlib
import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from threading import Event, Lock, Thread

from factory.config.datasets import words_of
from factory.exits import ignore_terminal_signals, terminal_signals_blocked
from factory.files import locked
from factory.graph.steps import NotReady
from tasks.caches import Damaged, with_checksum, without_checksum
from tasks.kernels.compiled import USED, cache_dir, cache_write_error, make_cache_dir, processor_key, write_whole
from tasks.render.settings import RenderMode, RenderSettings, SceneFrom

ENOUGH_S = 0.2  # between two looks whether compiling is to be given up
_one_at_a_time = Lock()
log = logging.getLogger(__name__)


def kernel_parts(simulates: bool, traffic: str, render: RenderSettings, photos_alone: bool) -> list[str]:
    """What a run enters.

    simulates: it has another expert than `human`; traffic: the mode of the drives' traffic. photos_alone: clips may
    have photos and no lidar.
    """
    parts = ["judge", "plan"]
    if simulates and traffic != "replay":
        parts.append({"idm": "drive", "navsim": "navsim", "custom": "policy"}[traffic])
    if render.mode is RenderMode.AUTO:
        parts.append("fit" if render.scene is SceneFrom.FIT else "render")
        if render.rig.may_correct(photos_alone):
            parts.append("rig")
        if render.backend.on_gpu:
            parts.append("gpu")
    return parts


@contextmanager
def compiling_ahead(parts: Sequence[str]) -> Iterator[None]:
    """Compiles beside what is done inside, and gives up what is not compiled at the end of it.

    Code inside that needs the kernels calls `compile_kernels` as usual, which waits for these and raises what failed.
    """
    enough = Event()

    def ahead() -> None:
        with suppress(NotReady, RuntimeError):
            compile_kernels(parts, enough)

    Thread(target=ahead, daemon=True).start()
    try:
        yield
    finally:
        enough.set()


def compile_kernels(parts: Sequence[str], enough: Event | None = None) -> None:
    """Compiles what is not in the cache yet, each part in a process of its own, as many at once as there are cores.

    Of processes that want the same at once, one compiles and the others wait for it.
    Raises NotReady where the cache cannot be written or gsplat cannot work, and RuntimeError with a part's last words
    where it fails or is given up because there is `enough`.
    """
    if "gpu" in parts:
        from tasks.render.splatting.gsplat_backend import BackendMissing, require

        try:
            require()
        except BackendMissing as error:
            raise NotReady(str(error)) from error
    if all(map(_is_compiled, parts)):
        return
    try:
        make_cache_dir()
        with (cache_dir() / f"lock-{_digest()}").open("w") as lock:
            if enough is None:  # somebody waits
                print("compiling kernels, once for this version: about a minute", file=sys.stderr, flush=True)
            with _one_at_a_time, locked(lock):
                missing, enough = [name for name in parts if not _is_compiled(name)], enough or Event()
                with ThreadPoolExecutor(os.cpu_count()) as pool:
                    try:
                        with terminal_signals_blocked():  # amid it one could leave a lock of the pool's held for ever
                            begun = pool.map(partial(_compile_part, enough=enough), missing)
                        list(begun)
                    except KeyboardInterrupt:  # which a part does not hear
                        enough.set()
                        raise
    except OSError as error:
        raise NotReady(cache_write_error(error)) from error


def _digest(*contents: bytes) -> str:
    """8 hex digits of the processor and of contents."""
    return hashlib.sha256(b"".join([processor_key().encode(), *contents])).hexdigest()[:8]


def part_marker(name: str) -> Path:
    """The file that lists what a part has in the cache; in its name the processor and the code that enters it."""
    built_for = f"-{version('torch')}-{version('gsplat')}" if name == "gpu" else ""
    enters = find_spec(PARTS[name].partition(":")[0])
    assert enters is not None and enters.origin is not None, PARTS[name]
    return cache_dir() / f"compiled-{_digest(Path(enters.origin).read_bytes())}-{name}{built_for}"


def _is_compiled(name: str) -> bool:
    """The part was compiled, and nobody has taken a file of it away since."""
    try:
        files = [
            cache_dir() / file
            for file in without_checksum(part_marker(name).read_bytes(), part_marker(name).name).decode().splitlines()
        ]
    except OSError:  # not there, or in a folder that cannot be: whoever then writes into it says so
        return False
    except Damaged as error:
        log.warning("%s: %s; it is made again", part_marker(name), error)
        return False
    return all(file.is_file() for file in files)


def _compile_part(name: str, enough: Event) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    environment["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"  # of what was tried in vain, never shown
    command = [sys.executable, "-m", "factory.stages.warm", name]
    if enough.is_set():
        raise RuntimeError(f"compiling the kernels of {name} was not begun")
    with terminal_signals_blocked():
        part = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)  # noqa: S603 (ours)
    with part:
        said = None
        while said is None:  # until it has ended, by itself or because there is enough
            try:
                said = part.communicate(timeout=ENOUGH_S)[1]
            except subprocess.TimeoutExpired:
                if enough.is_set():
                    part.terminate()
    if part.returncode == DISK_FULL:
        raise OSError(said.strip().splitlines()[-1])
    if part.returncode == NOT_HERE:
        raise NotReady(said.strip().splitlines()[-1])
    if part.returncode != 0:
        raise RuntimeError(f"compiling the kernels of {name} failed: {said[-2000:]}")


def _compile_and_mark(name: str) -> int:
    """One part, in this process; the exit code."""
    ignore_terminal_signals()
    gc.disable()  # a process that ends soon: some 220 MB more for a sixth of its time
    try:
        resolve_name(PARTS[name])()
    except NotReady as error:
        print(error, file=sys.stderr)
        return NOT_HERE
    listed = "\n".join(sorted([*(path.relative_to(cache_dir()).as_posix() for path in USED), *_gsplat_files()]))
    try:
        for part in (name, *INCLUDED.get(name, ())):
            write_whole(part_marker(part), with_checksum(listed.encode(), part_marker(part).name))
    except OSError as error:
        print(error, file=sys.stderr)
        return DISK_FULL
    return 0


def _gsplat_files() -> list[str]:
    """What it was built to, where this process has loaded it."""
    loaded = [getattr(module, "__file__", None) or "" for name, module in sys.modules.items() if "gsplat" in name]
    return [path for path in loaded if path.endswith(".so")]


# Part -> what enters its kernels, `module:function`; the last are the data sets'.
PARTS = {
    part: f"factory.stages.entries:enter_{part}"
    for part in ("judge", "plan", "drive", "navsim", "policy", "render", "fit", "rig", "gpu")
} | words_of("KERNELS")
INCLUDED = {"judge": ("plan",), "fit": ("render",)}
DISK_FULL, NOT_HERE = 5, 6  # exit codes of a part whose files could not be kept, and that this machine cannot enter


if __name__ == "__main__":  # what compiling a part starts, in a process of its own
    sys.exit(_compile_and_mark(sys.argv[1]))
