"""Trained planners in AlpaSim's columns: twenty towns and twenty windows of a real drive, in one process and in three.

    python -m experiments.driving nuscenes_front=<folder> out=runs/driving

Makes samples of 48 towns, trains `ltf_small` on the real ones and on these and simulated ones, fits the scenes that are
driven in, and drives: all in one process, by both controllers, then renderer, runtime and driver apart, whose rows must
be the same to the bit. Prints what README.md has. What is done is not done again.
"""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deltalake import DeltaTable

ALONE = os.environ | {"OMP_NUM_THREADS": "1"}  # a plan's rounding depends on how many threads make it
STEPS, SEEDS = 3000, 1
PICTURES = "render.frames=now render.width=256 render.height=144 vocabulary.k=16384"
BLIND = "clips=synthetic_towns clips.settings.cameras=[] clips.settings.lidar_beams=0"
SAMPLES = (
    f"{BLIND} clips.split=train clips.first_seed=101 clips.n_towns=48 clips.logs_per_town=3 render=painter {PICTURES} "
    "render.cameras=[ring_front_center] reward.labels=none experts=[human,pdm_closed] rounds=2"
)
# One drive of each clip is asked for, so that its scene is built; whether it is a good label does not matter.
SCENES = (
    f"{PICTURES} experts=[logged] rounds=1 reward.labels=none reward.full=[] reward.progress_above=-1 "
    "reward.off_route=false reward.after=false reward.near_log=false render.psnr_min=0 render.gate.enabled=false"
)
TOWNS = (
    "clips=synthetic_towns clips.split=test clips.first_seed=241 clips.n_towns=20 clips.logs_per_town=1 "
    "clips.first_window=2 clips.settings.cameras=[ring_front_center]"
)
FITS = {"towns": "render=town render.scene=discs", "front": "render.fit.iterations=800"}
FITS["front"] += " render.fit.start_gaussians=60000 render.fit.most_gaussians=70000"
TRAINING = f"planner=ltf_small planner.settings.status=speed planner.training.batch_size=16 steps={STEPS} workers=1"
GO_STRAIGHT = {"go_straight": "planners.models.baselines:GoStraight"}
ASKED = {"drive_id", "planner", "planner_digest"}  # columns of who was asked


def clips_of(front: Path) -> dict[str, str]:
    """What is driven: towns, and every 0.4 s a window of the one real drive that has photos, map and boxes."""
    (log,) = front.glob("sd_*.pkl")
    real = f"clips=scenarionet clips.root={log} clips.cameras={front} clips.split=test clips.stride_s=0.4 limit=20"
    return {"towns": TOWNS, "front": real}


def run(module: str, *words: str) -> float:
    """A command of ours; its CPU seconds, with its children's. Raises CalledProcessError."""
    print("$", "python -m", module, *words, flush=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", *module.split(), *words], env=ALONE, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@dataclass(frozen=True)
class Server:
    """A command that serves."""

    pid: int
    address: str

    @property
    def cpu_s(self) -> float:
        """So far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def served(*words: str) -> Iterator[Server]:
    """A command that serves at a port of its own, while it does."""
    command = [sys.executable, "-m", *words, "port=0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=ALONE) as process:
        assert process.stdout is not None
        try:
            told = next(line for line in process.stdout if line.startswith("answers at "))
            yield Server(process.pid, told.split()[-1])
        finally:
            process.send_signal(signal.SIGTERM)


def rows(out: Path, planner: str | None = None) -> dict[str, dict[str, Any]]:
    """Of a table of drives from the log by clip; of one planner where there are several."""
    found = DeltaTable(str(out / "drives")).to_pyarrow_table().to_pylist()
    return {row["clip_id"]: row for row in found if planner in (None, row["planner"])}


def same_to_the_bit(one: Mapping[str, dict[str, Any]], three: Mapping[str, dict[str, Any]]) -> int:
    """How many drives are the same in one process and in three, in every column. Raises ValueError for others."""
    if one.keys() != three.keys():
        raise ValueError(f"{len(one)} clips were driven in one process, {len(three)} in three")
    for clip, row in one.items():
        if apart := [name for name in row.keys() - ASKED if repr(row[name]) != repr(three[clip][name])]:
            raise ValueError(f"clip {clip}: not as in one process: {', '.join(apart)}")
    return len(one)


def drive_apart(words: Sequence[str], scenes: Path, trained: Path, out: Path) -> dict[str, float]:
    """By three processes; the CPU seconds of each for a simulated second.

    Two clips are driven first: what starting and compiling cost is left out. {} where all was driven before.
    """
    with (
        served("factory", "scene", "serve", str(scenes)) as renderer,
        served("planners", "serve", "protocol=alpasim", f"planner={trained}") as driver,
    ):
        asked = (*words, f"renderer={renderer.address}", f"driver={driver.address}", "bounds=false", f"out={out}")
        started_s = run("planners drive", *asked, "limit=2")
        first_s = sum(row["duration_s"] for row in rows(out).values())
        servers = {"renderer": renderer, "driver": driver}
        before = {name: server.cpu_s for name, server in servers.items()}
        runtime_s = run("planners drive", *asked)
        rest_s = sum(row["duration_s"] for row in rows(out).values()) - first_s
        if rest_s == 0.0:
            return {}  # all was driven before
        costs = {name: (server.cpu_s - before[name]) / rest_s for name, server in servers.items()}
    return costs | {"runtime": (runtime_s - started_s) / (rest_s - first_s)}


def main(argv: Sequence[str]) -> None:
    """All of it."""
    given = dict(word.split("=", 1) for word in argv)
    front, out = Path(given["nuscenes_front"]), Path(given.get("out", "runs/driving"))
    run("factory.run", *SAMPLES.split(), f"out={out}/samples")
    trained = {}
    for seed in range(SEEDS):
        for arm, sim in (("ltf", ()), ("ltf_sim", (f"data.sim=[{out}/samples]",))):
            trained[f"{arm}_{seed}"] = out / f"{arm}_{seed}"
            words = (*TRAINING.split(), *sim, f"seed={seed}", f"data.real=[{out}/samples]")
            run("planners train", *words, f"out={out}/{arm}_{seed}")
    told = []
    for where, clips in clips_of(front).items():
        scenes, here = out / f"{where}_scenes", out / where
        run("factory.run", *clips.split(), *SCENES.split(), *FITS[where].split(), "executor=local", f"out={scenes}")
        words = (*clips.split(), *PICTURES.split(), "pictures=[renderer]")
        labels = ", ".join(f"{name}: {spec}" for name, spec in (GO_STRAIGHT | trained).items())
        for more in ((f"out={here}",), ("controller=nonlinear", f"out={here}_nonlinear")):
            run("planners drive", *words, f"renderer={scenes}", f"planners={{{labels}}}", *more)
        for name, folder in trained.items():
            costs = drive_apart(words, scenes, folder, out / f"{where}_wire_{name}")
            same = same_to_the_bit(rows(here, name), rows(out / f"{where}_wire_{name}"))
            cost = ", ".join(f"{who} {seconds:.2f}" for who, seconds in costs.items())
            told.append(f"{where}, {name}: {same} drives the same to the bit; CPU s for a simulated one: {cost}")
    print("\n".join(told))


if __name__ == "__main__":
    main(sys.argv[1:])
