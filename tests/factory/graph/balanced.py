"""The balance of a store, held against a count clip by clip."""

from pathlib import Path

from factory.store.funnel import BalanceSheet, funnel_of
from factory.store.samples import Store

TASK_OF = {"rollout": "drive", "expert": "drive", "reward": "drive", "render": "render", "label": "label"}
ATTEMPT = ("drive", "render", "label")
Counts = tuple[int, int, int, int, int]  # planned, accepted, rejected, failed, pending


def balance(out: Path) -> BalanceSheet:
    """From the tables, held against a count clip by clip and each stage's own sum."""
    store = Store(out)
    found = funnel_of(store).balance
    assert {(one.stage, one.expert, one.round): counts(one) for one in found.stages if one.planned} == slow(store)
    for one in found.stages:
        assert one.planned == one.accepted + one.rejected + one.failed + one.pending
    return found


def counts(one: object) -> Counts:
    return tuple(getattr(one, name) for name in ("planned", "accepted", "rejected", "failed", "pending"))  # type: ignore[return-value]


def slow(store: Store) -> dict[tuple[str, str, int], Counts]:
    """Clip by clip; of a store whose rows are all of one run's settings."""
    wanted: dict[str, dict[str, int]] = {}
    for plan in store.plans.read().to_pylist():
        for clip in plan["clip_ids"]:
            for expert, rounds in plan["rounds"]:
                of_clip = wanted.setdefault(clip, {})
                of_clip[expert] = max(of_clip.get(expert, 0), rounds)
    lists = {row["clip_id"]: row["reason"] for row in store.candidates.read().to_pylist()}
    samples, outcomes = (
        store.samples.read(["clip_id", "expert", "round"]).to_pylist(),
        store.outcomes.read().to_pylist(),
    )
    found: dict[tuple[str, str, int], list[int]] = {}

    def count(stage: str, expert: str, number: int, became: str) -> None:
        names = ("accepted", "rejected", "failed", "pending")
        row = found.setdefault((stage, expert, number), [0] * 5)
        row[0] += 1
        row[1 + names.index(became)] += 1

    for clip, experts in wanted.items():
        whole = {o["kind"] for o in outcomes if o["clip_id"] == clip and not o["expert"]}
        fate = "failed" if "failed" in whole else "rejected" if whole else ""
        count("clip", "", -1, fate or ("accepted" if clip in lists else "pending"))
        if not fate and clip in lists:
            count("perturb", "", -1, "rejected" if lists[clip] else "accepted")
        for expert, rounds in experts.items():
            made = {s["round"] for s in samples if (s["clip_id"], s["expert"]) == (clip, expert)}
            kinds = {o["kind"] for o in outcomes if (o["clip_id"], o["expert"]) == (clip, expert)}
            ended = "failed" if "failed" in kinds else "rejected" if "exhausted" in kinds else fate or "pending"
            for number in range(rounds):
                count("write", expert, number, "accepted" if number in made else ended)
            attempts = [
                o for o in outcomes if (o["clip_id"], o["expert"]) == (clip, expert) and o["kind"] != "exhausted"
            ]
            ends = [("", "")] * len(made) + [(o["kind"], TASK_OF.get(o["stage"], "drive")) for o in attempts]
            ends += [("pending", "drive")] if ended == "pending" and len(made) < rounds else []
            for became, where in ends:
                passed = ATTEMPT.index(where) if where else len(ATTEMPT)
                for task in ATTEMPT[:passed]:
                    count(task, expert, -1, "accepted")
                if became:
                    count(where, expert, -1, became)
    return {key: tuple(row) for key, row in sorted(found.items())}  # type: ignore[misc]
