"""A training goes on after any interruption as if there had been none, and writes what it did."""

import csv
import json
import math
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from factory.config.compose import ConfigError
from factory.exits import Stopped
from planners.data.batch import Batch
from planners.models.planner import build_planner
from planners.models.settings import PlannerChoice
from planners.training.callbacks import LOSSES, VALIDATION, Callback
from planners.training.checkpoint import (
    ENDED,
    best_checkpoint,
    checkpoints,
    is_training,
    load_planner,
    load_training,
    newest_checkpoint,
    planner_digest,
    read_record,
)
from planners.training.fit import Precision, StepSettings, fit, total_steps
from planners.training.optim import TrainingSettings
from planners.training.processes import TrainingProcess
from tasks.caches import json_with_checksum
from tests.planners.toy import Toy, ToyBatches, ToySettings, toy_batch

ALONE = TrainingProcess(0, 1, torch.device("cpu"))
TRAINING = TrainingSettings(epochs=3, batch_size=4, learning_rate=0.01, schedule="cosine", optimiser="adamw")


def toy() -> Toy:
    torch.manual_seed(0)
    return Toy(ToySettings(), {})


def train(out: Path, batches: ToyBatches, resume: Path | None = None, **loop: Any) -> Toy:
    planner = toy()
    steps = total_steps(batches, TRAINING, None)
    fit(
        planner,
        batches,
        TRAINING,
        StepSettings(**{"seed": 1, "steps": steps, **loop}),
        ALONE,
        out,
        {},
        resume,
        measured,
    )
    return planner


def measured(planner: Any) -> dict[str, float]:
    return {"weight": float(planner.net[0].weight.detach().sum())}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class Interrupted(ToyBatches):
    """Sends this process a signal while it hands out a batch."""

    def __init__(self, n: int, size: int, after: int) -> None:
        super().__init__(n, size)
        self.after = after

    def epoch(self, epoch: int) -> Iterator[Batch]:
        for batch in super().epoch(epoch):
            self.after -= 1
            if self.after == 0:
                os.kill(os.getpid(), signal.SIGTERM)
            yield batch


@pytest.mark.parametrize("stop_after", [1, 5, 7])  # within an epoch of five batches, at its end, in the next
def test_an_interrupted_training_resumes_to_the_identical_curve_and_weights(tmp_path: Path, stop_after: int) -> None:
    whole = train(tmp_path / "whole", ToyBatches(20, 4), validate_every=5)
    out = tmp_path / "cut"
    with pytest.raises(Stopped, match=f"after step {stop_after} of 15"):
        train(out, Interrupted(20, 4, stop_after), validate_every=5)
    resumed = train(out, ToyBatches(20, 4), newest_checkpoint(out), validate_every=5)
    assert (out / LOSSES).read_text() == (tmp_path / "whole" / LOSSES).read_text()
    assert (out / VALIDATION).read_text() == (tmp_path / "whole" / VALIDATION).read_text()
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    ends = [(newest_checkpoint(at) / "training.pt").read_bytes() for at in (tmp_path / "whole", out)]
    assert ends[0] == ends[1], "to the byte: a copy is told by its checksum"


