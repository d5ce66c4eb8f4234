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
from pathlib import Path

from tests.chaos.hostile_files.doors import DOORS, LOGS, write_innocents
from tests.chaos.hostile_files.trials import BATCH, Verdict, in_fork, judge_logs, judge_single, load_what_is_read_with


def main(
    cases: int = 250, minutes: float = 150.0, to: str = "build/hostile_files", doors: str = "", only: str = ""
) -> int:
    end, kept = time.monotonic() + 60.0 * minutes, Path(to) / "verdicts.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    told = [Verdict(**json.loads(line)) for line in kept.read_text().splitlines()] if kept.exists() else []
    if only:
        asked = [case.split(":") for case in re.split(r"(?<=\d),", only)]
        wanted = {door: [int(n) for d, n in asked if d == door] for door in dict.fromkeys(door for door, _ in asked)}
    else:
        wanted = {
            door: [*range(cases)] for door in DOORS if not doors or any(word in door for word in doors.split(","))
        }
    known = {(verdict.door, verdict.number) for verdict in told}
    left = {door: [n for n in numbers if (door, n) not in known] for door, numbers in wanted.items()}
    (innocents := kept.parent.absolute() / "innocents").mkdir(exist_ok=True)
    load_what_is_read_with(left)
    if (made := in_fork(lambda: write_innocents(innocents, left) or 0, kept.parent / "made")).code:
        raise RuntimeError(made.said[-2000:])
    with kept.open("a") as file:
        for at in range(0, max(map(len, left.values())), BATCH):  # a part that ends early has some of every kind
            for door in left:
                numbers = left[door][at : at + BATCH]
                if not numbers or time.monotonic() > end:
                    continue
                folder = Path(tempfile.mkdtemp())  # a TemporaryDirectory would be removed by forks that end
                singly = ([judge_single(innocents, folder / str(n), door, n)] for n in numbers)
                for new in [judge_logs(innocents, folder, door, numbers)] if door in LOGS else singly:
                    for verdict in new:
                        if verdict.finding:
                            print(verdict.text, file=sys.stderr)
                        print(json.dumps(verdict.__dict__), file=file, flush=True)
                    told += new
                    if time.monotonic() > end:
                        break
                shutil.rmtree(folder)
    print("| door | cases | attacks | read | refused | findings | CPU s | GB |\n|---|---|---|---|---|---|---|---|")
    of = defaultdict[str, list[Verdict]](list)
    for verdict in told:
        of[verdict.door].append(verdict)
    for door, some in of.items():
        counts = [
            len(some),
            len({v.attack for v in some}),
            *(sum(v.how == how for v in some) for how in ("read", "refused")),
        ]
        most = [f"{max(v.cpu_s for v in some):.1f}", f"{max(v.gb for v in some):.2f}"]
        print("|", " | ".join(map(str, [door, *counts, sum(bool(v.finding) for v in some), *most])), "|")
    print(f"{len(told):,} cases")
    return sum(bool(verdict.finding) for verdict in told)


if __name__ == "__main__":
    words = dict(word.split("=", 1) for word in sys.argv[1:])
    kinds = {"cases": int, "minutes": float}
    sys.exit(bool(main(**{name: kinds.get(name, str)(word) for name, word in words.items()})))  # type: ignore[arg-type]
