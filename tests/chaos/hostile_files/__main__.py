"""Crafted files against the commands that read them: `python -m tests.chaos.hostile_files [cases=250] [minutes=150]
[to=build/hostile_files] [doors=word,word] [only=door:number,door:number]`.

Of each door (doors.py) so many cases; what is judged already, by the lines of verdicts.jsonl, is not tried again. Logs
lie by 25 beside an innocent one and are read by one run; a run that is not well is tried again in halves, down to the
files that did it. A single file is read by a command in a process forked from one that has imported it, one in 50 by
the command as it is typed. Findings end it with 1.
"""

import json
import re
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.chaos.hostile_files import trials
from tests.chaos.hostile_files.doors import DOORS, LOGS, write_innocents

BATCH = 25  # logs beside an innocent one


def main(
    cases: str = "250", minutes: str = "150", to: str = "build/hostile_files", doors: str = "", only: str = ""
) -> int:
    end, kept = time.monotonic() + 60.0 * float(minutes), Path(to).absolute() / "verdicts.jsonl"
    (innocents := kept.with_name("innocents")).mkdir(parents=True, exist_ok=True)
    told = [trials.Verdict(**json.loads(line)) for line in kept.read_text().splitlines()] if kept.exists() else []
    wanted = defaultdict[str, list[int]](list)
    for case in re.split(r"(?<=\d),", only) if only else ():
        wanted[case.partition(":")[0]].append(int(case.partition(":")[2]))
    if not only:
        wanted |= {door: [*range(int(cases))] for door in DOORS if any(word in door for word in doors.split(","))}
    known = {(verdict.door, verdict.number) for verdict in told}
    left = {door: [n for n in numbers if (door, n) not in known] for door, numbers in wanted.items()}
    trials.load_what_is_read_with(left)
    if (made := trials.in_fork(lambda: write_innocents(innocents, left), kept.with_name("made"), trials.LIMIT_S)).code:
        raise RuntimeError(made.said[-2000:])
    with kept.open("a") as file:
        for at in range(0, max(map(len, left.values())), BATCH):  # a part that ends early has some of every kind
            for door in left:
                for new in tried(innocents, door, left[door][at : at + BATCH], end):
                    if new.finding:
                        print(f"{door} {new.number} ({new.attack}): {new.finding}", file=sys.stderr, flush=True)
                    print(json.dumps(new.__dict__), file=file, flush=True)
                    told.append(new)
    print(table_of(told))
    return sum(bool(verdict.finding) for verdict in told)


def tried(innocents: Path, door: str, numbers: Sequence[int], end: float) -> Iterator[trials.Verdict]:
    folder = Path(tempfile.mkdtemp())  # a TemporaryDirectory would be removed by forks that end
    if door in LOGS and numbers and time.monotonic() < end:
        yield from trials.judge_logs(innocents, folder, door, {n: trials.crafted(door, innocents, n) for n in numbers})
    for n in numbers if door not in LOGS else ():
        if time.monotonic() < end:
            yield trials.judge_single(innocents, folder / str(n), door, n)
    shutil.rmtree(folder)


def table_of(told: Sequence[trials.Verdict]) -> str:
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
