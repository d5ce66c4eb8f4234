"""A laboratory's NAVSIM beside ours: its solver, our scores of its logs beside published rows, on one page."""

import csv
import gzip
import json
import subprocess
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from factory.config.compose import ConfigError
from factory.files import atomic_file
from factory.views.pictures import encode_image, sample_bev
from planners.evaluation import solver_probe
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.navsim import LONG, SCORE, score_of_columns
from planners.evaluation.score_rows import FrameRow
from tasks.reward.aggregate import COLUMNS
from tasks.subscores import OF_ONE_PLAN
from tasks.world.arrays import Array

COMPARED = (*OF_ONE_PLAN, "score")  # without extended comfort, which is of two plans
DRAWN, PICTURE_PX, PROBE_S = 10, 420, 120
SAME = 1e-6  # of two scores; public tables of another machine differ in the last digits


def probe_solver(python: str) -> dict[str, Any]:
    """What solver_probe says in another environment. Raises ConfigError where it cannot run there."""
    try:
        words = [python, "-I", solver_probe.__file__]
        done = subprocess.run(words, capture_output=True, text=True, timeout=PROBE_S, check=False)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"navsim_python={python}: {error}") from error
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise ConfigError(f"navsim_python={python}: {said}: give the python of an environment with numpy")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def read_published(path: Path) -> dict[str, Array]:
    """Token -> its COMPARED columns, of a .csv or .csv.gz that NAVSIM's one-stage script wrote. Raises ConfigError."""
    names = [LONG.get(name, name) for name in COMPARED]
    opened = gzip.open if path.suffix == ".gz" else open
    try:
        with opened(path, "rt", newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        return {row["token"]: np.array([float(row[name] or "nan") for name in names]) for row in rows}
    except KeyError as error:
        raise ConfigError(f"check={path}: no column {error}: give the rows of NAVSIM's run_pdm_score script") from error
    except (OSError, ValueError, EOFError) as error:
        raise ConfigError(f"check={path}: {error}") from error


def own_columns(row: FrameRow) -> Array:
    """The COMPARED columns of a row of ours, unfiltered, its score as of one plan."""
    values = row.scores.unfiltered.copy()
    values[COLUMNS.index("ec")] = np.nan
    values[SCORE] = score_of_columns(values[None])[0]
    return values[[COLUMNS.index(name) for name in COMPARED]]


@dataclass(frozen=True)
class RowsBeside:
    """Scores of the tokens that both have."""

    tokens: tuple[str, ...]
    ours: Array  # (N, len(COMPARED))
    published: Array  # the same

    @property
    def off(self) -> Array:
        """Absolute differences; a number that one side lacks is infinitely off."""
        both_lack = np.isnan(self.ours) & np.isnan(self.published)
        return np.where(both_lack, 0.0, np.nan_to_num(np.abs(self.ours - self.published), nan=np.inf))


def compare_rows(ours: Mapping[str, Array], published: Mapping[str, Array]) -> RowsBeside:
    """Raises ConfigError where no token stands on both sides."""
    tokens = tuple(token for token in ours if token in published)
    if not tokens:
        raise ConfigError(f"check=: none of the {len(ours)} scored tokens is among the {len(published)} published ones")
    return RowsBeside(tokens, *(np.stack([side[token] for token in tokens]) for side in (ours, published)))


def write_check(
    path: Path, benchmark: BenchmarkFolder, rows: Sequence[FrameRow], published: Path, python: str
) -> list[str]:
    """Write the page; what it says in lines. Raises ConfigError, and DiskFull."""
    if not (benchmark.one_stage and benchmark.tokens):
        raise ConfigError(f"check={published}: is of benchmark=navtest, and {benchmark.path} is of other frames")
    keys = {benchmark.tokens[row.key]: row.key for row in rows}
    ours = {benchmark.tokens[row.key]: own_columns(row) for row in rows}
    found, solver = compare_rows(ours, read_published(published)), probe_solver(python)
    said = [solver_line(solver), *_difference_lines(found)]
    worst = np.argsort(-found.off.max(axis=1), kind="stable")[:DRAWN]
    figures = "".join(_figure(found, int(i), sample_bev(benchmark.sample(keys[found.tokens[i]]))) for i in worst)
    title = f"NAVSIM checked: {published.name}"
    page = (
        f'<!doctype html><meta charset="utf-8"><title>{escape(title)}</title><h1>{escape(title)}</h1>'
        f"<pre>{escape(chr(10).join(said))}</pre><p>The {len(worst)} that differ most:</p>{figures}\n"
    ).encode()
    with atomic_file(path, len(page)) as draft:
        draft.write_bytes(page)
    return [*said, f"send back {path}"]


def solver_line(solver: Mapping[str, Any]) -> str:
    """What the probe found, in a line."""
    where = f"numpy {solver['numpy']} of python {solver['python']} on {solver['machine']}"
    if solver["wrong"]:
        speeds = f"such as {solver['worst_mps']:.6g} m/s for {solver['speed_mps']:.6g}"
        told = f"NAVSIM's solver IS AFFECTED: {solver['wrong']} of {solver['plans']} speeds are wrong, {speeds}"
        return f"{where}: {told}; OPENBLAS_CORETYPE=SkylakeX, or numpy 1.26, makes it sound"
    return f"{where}: NAVSIM's solver is sound in {solver['plans']} plans"


def _difference_lines(found: RowsBeside) -> list[str]:
    lines = [f"{len(found.tokens)} tokens", f"{'':32}{'ours':>9}{'published':>11}{'differ':>8}{'most':>9}"]
    for i, name in enumerate(COMPARED):
        ours, published, off = found.ours[:, i], found.published[:, i], found.off[:, i]
        means = f"{np.nanmean(ours):9.4f}{np.nanmean(published):11.4f}"
        lines.append(f"{LONG.get(name, name):32}{means}{(off > SAME).sum():8}{off.max():9.4f}")
    return lines


def _figure(found: RowsBeside, i: int, picture: Any) -> str:
    scores = f"{found.ours[i, -1]:.4f}, published {found.published[i, -1]:.4f}"
    odd = [LONG[name] for name, off in zip(OF_ONE_PLAN, found.off[i]) if off > SAME]
    caption = escape(f"{found.tokens[i]}: {scores}{'; ' if odd else ''}{', '.join(odd)}")
    data = b64encode(encode_image(picture)).decode()
    shown = f'<img width={PICTURE_PX} src="data:image/jpeg;base64,{data}">'
    return f"<figure>{shown}<figcaption>{caption}</figcaption></figure>"
