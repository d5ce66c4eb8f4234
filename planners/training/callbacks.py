"""Who is told of a training as it goes, and may end it; the trainer's own curves and its best checkpoint among them."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from planners.models.planner import Planner


@runtime_checkable
class Callback(Protocol):
    """A user's own is named by `callbacks.<name>._target_`, as a subclass with those of these methods that it needs.

    A text that a hook returns says why the training is to end, which it does behind a checkpoint.
    """

    def on_step_end(self, step: int, planner: Planner, losses: Mapping[str, Tensor]) -> str | None:
        """In every process, when `step` optimiser steps are done; losses: of the last, whose reading waits for it.

        Several processes agree on an end at multiples of log_every.
        """
        return None

    def on_losses(self, step: int, row: Mapping[str, float]) -> None:
        """In the first process: the losses that step `step` began with and its rate, every log_every steps of each."""
        return

    def on_validation_end(self, step: int, planner: Planner, measured: Mapping[str, float]) -> str | None:
        """In the first process: what the planner is worth after `step` steps."""
        return None

    def on_end(self) -> None:
        """In every process, once the training stops, for whatever reason but an error."""
        return

    def state(self) -> dict[str, Any]:
        """What checkpoints of the first process keep of it: tensors and plain values."""
        return {}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state, in every process."""
        return


HIGHER = frozenset({"epdms"})  # measures of which more is better; of all others less


class BestSoFar(Callback):
    """Which validation was the best by one measure, the first of equal ones; ends a training that gets no better."""

    def __init__(self, measure: str | None, patience: int | None = None) -> None:
        """measure: None: the first that is measured. patience: validations without a better one after which the
        training ends; None: it does not."""
        self.measure, self.patience = measure, patience
        self.step: int | None = None  # of the best; None: there is none yet
        self.value, self.waited = math.nan, 0

    def on_validation_end(self, step: int, planner: Planner, measured: Mapping[str, float]) -> str | None:
        self.measure = self.measure or next(iter(measured))
        value, sign = measured[self.measure], 1.0 if self.measure in HIGHER else -1.0
        if not math.isnan(value) and (self.step is None or sign * value > sign * self.value):
            self.step, self.value, self.waited = step, value, 0
            return None
        self.waited += 1
        if self.patience is None or self.waited < self.patience:
            return None
        return f"{self.waited} validations without a better {self.measure}; {self}"

    def __str__(self) -> str:
        return f"best so far: {self.measure} {self.value:.4f} after step {self.step}"

    def state(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("measure", "step", "value", "waited")}

    def resume(self, state: Mapping[str, Any]) -> None:
        if self.measure in (None, state["measure"]):
            self.__dict__.update(state)


# What a training writes of itself: CSV files to compare, TensorBoard to watch.

LOSSES, VALIDATION = "losses.csv", "validation.csv"


class Curves(Callback):
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

    def on_losses(self, step: int, row: Mapping[str, float]) -> None:
        self._write(LOSSES, "loss", step, row)

    def on_validation_end(self, step: int, planner: Planner, measured: Mapping[str, float]) -> None:
        self._write(VALIDATION, "validation", step, measured)

    def on_end(self) -> None:
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
        self._path = path
        self._begin([row for row in self._rows() if int(row["step"]) < first_step])

    def _rows(self) -> list[dict[str, Any]]:
        if not self._path.exists():
            return []
        with self._path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def _begin(self, rows: list[dict[str, Any]]) -> None:
        self.file = self._path.open("w", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self.file, list(dict.fromkeys(key for row in rows for key in row)))
        if rows:
            self._writer.writeheader()
            self._writer.writerows(rows)
        self.file.flush()

    def write(self, row: Mapping[str, Any]) -> None:
        text = {key: repr(value) if isinstance(value, float) else value for key, value in row.items()}
        if not text.keys() <= {*self._writer.fieldnames}:  # a training that goes on may measure more
            self.file.close()
            self._begin([*self._rows(), text])
        else:
            self._writer.writerow(text)
            self.file.flush()