def test_a_killed_training_repeats_what_came_after_its_last_checkpoint(tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    class Dying(ToyBatches):
        def epoch(self, epoch: int) -> Iterator[Batch]:
            for batch in super().epoch(epoch):
                if self.at == {"epoch": 1, "next": 4}:
                    raise Killed
                yield batch

    whole = tmp_path / "whole"
    train(whole, ToyBatches(20, 4), checkpoint_every=3, log_every=1)
    out = tmp_path / "cut"
    with pytest.raises(Killed):
        train(out, Dying(20, 4), checkpoint_every=3, log_every=1)
    assert [int(row["step"]) for row in rows(out / LOSSES)] == list(range(8))
    assert newest_checkpoint(out).name == "00000006"
    train(out, ToyBatches(20, 4), newest_checkpoint(out), checkpoint_every=3, log_every=1)
    assert (out / LOSSES).read_text() == (whole / LOSSES).read_text()


class Sgd(torch.optim.SGD):
    """A step is the rate times the gradient, so that a wrong gradient shows: Adam's steps are the same for its double.

    Keeps the rates that it stepped with.
    """

    def __init__(self, training: TrainingSettings, planner: torch.nn.Module) -> None:
        super().__init__(planner.parameters(), lr=training.learning_rate)
        self.rates: list[float] = []

    def step(self, *arguments: Any) -> None:  # type: ignore[override]
        self.rates += [group["lr"] for group in self.param_groups]
        super().step(*arguments)


@pytest.fixture
def stepped_by(monkeypatch: pytest.MonkeyPatch) -> list[Sgd]:
    """The optimisers of the trainings of a test, all of them Sgd."""
    made: list[Sgd] = []

    def build(training: TrainingSettings, planner: torch.nn.Module) -> Sgd:
        made.append(Sgd(training, planner))
        return made[-1]

    monkeypatch.setattr("planners.training.fit.build_optimiser", build)
    return made


def without_chance() -> Toy:
    torch.manual_seed(0)
    return Toy(ToySettings(dropout=0.0), {})


def gradient_of_the_first_batch(planner: Toy) -> tuple[torch.Tensor, ...]:
    (batch,) = ToyBatches(4, 4).epoch(0)
    return torch.autograd.grad(torch.stack(list(planner.losses(batch).values())).sum(), list(planner.parameters()))


@pytest.mark.parametrize(("parts", "precision"), [(1, "fp32"), (2, "fp32"), (4, "fp32"), (1, "fp16"), (4, "fp16")])
def test_a_step_goes_against_the_gradient_of_the_whole_batch_whatever_parts_it_is_computed_in(
    tmp_path: Path, stepped_by: list[Sgd], parts: int, precision: Precision
) -> None:
    planner, training = without_chance(), TrainingSettings(epochs=1, batch_size=4, learning_rate=0.1)
    expected = [p.detach() - 0.1 * g for p, g in zip(planner.parameters(), gradient_of_the_first_batch(planner))]
    fit(planner, ToyBatches(4, 4), training, StepSettings(1, 1, parts, precision), ALONE, tmp_path, {})
    near = {"rtol": 1e-5, "atol": 1e-7} if precision == "fp32" else {"rtol": 0.0, "atol": 5e-4}
    for found, wanted in zip(planner.parameters(), expected):
        torch.testing.assert_close(found.detach(), wanted, **near)


@pytest.mark.parametrize("share", [0.25, 4.0])
@pytest.mark.parametrize("precision", ["fp32", "fp16"])
def test_a_gradient_above_the_clip_is_shortened_to_it_and_one_below_is_left_alone(
    tmp_path: Path, stepped_by: list[Sgd], precision: Precision, share: float
) -> None:
    """In fp16 it is clipped without the scale of the loss."""
    planner = without_chance()
    gradient = gradient_of_the_first_batch(planner)
    norm = float(torch.cat([g.flatten() for g in gradient]).norm())
    training = TrainingSettings(epochs=1, batch_size=4, learning_rate=0.1, gradient_clip=share * norm)
    before = [p.detach().clone() for p in planner.parameters()]
    fit(planner, ToyBatches(4, 4), training, StepSettings(1, 1, precision=precision), ALONE, tmp_path, {})
    near = {"rtol": 1e-4, "atol": 1e-6} if precision == "fp32" else {"rtol": 0.0, "atol": 5e-4 * norm}
    for was, found, full in zip(before, planner.parameters(), gradient):
        torch.testing.assert_close(was - found.detach(), 0.1 * min(share, 1.0) * full, **near)


def test_the_rate_of_a_step_is_the_schedules_and_the_one_that_is_logged(tmp_path: Path, stepped_by: list[Sgd]) -> None:
    training = TrainingSettings(epochs=3, batch_size=4, learning_rate=0.01, schedule="cosine", warmup_steps=3)
    fit(without_chance(), ToyBatches(20, 4), training, StepSettings(1, 15, log_every=4), ALONE, tmp_path, {})
    (optimiser,) = stepped_by
    logged = [float(row["learning_rate"]) for row in rows(tmp_path / LOSSES)]
    assert optimiser.rates == pytest.approx(logged, rel=1e-5)
    assert optimiser.rates[:4] == pytest.approx([0.01 / 3, 0.02 / 3, 0.01, 0.01])
    assert optimiser.rates[-1] == pytest.approx(0.005 * (1.0 + math.cos(math.pi * 11 / 12)))


def test_an_epoch_of_a_schedule_is_the_loaders(tmp_path: Path, stepped_by: list[Sgd]) -> None:
    training = TrainingSettings(epochs=3, batch_size=4, learning_rate=0.01, warmup_epochs=2.0, by_epoch=True)
    fit(without_chance(), ToyBatches(20, 4), training, StepSettings(1, 15, log_every=4), ALONE, tmp_path, {})
    (optimiser,) = stepped_by
    assert optimiser.rates == pytest.approx([0.005] * 5 + [0.01] * 10)
    assert [float(row["learning_rate"]) for row in rows(tmp_path / LOSSES)] == optimiser.rates


class Dice(Toy):
    """Notes what a step draws."""

    name = "tests.planners.training.test_fit:Dice"

    def losses(self, batch: Batch) -> dict[str, torch.Tensor]:
        self.drawn = [*getattr(self, "drawn", []), float(torch.rand(()))]
        return super().losses(batch)


def test_every_step_of_every_rank_draws_its_own_and_the_same_again(tmp_path: Path) -> None:
    def drawn(rank: int, seed: int = 1) -> list[float]:
        planner = Dice(ToySettings(), {})  # what was drawn to build it does not matter
        process = TrainingProcess(rank, 1, torch.device("cpu"))
        fit(planner, ToyBatches(20, 4), TRAINING, StepSettings(seed, 5), process, tmp_path / f"{rank}-{seed}", {})
        return list(planner.drawn)

    first, second = drawn(0), drawn(1)
    assert len({*first, *second, *drawn(0, seed=2)}) == 15
    assert drawn(0) == first and drawn(1) == second


def test_a_loss_that_is_no_number_stops_the_training_with_its_step(tmp_path: Path) -> None:
    class Poisoned(ToyBatches):
        def epoch(self, epoch: int) -> Iterator[Batch]:
            for i, batch in enumerate(super().epoch(epoch)):
                if i == 2:
                    batch.plan_2hz[0] = torch.nan
                yield batch

    with pytest.raises(FloatingPointError, match=r"loss of step 2 .*imitation nan"):
        train(tmp_path, Poisoned(20, 4), validate_every=3)
    assert not rows(tmp_path / VALIDATION), "nothing is told of such a planner"


def test_a_checkpoint_is_the_planner_and_only_the_newest_stay(tmp_path: Path) -> None:
    trained = train(tmp_path, ToyBatches(20, 4), checkpoint_every=4)
    assert [path.name for path in checkpoints(tmp_path)] == ["00000012", "00000015"]
    loaded = load_planner(tmp_path)
    batch = toy_batch(torch.arange(3).numpy())
    assert torch.equal(loaded.plan(batch), trained.eval().plan(batch))
    assert len(planner_digest(tmp_path)) == 16
    assert planner_digest(tmp_path) != planner_digest(checkpoints(tmp_path)[0])


def test_every_nth_checkpoint_stays_beside_the_newest(tmp_path: Path) -> None:
    train(tmp_path, ToyBatches(20, 4), checkpoint_every=4, keep_every=5)
    assert [int(path.name) for path in checkpoints(tmp_path)] == [5, 10, 12, 15]
    train(tmp_path / "both", ToyBatches(20, 4), checkpoint_every=4, keep_every=8)
    assert [int(path.name) for path in checkpoints(tmp_path / "both")] == [8, 12, 15]


VALUES = {2: 3.0, 4: 1.0, 6: 2.0, 8: 1.0, 10: 5.0, 12: 4.0, 14: 1.5, 15: 9.0}


@pytest.mark.parametrize("stop_after", [None, 3, 9])
def test_the_best_checkpoint_stays_whatever_interrupts(tmp_path: Path, stop_after: int | None) -> None:
    """Validated every second step: the first with the least value is that of step 4, also where step 8 equals it."""
    at = iter(VALUES.values())
    keep = {"validate_every": 2, "checkpoint_every": 5, "keep_best": "off_m"}

    def go_on(batches: ToyBatches, resume: Path | None = None) -> None:
        loop = StepSettings(seed=1, steps=15, **keep)  # type: ignore[arg-type]
        fit(toy(), batches, TRAINING, loop, ALONE, tmp_path, {}, resume, lambda planner: {"off_m": next(at)})

    if stop_after is None:
        go_on(ToyBatches(20, 4))
    else:
        with pytest.raises(Stopped):
            go_on(Interrupted(20, 4, stop_after))
        go_on(ToyBatches(20, 4), newest_checkpoint(tmp_path))
    assert [int(path.name) for path in checkpoints(tmp_path)] == [4, 10, 15]
    assert best_checkpoint(tmp_path).name == newest_checkpoint(tmp_path / "best").name == "00000004"
    assert read_record(tmp_path / "best")["validation"] == {"off_m": 1.0}
    assert is_training(tmp_path / "best") and not is_training(tmp_path / "worst")


def test_a_training_killed_behind_its_best_checkpoint_goes_on_from_it_without_a_gap(tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def once(planner: Any) -> dict[str, float]:
        if checkpoints(tmp_path):
            raise Killed
        return measured(planner)

    loop = StepSettings(seed=1, steps=15, validate_every=2, log_every=20, keep_best="weight")
    with pytest.raises(Killed):
        fit(toy(), ToyBatches(20, 4), TRAINING, loop, ALONE, tmp_path, {}, None, once)
    assert newest_checkpoint(tmp_path).name == "00000002"
    train(tmp_path, ToyBatches(20, 4), newest_checkpoint(tmp_path))
    assert [int(row["step"]) for row in rows(tmp_path / LOSSES)] == list(range(15))


def in_turn(*values: float) -> Any:
    """A validation that finds these, one after the other."""
    at = iter(values)
    return lambda planner: {"epdms": next(at), "ade_m": 0.0}


WORTH = (0.5, 0.4, 0.7, 0.6, math.nan, 0.7, 0.9)  # after steps 2, 4, ...: three without a better one up to step 12


@pytest.mark.parametrize("stop_after", [None, 3, 9])
def test_a_training_that_gets_no_better_ends_at_the_same_step_whatever_interrupts(
    tmp_path: Path, stop_after: int | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of EPDMS more is better, an equal value is none, nor is NaN."""
    validate = in_turn(*WORTH)

    def go_on(batches: ToyBatches, resume: Path | None = None) -> None:
        loop = StepSettings(seed=1, steps=15, validate_every=2, keep_best="epdms", patience=3)
        fit(toy(), batches, TRAINING, loop, ALONE, tmp_path, {}, resume, validate)

    if stop_after is None:
        go_on(ToyBatches(20, 4))
    else:
        with pytest.raises(Stopped):
            go_on(Interrupted(20, 4, stop_after))
        go_on(ToyBatches(20, 4), newest_checkpoint(tmp_path))
    assert [int(row["step"]) for row in rows(tmp_path / VALIDATION)] == [2, 4, 6, 8, 10, 12]
    assert best_checkpoint(tmp_path).name == "00000006" and newest_checkpoint(tmp_path).name == "00000012"
    why = read_record(tmp_path)[ENDED]
    assert why == "3 validations without a better epdms; best so far: epdms 0.7000 after step 6"
    assert len(rows(tmp_path / LOSSES)) == 12


class Watcher(Callback):
    """Notes what it is told; keeps the mean of the first weights in its state; may end the training."""

    def __init__(self, ends_after: int = 0) -> None:
        self.ends_after, self.told, self.mean = ends_after, list[str](), torch.zeros(8)

    def on_step_end(self, step: int, planner: Any, losses: Any) -> str | None:
        self.told.append(f"step {step} of {'+'.join(losses)}")
        self.mean = 0.9 * self.mean + 0.1 * planner.net[0].weight.detach()[:, 0]
        return "enough" if step == self.ends_after else None

    def on_losses(self, step: int, row: Any) -> None:
        self.told.append(f"losses {step}")

    def on_validation_end(self, step: int, planner: Any, measured: Any) -> None:
        self.told.append(f"validation {step}")

    def on_end(self) -> None:
        self.told.append("end")

    def state(self) -> dict[str, Any]:
        return {"mean": self.mean}

    def resume(self, state: Any) -> None:
        self.mean = state["mean"]


def test_a_callback_is_told_of_everything_and_may_end_the_training(tmp_path: Path) -> None:
    watcher = Watcher(ends_after=3)
    loop = StepSettings(seed=1, steps=15, validate_every=2, log_every=2)
    fit(toy(), ToyBatches(20, 4), TRAINING, loop, ALONE, tmp_path, {}, None, measured, {"mine": watcher})
    step = "of imitation+size"
    told = [f"step 1 {step}", f"step 2 {step}", "losses 0", "losses 1", "validation 2"]
    assert watcher.told == [*told, f"step 3 {step}", "losses 2", "validation 3", "end"]
    assert newest_checkpoint(tmp_path).name == "00000003" and read_record(tmp_path)[ENDED] == "enough"


def test_what_a_callback_keeps_is_the_same_after_an_interruption(tmp_path: Path) -> None:
    means = []
    for name, batches in (("whole", ToyBatches(20, 4)), ("cut", Interrupted(20, 4, 7))):
        watcher, out = Watcher(), tmp_path / name
        fitted = (TRAINING, StepSettings(seed=1, steps=15), ALONE, out, {})
        try:
            fit(toy(), batches, *fitted, callbacks={"mine": watcher})
        except Stopped:
            watcher = Watcher()
            fit(toy(), ToyBatches(20, 4), *fitted, newest_checkpoint(out), callbacks={"mine": watcher})
        means.append(watcher.mean)
    assert torch.equal(*means)


def test_a_training_that_goes_on_may_measure_more(tmp_path: Path) -> None:
    loop = StepSettings(seed=1, steps=15, validate_every=5)
    with pytest.raises(Stopped):
        fit(toy(), Interrupted(20, 4, 7), TRAINING, loop, ALONE, tmp_path, {}, None, measured)
    more = in_turn(0.5, 0.25)

    def both(planner: Any) -> dict[str, float]:
        return {**more(planner), **measured(planner)}

    fit(toy(), ToyBatches(20, 4), TRAINING, loop, ALONE, tmp_path, {}, newest_checkpoint(tmp_path), both)
    found = rows(tmp_path / VALIDATION)
    assert [(row["step"], row["epdms"]) for row in found] == [("5", ""), ("10", "0.5"), ("15", "0.25")]
    assert all(row["weight"] for row in found)


def test_a_checkpoint_of_another_planner_is_refused_by_name(tmp_path: Path) -> None:
    train(tmp_path, ToyBatches(20, 4))
    record = newest_checkpoint(tmp_path) / "record.json"
    changed = json.loads(record.read_text())
    changed["planner"]["settings"]["hidden"] = 9
    del changed["sha256"]
    record.write_text(json_with_checksum(changed))
    with pytest.raises(ConfigError, match=r"not a checkpoint of this .*net.0.weight is \(8, 8\), not \(9, 8\)"):
        load_planner(tmp_path)


def test_folders_without_a_checkpoint_and_planners_nobody_knows_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no checkpoint here"):
        load_planner(tmp_path)
    with pytest.raises(ConfigError, match=r"planner\.name=nope: none of constant_velocity"):
        build_planner(PlannerChoice("nope"), {})
    with pytest.raises(ConfigError, match=r"is not a planners\.models\.planner\.Planner"):
        build_planner(PlannerChoice("json:JSONDecoder"), {})
    with pytest.raises(ConfigError, match=r"planner\.settings\.hiden"):
        build_planner(PlannerChoice("tests.planners.toy:Toy", {"hiden": 3}), {})


def test_a_flipped_bit_in_any_file_of_a_checkpoint_is_found_and_named(tmp_path: Path) -> None:
    train(tmp_path, ToyBatches(20, 4))
    folder = newest_checkpoint(tmp_path)
    for path in sorted(folder.iterdir()):
        whole = path.read_bytes()
        for at in range(0, len(whole), max(1, len(whole) // 50)):
            path.write_bytes(whole[:at] + bytes([whole[at] ^ 16]) + whole[at + 1 :])
            with pytest.raises(ConfigError, match=re.escape(path.name)):
                load_planner(tmp_path)
                load_training(folder)
        path.write_bytes(whole)
    load_planner(tmp_path)
