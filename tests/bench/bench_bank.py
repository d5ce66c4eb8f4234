"""A bank of scenes beside the reward without one: `make bench NAME=bank`, `python -m tests.bench.bench_bank`.

The public metric's recorded scenes where they are at hand, else one of the synthetic town. A call scores P plans on
each of 64 scenes, which are those again and again, on one thread. `today` is a training loop without a bank: the scene
made ready from its arrays, then tracked and scored. `recorded` says whether all sub-scores and scores of 256 proposals
are the public ones. The training step is of a head as large as DrivoR's (arXiv 2601.05083, its drivoR.yaml: 64
proposals of 8 poses, two decoders of 4 layers, 256 wide, on 64 tokens), without pictures; it needs PyTorch. Traffic
that answers is that of clips: the recorded logs', or the town's.

PEER=<python of an environment with the packages navsim and nuplan-devkit> also runs the public metric, in turns.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.readers.base import ClipReader
from factory.setup.bank import PackedScene, write_bank, write_scenes
from tasks.bank import ANSWERING, BODY, FORMAT, HEAD, SceneBank, Traffic, pack_prepared
from tasks.bank_tensors import score_tensors
from tasks.caches import json_with_checksum
from tasks.reward.epdms import score
from tasks.rollout.lqr import track
from tasks.settings import TrafficSettings
from tasks.subscores import RECORDS
from tasks.world.frames import to_world
from tasks.world.vocabulary import kinematic_trajectories
from tests.bench.bench_reward import elsewhere, prepared_scene, recorded_scene, town_scene
from tests.bench.peer import SAME, BenchScene, beside, peer_python
from tests.bench.timing import least_and_median_cpu_ms, memory_mb
from tests.real.reference_scenes import SCENES, loader

B, SIZES, MANY, IN_SHARD, STEPS = 64, (16, 64, 256), 100_000, 1024, 12
UNSEEN = TownSettings(cameras=(), lidar_beams=0)
TOGETHER = 64  # plans of a scene in memory, threads and training
Plans = NDArray[np.float64]


def main(root: Path, sizes: Sequence[int] = SIZES, many: int = MANY, steps: int = STEPS) -> None:
    """Prints one table, a row for each of `sizes` plans a scene, then lines: of `steps` of training, `many` scenes."""
    has_recorded = (root / "reference").is_dir()
    if not has_recorded:
        print(f"no recorded scenes at {root}: a synthetic one instead", file=sys.stderr)
    scenes = {name: recorded_scene(root, name) for name in SCENES} if has_recorded else {"town": town_scene()}
    most = max(*sizes, TOGETHER)
    proposals = {
        name: loader(root).proposals(name, most) if has_recorded else kinematic_trajectories(most, 0) for name in scenes
    }
    with tempfile.TemporaryDirectory() as folder:
        bank = bank_of(scenes, Path(folder))
        peer = peer_python()
        columns = ["scene", "kB", "P", "bank: CPU us each, least / median", "today", "recorded"]
        columns += ["in turns: ours us each", "public us each", "ratios", "scores"] if peer else []
        print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
        for name, scene in scenes.items():
            same = recorded_are(bank, name, proposals[name], root) if has_recorded else "-"
            for p in sizes:
                print(
                    f"| {name} | {bank.n_bytes(name) / 1e3:.0f} "
                    + timed(bank, name, scene, proposals[name][:p], same, peer)
                )
        print_memory_and_threads(bank, proposals)
        print_training(bank, proposals, steps)
    with tempfile.TemporaryDirectory() as folder:
        print_answering(
            AV2Reader(root / "data/av2/sensor/val") if has_recorded else SyntheticReader(n_clips=1, settings=UNSEEN),
            folder,
        )
    with tempfile.TemporaryDirectory() as folder:
        print_opening(Path(folder), many)


def bank_of(scenes: dict[str, BenchScene], folder: Path) -> SceneBank:
    """The scenes without a reference of their own: proposals are a batch."""
    packed = {
        name: PackedScene(pack_prepared(prepared_scene(scene), scene.ego_state0)) for name, scene in scenes.items()
    }
    write_scenes(folder / HEAD.replace("*", "00000"), packed, {})
    return SceneBank(folder)


def recorded_are(bank: SceneBank, name: str, proposals: Plans, root: Path) -> str:
    """Whether sub-scores and scores of recorded proposals (K, 40, 3) are the recorded ones."""
    ours, public = bank.score([name], proposals[None]), loader(root).metrics(name, len(proposals))
    recorded = {record.name: public[record.long_name] for record in RECORDS if record.plans == 1}
    worst = max(np.abs(ours.subscores[0, :, i] - recorded[known]).max() for i, known in enumerate(ours.names))
    worst = max(worst, np.abs(ours.score[0] - public["pdm_score"]).max())
    return "equal" if worst <= SAME else f"differ by {worst:.2g}"


def timed(bank: SceneBank, name: str, scene: BenchScene, proposals: Plans, same: str, peer: str | None) -> str:
    """The rest of a row."""
    p, ids, many = len(proposals), [name] * B, np.repeat(proposals[None], B, 0)

    def today() -> None:
        ready = prepared_scene(elsewhere(scene))
        score(ready, track(scene.ego_state0, proposals, local=True))

    def from_bank() -> SimpleNamespace:
        found = bank.score([name], proposals[None], threads=1)
        columns = {known: found.subscores[0, :, i] for i, known in enumerate(found.names)}
        return SimpleNamespace(**columns, pdm_score=found.score[0])

    ours = least_and_median_cpu_ms(lambda: bank.score(ids, many, threads=1), 10)
    without = least_and_median_cpu_ms(today, 20)
    row = " / ".join(f"{1e3 * ms / (B * p):.1f}" for ms in ours)
    row = f"| {p} | {row} | {' / '.join(f'{1e3 * ms / p:.1f}' for ms in without)} | {same} |"
    if peer:
        poses = to_world(scene.ego_state0[:3], proposals)
        row += f" {beside(peer, scene, poses, from_bank, 5).row(p)} |"  # type: ignore[arg-type]
    return row


def batch_of(bank: SceneBank, proposals: dict[str, Plans], p: int) -> tuple[list[str], Plans]:
    """Ids (B,) of all scenes in turn and P plans (B, P, 8, 3) of each."""
    ids = [bank.clip_ids[b % len(bank)] for b in range(B)]
    return ids, np.stack([proposals[clip_id][:p, 4::5] for clip_id in ids])


def print_memory_and_threads(bank: SceneBank, proposals: dict[str, Plans]) -> None:
    """What a call of 64 x 64 plans adds to the process, and its wall time by threads."""
    ids, plans = batch_of(bank, proposals, TOGETHER)
    bank.score(ids, plans)
    before = memory_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew here
    bank.score(ids, plans)
    print(f"\n64 scenes x 64 plans at 2 Hz: {memory_mb('VmHWM') - before:.0f} MB more at the peak of a call")
    for threads in (1, 2):
        times = []
        for _ in range(20):
            begun = time.perf_counter()
            bank.score(ids, plans, threads=threads)
            times.append(time.perf_counter() - begun)
        each_s = float(np.median(times)) / (B * 64)
        print(f"{threads} thread(s): {1e3 * np.median(times):.1f} ms, {1.0 / each_s:,.0f} plans/s")


def print_answering(reader: ClipReader, folder: str) -> None:
    """Plans among traffic that answers to each, beside the same among the log's, over a reader's clips."""
    write_bank(folder, reader, reader.index().refs[::3], traffic=TrafficSettings())
    bank = SceneBank(folder)
    of_scene, of_traffic = (
        [bank.n_bytes(clip_id, suffix) / 1e3 for clip_id in bank.clip_ids] for suffix in (BODY, ANSWERING)
    )
    print(f"{len(bank)} clips: {min(of_scene):.0f} to {max(of_scene):.0f} kB a scene, ", end="")
    print(f"{min(of_traffic):.0f} to {max(of_traffic):.0f} kB more of traffic that answers")
    for p in (8, TOGETHER):
        plans = kinematic_trajectories(p, 0)[None]
        each = {
            traffic: [
                least_and_median_cpu_ms(partial(bank.score, [clip_id], plans, traffic=traffic, threads=1), 5)[1]
                for clip_id in bank.clip_ids
            ]
            for traffic in get_args(Traffic)
        }
        told = ", ".join(f"{name} {1e3 * min(ms) / p:.0f} to {1e3 * max(ms) / p:.0f}" for name, ms in each.items())
        print(f"{p} plans a scene, CPU us each: {told}")


def print_opening(folder: Path, many: int) -> None:
    """How long a bank takes to be opened whose bodies are holes of the right size."""
    for number, first in enumerate(range(0, many, IN_SHARD)):
        n = min(IN_SHARD, many - first)
        ids, ends = [f"{first + i:016x}" for i in range(n)], [85_000 * i for i in range(n + 1)]
        head = {"format": FORMAT, "clip_ids": ids, "ends": ends, "crc32": [2**31] * n, "left_out": {}, "tokens": {}}
        path = folder / HEAD.replace("*", f"{number:05}")
        path.write_text(json_with_checksum(head))
        with path.with_suffix(BODY).open("wb") as body:
            body.truncate(ends[-1])
    begun, before = time.perf_counter(), memory_mb("VmRSS")
    bank = SceneBank(folder)
    seconds = time.perf_counter() - begun
    print(f"{len(bank):,} scenes opened in {seconds:.2f} s, {memory_mb('VmRSS') - before:.0f} MB")


def print_training(bank: SceneBank, proposals: dict[str, Plans], steps: int) -> None:
    """Steps of 64 scenes x 64 proposals with the reward of the step's own proposals and without, in turns.

    The loop is docs/bank.md's. Other programs' load moves steps by more than the reward's call, which is told too.
    """
    import torch

    class Head(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.queries = torch.nn.Parameter(torch.randn(TOGETHER, 256))
            self.plan, self.judge = (decoder() for _ in range(2))
            self.to_poses, self.to_scores = torch.nn.Linear(256, 24), torch.nn.Linear(256, 8)
            self.from_poses = torch.nn.Linear(24, 256)

        def forward(self, tokens: torch.Tensor, anchors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            found = self.plan(self.queries.expand(len(tokens), -1, -1), tokens)
            plans = anchors + self.to_poses(found).unflatten(-1, (8, 3))
            return plans, self.to_scores(self.judge(self.from_poses(plans.detach().flatten(2)), tokens))

    def decoder() -> torch.nn.Module:
        layer = torch.nn.TransformerDecoderLayer(256, 1, 1024, dropout=0.0, batch_first=True)
        return torch.nn.TransformerDecoder(layer, 4)

    torch.manual_seed(0)
    planner = Head()
    optimizer = torch.optim.AdamW(planner.parameters(), 1e-4)
    ids, plans = batch_of(bank, proposals, TOGETHER)
    anchors, tokens = torch.from_numpy(plans).float(), torch.randn(B, 64, 256)

    def step(with_reward: bool) -> tuple[float, float, float]:
        begun, wall = time.process_time(), time.perf_counter()
        found, logits = planner(tokens, anchors)
        wanted, asked = torch.ones_like(logits), time.perf_counter()
        if with_reward:
            wanted = score_tensors(bank, ids, found).subscores
        took = time.perf_counter() - asked
        loss = torch.nn.functional.binary_cross_entropy_with_logits(logits, wanted)
        loss = loss + torch.nn.functional.l1_loss(found, anchors)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return time.perf_counter() - wall, time.process_time() - begun, took

    step(True)
    orders = ((False, True) if i % 2 else (True, False) for i in range(steps))  # what came before weighs on both alike
    turns = [{with_reward: step(with_reward) for with_reward in order} for order in orders]
    without, with_it = (np.array([turn[with_reward] for turn in turns]) for with_reward in (False, True))
    size, threads = sum(p.numel() for p in planner.parameters()) / 1e6, torch.get_num_threads()
    print(f"a head of {size:.1f} M, {len(turns)} steps of each in turns, {threads} threads, medians:")
    for i, what in enumerate(("wall", "CPU")):
        alone, both, speed = without[:, i], with_it[:, i], np.quantile(without[:, i] / with_it[:, i], (0.5, 0.25, 0.75))
        print(f"{what} s: {np.median(alone):.2f}, with the reward {np.median(both):.2f}; speed with it ", end="")
        print("{:.0%} of that without (quartiles {:.0%} to {:.0%})".format(*speed))
    print(f"the reward's call: {1e3 * np.median(with_it[:, 2]):.0f} ms of wall time")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared"))
