"""The slow, obvious twin of the score formula, the human-penalty filter and both aggregations: one row, one column, one
number at a time (docs/reward.md 2k, 2l, 3). A row is a dict of floats; extended comfort is NaN without an earlier
frame.
"""

import math
from collections.abc import Sequence

Row = dict[str, float]
Columns = dict[str, float]

SUB_SCORES = ("nc", "dac", "tlc", "ddc", "ep", "ttc", "lk", "hc")
FAR_WEIGHT = 1e-8  # a sum of weights up to this counts as none


def final_score(row: Row, ec: float) -> float:
    multiplier = row["nc"] * row["dac"] * row["tlc"] * row["ddc"]
    weighted = 5.0 * row["ep"] + 5.0 * row["ttc"] + 2.0 * row["lk"] + 2.0 * row["hc"]
    if math.isnan(ec):
        return multiplier * weighted / 14.0
    return multiplier * (weighted + 2.0 * ec) / 16.0


def relative_progress(metres: Sequence[float], multipliers: Sequence[float], normalise: str) -> list[float]:
    shares = []
    for k in range(len(metres)):
        rivals = range(len(metres)) if normalise == "batch" else (0, k)
        best = max(metres[i] * multipliers[i] for i in rivals)
        shares.append(min(max(metres[k] / best, 0.0), 1.0) if best > 5.0 else 1.0)
    return shares


def human_filtered(row: Row, human: Row) -> Row:
    filtered = {}
    for name in SUB_SCORES:
        filtered[name] = 1.0 if human[name] == 0.0 else row[name]
    return filtered


def frame(row: Row, human: Row | None, ec: float) -> tuple[Columns, Columns]:
    """A frame's columns, unfiltered and filtered."""
    made = []
    for scored in (row, row if human is None else human_filtered(row, human)):
        made.append({name: scored[name] for name in SUB_SCORES} | {"ec": ec, "score": final_score(scored, ec)})
    return made[0], made[1]


def means(frames: Sequence[Columns]) -> Columns:
    """Column by column, over the frames that have it; NaN where none does."""
    found = {}
    for name in frames[0]:
        known = [columns[name] for columns in frames if not math.isnan(columns[name])]
        found[name] = sum(known) / len(known) if known else math.nan
    return found


def plain_means(frames: Sequence[Columns]) -> Columns:
    """Column by column, over all frames: NaN where one has none."""
    return {name: sum(columns[name] for columns in frames) / len(frames) for name in frames[0]}


def follow_up_weights(endpoint: tuple[float, float], starts: Sequence[tuple[float, float]]) -> list[float]:
    weights = []
    for x, y in starts:
        distance_sq = (x - endpoint[0]) ** 2 + (y - endpoint[1]) ** 2
        weights.append(math.exp(-distance_sq / (2.0 * 0.1)))
    total = sum(weights)
    if math.isnan(total) or total <= FAR_WEIGHT:
        return [1.0 / len(starts) for _ in starts]
    return [weight / total for weight in weights]


def weighted(weights: Sequence[float], stage_two: Sequence[Columns]) -> Columns:
    """A group's stage two; a follow-up frame without a column leaves the group without it."""
    return {name: sum(weight * after[name] for weight, after in zip(weights, stage_two)) for name in stage_two[0]}


def group(stage_one: Columns, weights: Sequence[float], stage_two: Sequence[Columns]) -> Columns:
    """Stage one times the weighted stage two."""
    after = weighted(weights, stage_two)
    return {name: value * after[name] for name, value in stage_one.items()}
