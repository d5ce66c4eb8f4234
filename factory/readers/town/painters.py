"""Several towns at once, each written by a process of its own: planning a drive is Python, and holds the interpreter.

    python -m factory.readers.town.painters <a town as JSON>       what such a process runs

The process that waits for them owns the folders they write in. To stop them it kills them and removes those: an
interrupt is an exception in Python, and one that arrives while a kernel is compiled or loaded is lost in a callback.
They end with it, however it ends: it holds the other end of the pipe that is their standard input.

Only towns with sensors are worth a process, which starts in seconds: a log without cameras and lidar is written in two.
"""

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from factory.exits import as_worker, without_terminal
from factory.readers.settings import TownSettings
from factory.readers.town.town import log_name
from factory.readers.town.write import write_logs
from factory.readers.whole_folder import finish_whole, make_whole, mend, unfinished_folder
from factory.wording import time_text

MOST_PAINTERS = 8  # processes; each takes half a gigabyte
LOOK_EVERY_S = 0.1


@dataclass(frozen=True)
class TownFolder:
    """The chosen logs of one seed's town, and the folder that holds them or will."""

    seed: int
    indices: tuple[int, ...]
    root: Path

    def logs(self) -> dict[str, Path]:
        """Log id -> folder, of logs that may not be written yet."""
        return {name: self.root / name for name in (log_name(self.seed, index) for index in self.indices)}


def write_one(town: TownFolder, settings: TownSettings) -> None:
    """Writes the town whole, unless it is there."""
    make_whole(town.root, lambda folder: write_logs(folder, town.indices, town.seed, settings))


def mend_all(towns: Sequence[TownFolder], settings: TownSettings) -> None:
    """Makes the files of those that are there and damaged again."""
    for town in towns:
        if town.root.is_dir():
            mend(town.root, partial(write_logs, indices=town.indices, seed=town.seed, settings=settings))


def write_all(towns: Sequence[TownFolder], settings: TownSettings) -> None:
    """Writes the towns that are missing, as many at once as there are cores; how far it is goes to stderr.

    Raises what a process was refused a file with, a full disk say, as if the town had been written here; RuntimeError
    where it ended otherwise, with what it said on stderr. The towns that others were writing are given up then.
    Interrupted, it leaves whole towns and nothing else.
    """
    missing = [town for town in towns if not town.root.is_dir()]
    at_once = min(len(missing), os.cpu_count() or 1, MOST_PAINTERS) if settings.cameras or settings.lidar_beams else 1
    done, began = 0, time.monotonic()

    def show(town: TownFolder) -> None:
        nonlocal done
        done += 1
        left = (time.monotonic() - began) / done * (len(missing) - done)
        told = f"town {done} of {len(missing)}: seed {town.seed}, {len(town.indices)} logs painted"
        print(f"{told}  ETA {time_text(left)}", file=sys.stderr, flush=True)

    if at_once <= 1:
        for town in missing:
            write_one(town, settings)
            show(town)
        return
    waiting, painting, begun = deque(missing), dict[subprocess.Popen[bytes], TownFolder](), list[Path]()
    lifeline, held = os.pipe()
    try:
        while waiting or painting:
            while waiting and len(painting) < at_once:
                town = waiting.popleft()
                begun.append(unfinished_folder(town.root))
                with without_terminal():
                    painting[_painter(town, begun[-1], settings, lifeline)] = town
            for child in [child for child in painting if child.poll() is not None]:
                town = painting.pop(child)
                if refused := _refused(child):
                    raise refused
                if child.returncode != 0:
                    ended = f"its process ended with exit {child.returncode} and said above why"
                    raise RuntimeError(
                        f"town {town.seed}: {ended}; towns that are written stay, the same command goes on"
                    )
                show(town)
            time.sleep(LOOK_EVERY_S)
    finally:
        os.close(held)
        os.close(lifeline)
        for child in painting:
            child.kill()
        for child in painting:
            child.communicate()
        for folder in begun:
            shutil.rmtree(folder, ignore_errors=True)  # where its town is whole, it is gone


def _painter(town: TownFolder, unfinished: Path, settings: TownSettings, lifeline: int) -> "subprocess.Popen[bytes]":
    told = {"seed": town.seed, "indices": town.indices, "root": str(town.root), "settings": asdict(settings)}
    command = [sys.executable, "-m", __name__, json.dumps(told | {"unfinished": str(unfinished)})]
    return subprocess.Popen(command, stdin=lifeline, stdout=subprocess.PIPE)  # noqa: S603 - a list, no shell


def _refused(ended: "subprocess.Popen[bytes]") -> OSError | None:
    """What a painter that ended was refused, as it told."""
    told, _ = ended.communicate()
    return OSError(*json.loads(told)) if told else None


def main(told: str) -> None:
    """A painter's process: one town, on one core. Tells on standard output what it is refused."""
    as_worker()
    threading.Thread(target=_end_with_input, daemon=True).start()
    town = json.loads(told)
    arguments = town["indices"], town["seed"], TownSettings(**town["settings"])
    unfinished, root = Path(town["unfinished"]), Path(town["root"])
    try:
        finish_whole(unfinished, root, lambda folder: write_logs(folder, *arguments, threads=1))
    except OSError as error:
        if error.errno is None:
            raise
        print(json.dumps([error.errno, error.strerror, os.fspath(error.filename)]))


def _end_with_input() -> None:
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
