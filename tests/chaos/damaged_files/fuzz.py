"""Every reader against mutants of its files, elsewhere: `python -m tests.chaos.damaged_files.fuzz [N] [KINDS]`.

Of each kind N mutants (5,000 where it is not said) are read. A mutant is accepted, where what comes out passes the
reader's own checks and, of kinds with a checksum, is what went in; or it is refused, by the errors that the reader
promises. Everything else is a finding: a process that dies, 10 s without an answer, another error, code that ran.
"""

import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from factory.readers.apart import ProcessFunction
from factory.readers.base import BadClip, Unreadable
from tests.chaos.damaged_files.fuzzed_kinds import KINDS, Readable, write_all
from tests.chaos.damaged_files.mutants_of_files import rng_of

N, LIMIT_S = 5000, 10.0
RUNS = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect", "ctypes.dlopen")
_ran: list[str] = []


@dataclass(frozen=True)
class Question:
    """One mutant."""

    folder: str  # of write_all
    kind: str
    number: int


def answer(question: Question) -> str:
    """accepted, refused, or what is wrong; in the process that reads."""
    readable, whole = _readable(question.folder, question.kind)
    path = readable.path
    path.write_bytes(readable.mutant(whole, rng_of(question.kind, question.number)))
    _ran.clear()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = readable.read()
    except Unreadable as error:
        return f"raised {error.problem}"[:300]
    except readable.refusals as error:
        if readable.named and path.name not in str(error):
            return f"nameless refusal: {type(error).__name__} {error}"[:300]
        told = "refused"
    except Exception as error:
        return f"raised {type(error).__name__}: {error}"[:300]
    else:
        told = "accepted" if readable.is_sound(value) else "accepted, and is something else"
    finally:
        path.write_bytes(whole)
    return f"ran {_ran[0]}" if _ran else told


@cache
def _readable(folder: str, kind: str) -> tuple[Readable, bytes]:
    """Opened once in a process, and read once as it is, so that what a first read loads is loaded."""
    readable = KINDS[kind](Path(folder))
    whole = readable.path.read_bytes()
    assert readable.is_sound(readable.read()), kind
    sys.addaudithook(_note)
    return readable, whole


def _note(event: str, _arguments: object) -> None:
    if event in RUNS:
        _ran.append(event)


def fuzzed(folder: Path, kind: str, numbers: range, say: Callable[[str], object] = print) -> Counter[str]:
    """How many mutants were accepted and refused; each finding is said, and counted by its first word."""
    told, ask = Counter[str](), ProcessFunction(answer)
    whole = KINDS[kind](folder).path.read_bytes()
    ask(Question(str(folder), kind, 0), kind)  # what a first read loads and compiles is no mutant's time
    for number in numbers:
        try:
            found = ask(Question(str(folder), kind, number), kind, LIMIT_S)
        except BadClip as error:
            found = f"hang {error}" if "given up" in str(error) else f"crash {error}"
            KINDS[kind](folder).path.write_bytes(whole)
            ask(Question(str(folder), kind, 0), kind)
        if found not in ("accepted", "refused"):
            say(f"{kind} {number}: {found}")
            found = found.partition(" ")[0]
        told[found] += 1
    return told


def main(n: int = N, only: tuple[str, ...] = ()) -> int:
    """Print the table; the number of findings."""
    findings = 0
    print("| kind | mutants | accepted | refused | anything else |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        write_all(Path(folder))
        for kind in only or KINDS:
            told: Mapping[str, int] = fuzzed(Path(folder), kind, range(n), partial(print, file=sys.stderr))
            rest: dict[str, Any] = {name: count for name, count in told.items() if name not in ("accepted", "refused")}
            findings += sum(rest.values())
            said = ", ".join(f"{count} {name}" for name, count in rest.items()) or "0"
            print(f"| {kind} | {n:,} | {told.get('accepted', 0):,} | {told.get('refused', 0):,} | {said} |", flush=True)
    return findings


if __name__ == "__main__":
    from tests.chaos.damaged_files.fuzz import main  # so that another process can import what it is asked

    sys.exit(bool(main(*map(int, sys.argv[1:2]), only=tuple(sys.argv[2:]))))
