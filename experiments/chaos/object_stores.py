"""A run whose bucket misbehaves, and the same command again: `python -m experiments.chaos.object_stores [NAME ...]`.

Prints a line for each trouble: what the run ended with and said, what the next one, without the trouble, ended with,
and how its rows compare with those of a run that nothing disturbed.
"""

import sys
from collections.abc import Callable, Mapping, Sequence

from tests.chaos.buckets.bad_store import BUCKET, Fault, What, bad_store
from tests.chaos.buckets.object_stores import check, undisturbed

COMMIT, SHARD, COPY = "samples/_delta_log/0.*json", "samples/round.*parquet", "samples/_commits/"

TROUBLES: Mapping[str, Callable[[], Fault]] = {
    "503 for five requests": lambda: Fault(What.SLOW_DOWN, first=40, times=5),
    "503 from then on": lambda: Fault(What.SLOW_DOWN, first=120),
    "late answers, 2 s, to 20 requests": lambda: Fault(What.LATE, first=40, times=20, seconds=2.0),
    "a commit's answer, 40 s late": lambda: Fault(What.LATE, "PUT", COMMIT, first=3, times=1, seconds=40.0),
    "half an answer, five times": lambda: Fault(What.TORN, "GET", first=20, times=5),
    "half listings, five times": lambda: Fault(What.TORN, "GET", "list-type=2&prefix|start-after", first=30, times=5),
    "half answers from then on": lambda: Fault(What.TORN, "GET", first=70),
    "credentials expire early": lambda: Fault(What.EXPIRED, first=60),
    "credentials expire at a shard": lambda: Fault(What.EXPIRED, first=177),
    "credentials expire late": lambda: Fault(What.EXPIRED, first=243),
    "no right to write any more": lambda: Fault(What.DENIED, "PUT|POST", first=60),
    "a shard's upload cut, once": lambda: Fault(What.CUT, "PUT", SHARD, times=1),
    "uploads of shards cut, each": lambda: Fault(What.CUT, "PUT", SHARD),
    "end of an upload unanswered, once": lambda: Fault(What.UNANSWERED, "POST", SHARD + ".*uploadId", times=1),
    "a commit cut, once": lambda: Fault(What.CUT, "PUT", COMMIT, first=3, times=1),
    "a commit unanswered, once": lambda: Fault(What.UNANSWERED, "PUT", COMMIT, first=3, times=1),
    "a claim unanswered, once": lambda: Fault(What.UNANSWERED, "PUT", COMMIT, first=2, times=1),
    "a table's first commit unanswered": lambda: Fault(What.UNANSWERED, "PUT", COMMIT, first=1, times=1),
    "listings 3 s behind": lambda: Fault(What.UNLISTED, seconds=3.0),
    "listings 10 s behind": lambda: Fault(What.UNLISTED, seconds=10.0),
    "SIGKILL in a shard's upload": lambda: Fault(What.KILL, "PUT", SHARD, first=2),
    "SIGKILL in a commit": lambda: Fault(What.KILL, "PUT", COMMIT, first=3),
    "SIGKILL in a commit's copy": lambda: Fault(What.KILL, "PUT", COPY, first=3),
}


def main(names: Sequence[str]) -> int:
    failed = 0
    print("| the bucket | times | exit code | it said | again |\n|---|---|---|---|---|", flush=True)
    with undisturbed() as golden, bad_store() as store:
        for number, name in enumerate(TROUBLES):
            if names and name not in names:
                continue
            fault = TROUBLES[name]()
            try:
                first, again = check(store, golden, f"s3://{BUCKET}/run-{number}", fault)
            except AssertionError as error:
                failed += 1
                print(f"| {name} | {fault.met} | FAILED | {error} | |", flush=True)
                continue
            print(f"| {name} | {fault.met} | {first.code} | {first.last} | {again.code} |", flush=True)
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
