"""What a training writes of itself: CSV files to compare, TensorBoard to watch."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LOSSES, VALIDATION = "losses.csv", "validation.csv"


class Curves:
    """Writes the curves of one training; rows of steps that will be computed again are dropped first."""

    def __init__(self, out: Path, first_step: int) -> None:
        """first_step: the step the training begins with; losses of it and later ones are dropped."""
        from torch.utils.tensorboard import SummaryWriter

        out.mkdir(parents=True, exist_ok=True)
        self._files = {
            LOSSES: _CsvRows(out / LOSSES, first_step),
            VALIDATION: _CsvRows(out / VALIDATION, first_step + 1),
        }
        self._board = SummaryWriter(str(out / "tensorboard"), purge_step=first_step)

    def loss(self, step: int, rate: float, terms: Mapping[str, float], more: Mapping[str, float] = {}) -> None:
        """The losses that step `step` began with, and what else is to be known of it."""
        row = {"total": sum(terms.values()), **terms, "learning_rate": rate, **more}
        self._write(LOSSES, "loss", step, row)

    def validation(self, step: int, measured: Mapping[str, float]) -> None:
        """What the planner was worth after `step` steps."""
        self._write(VALIDATION, "validation", step, measured)

    def close(self) -> None:
        """Flush everything."""
        for rows in self._files.values():
            rows.file.close()
        self._board.close()

    def _write(self, name: str, prefix: str, step: int, row: Mapping[str, float]) -> None:
        self._files[name].write({"step": step, **row})
        for key, value in row.items():
            self._board.add_scalar(f"{prefix}/{key}", value, step)


class _CsvRows:
    """A CSV file whose first column is the step; numbers are written so that they read back the same."""

    def __init__(self, path: Path, first_step: int) -> None:
        kept = []
        if path.exists():
            with path.open(newline="", encoding="utf-8") as old:
                kept = [row for row in csv.DictReader(old) if int(row["step"]) < first_step]
        self.file = path.open("w", newline="", encoding="utf-8")
        self._writer: csv.DictWriter[str] | None = None
        for row in kept:
            self.write(row)

    def write(self, row: Mapping[str, Any]) -> None:
        if self._writer is None:
            self._writer = csv.DictWriter(self.file, list(row))
            self._writer.writeheader()
        self._writer.writerow({key: repr(value) if isinstance(value, float) else value for key, value in row.items()})
        self.file.flush()
