"""What a training's validation by EPDMS costs: `python -m tests.bench.bench_validation`.

CPU time of all threads, on clips of the built-in town: to write the bank, once; to plan for the samples, and to score
the plans beside that, the least of some passes each; a step of the same planner, for the share of a training.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from pathlib import Path

import torch

from factory.run import main as run_factory
from planners.data.index import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from planners.training.optim import build_optimiser
from planners.training.validation import make_validation, open_bank
from tests.bench.bench_planner_steps import made

PLANNERS = ("ego_mlp", "ego_mlp_bev_small", "ego_mlp_bev")
TOWN = "clips=synthetic_towns clips.settings.cameras=[] clips.settings.lidar_beams=0 render=none"
RUN = f"{TOWN} reward.labels=none experts=[human] executor=local"
BATCH, EVERY, PASSES = 64, 200, 5


def main(planners: Sequence[str] = PLANNERS, towns: int = 12, passes: int = PASSES) -> None:
    """Prints one line, then a table."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        table, bank = f"{folder}/run", Path(folder, "bank")
        with redirect_stdout(sys.stderr):
            assert run_factory([*RUN.split(), f"clips.n_towns={towns}", f"out={table}"]) == 0
        dataset = open_data(DataSettings(real=table))
        open_bank(Path(folder, "first"), dataset)  # compiles
        write_s = cpu_s(lambda: open_bank(bank, dataset))
        n = len(dataset)
        print(f"{n} samples; the bank is written in {1e3 * write_s / n:.1f} ms a sample, once\n")
        print(f"| planner | planning, ms each | scoring, ms each | step of {BATCH}, s | scored every {EVERY} steps |")
        print("|---" * 5 + "|")
        for name in planners:
            planner, entry = made(name, 64)
            assert entry.training is not None
            data, device = DataSettings(val=table), torch.device("cpu")
            alone, scored = (make_validation(data, planner, device, 1, one) for one in (None, bank))
            plan_s, both_s = (least_s(lambda: check(planner), passes) for check in (alone, scored))  # noqa: B023
            batch = next(iter(Loader(dataset, planner.needs, MixSettings(), min(BATCH, n), workers=1).epoch(0)))
            optimiser = build_optimiser(entry.training, planner)

            def step() -> None:
                torch.stack([*planner(batch).values()]).sum().backward()  # noqa: B023
                optimiser.step()  # noqa: B023

            step_s, score_s = least_s(step, passes), both_s - plan_s
            shown = f"{1e3 * plan_s / n:.1f} | {1e3 * score_s / n:.2f} | {step_s:.3f}"
            print(f"| `{name}` | {shown} | {100 * score_s / (EVERY * step_s + both_s):.1f} % |", flush=True)


def cpu_s(work: Callable[[], object]) -> float:
    """Of one call."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def least_s(work: Callable[[], object], passes: int) -> float:
    """Of some."""
    return min(cpu_s(work) for _ in range(passes))


if __name__ == "__main__":
    main()
