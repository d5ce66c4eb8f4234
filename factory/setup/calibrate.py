"""What a run would take: the clips it would read, and attempts, hours and GB extrapolated from three clips.

And in what its set-up differs from the paper's, to which conf/preset/paper.yaml comes nearest: one line at its start.
"""

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import reduce
from typing import Any, cast

from factory.config.compose import conf_dir
from factory.config.run import RunConfig, completed, typed_run_config
from factory.config.shapes import deep_merge, defaults_of
from factory.graph.plan import candidate_order
from factory.graph.steps import SampleColumns, Spent, run_attempt
from factory.readers.base import ClipRef
from factory.setup.settings import Run
from factory.store.location import encode_tree
from factory.store.schema import BOOKKEEPING, sample_rows_to_table
from tasks.experts.recovery import RecoveryExpert
from tasks.render.settings import ImageSource, RenderMode, SceneFrom
from tasks.render.splatting.gsplat_backend import FITS_AT_ONCE, require
from tasks.stages import TASKS, Rejected
from tasks.world.vocabulary import Vocabulary

CALIBRATION_CLIPS = 3
NAVTRAIN_DRIVES = 103_288  # the paper's table of the recovery expert: of each scene the human one
KINEMATIC_LABELS = (
    "labels: of kinematic trajectories, few of which end where a driver would, so that a planner learns little from "
    "them: give vocabulary.file=<.npy> of human ones (python -m factory vocabulary makes it), or reward.labels=none"
)
# What the paper says of how samples are made; the rest is this project's own, or how much and where.
WATCHED = (
    "perturb",
    "traffic",
    "reward.full",
    "reward.progress_above",
    "reward.off_route",
    "reward.after",
    "reward.near_log",
    "expert.recovery.match",
    "render.mode",
    "render.frames",
    "render.width",
    "render.height",
    "render.psnr_min",
    "render.camera_psnr_min",
    "render.gate.enabled",
)


def plan_text(run: Run, refs: Sequence[ClipRef]) -> str:
    """What was found under the root and what the run is asked for."""
    index, config = run.index, run.config
    lines = [f"clips: {len(index.refs)} windows of {len({ref.log_id for ref in index.refs})} logs ({run.reader.name})"]
    if len(refs) < len(index.refs) + len(index.broken):
        lines[0] += f", limited to {len(refs)}"
    lines += [f"  filtered {count} windows: {reason}" for reason, count in index.dropped.items()]
    lines += [f"  skipped log {log}: {reason}" for log, reason in index.skipped_logs.items()]
    lines += [f"  broken log {ref.log_id}: {problem}" for ref, problem in index.broken.items()]
    vocabulary = run.work.vocabulary
    lines.append(f"vocabulary: {len(vocabulary)} trajectories ({vocabulary.source}, {vocabulary.digest})")
    if config.reward.labels == "vocabulary" and not (config.reward.label_vocabulary or config.vocabulary.file):
        lines.append(KINEMATIC_LABELS)
    if starts := run.work.starts:
        n_clips = sum(ref.clip_id in starts for ref in refs)
        lines.append(f"starts: {sum(map(len, starts.values()))}; {n_clips} of the {len(refs)} clips have some")
    lines.append(f"experts: {', '.join(config.experts)}; rounds: {config.rounds}; out: {config.out}")
    tables = {name: len(one.table) for name, one in run.work.experts.items() if isinstance(one, RecoveryExpert)}
    lines.append(paper_deviations_line(config, vocabulary, tables))
    return "\n".join(lines)


@dataclass
class Calibration:
    """Sums over the calibration clips."""

    clips: int = 0
    candidates: int = 0
    attempts: int = 0
    accepted: int = 0
    row_bytes: int = 0
    cache_bytes: int = 0  # of prepared clips
    pictures: int = 0  # in samples, drawn
    seconds: dict[str, Spent] = field(default_factory=lambda: defaultdict(Spent))  # by stage
    fits: list[Spent] = field(default_factory=list)  # of blocks that were not in the cache
    notes: list[str] = field(default_factory=list)

    def spend(self, seconds: Mapping[str, Spent]) -> None:
        """Stage -> what it took, once more."""
        for stage, spent in seconds.items():
            self.seconds[stage] += spent


def measure(run: Run, refs: Sequence[ClipRef]) -> Calibration:
    """Walk a few clips, evenly spread over the run's, in this process; nothing is written but the block cache."""
    sums = Calibration()
    n = min(CALIBRATION_CLIPS, len(refs))
    chosen = [refs[i * len(refs) // n] for i in range(n)]
    run.work.warm()
    for ref in chosen:
        if ref in run.index.broken:
            sums.notes.append(f"{ref.log_id}: {run.index.broken[ref]}")
            continue
        block, began = run.work.block(ref), Spent.now()
        if block is not None and not run.work.reconstruct(ref, 1).from_cache:
            sums.fits.append(Spent.now() - began)
        prepared = run.work.prepare(ref)
        sums.clips += 1
        if isinstance(prepared, Rejected):
            sums.notes.append(f"{ref.clip_id}: rejected by {prepared.stage}: {prepared.reason}")
            continue
        sums.candidates += len(prepared.candidates)
        sums.cache_bytes += len(encode_tree(prepared))
        sums.spend(prepared.seconds)
        for expert in run.config.experts:
            once = run.work.once(expert)
            wanted = 1 if once else run.config.rounds
            for candidate in candidate_order(once, len(prepared.candidates)):
                result = run_attempt(run.work, prepared, candidate, expert)
                sums.attempts += 1
                sums.spend(result.seconds)
                if isinstance(result, SampleColumns):
                    sums.accepted += 1
                    if result.row.get("image_source") == ImageSource.RENDER:
                        sums.pictures += len(cast(Sequence[object], result.row["images"]))
                    blank: dict[str, object] = dict.fromkeys(BOOKKEEPING, "") | {"round": 0, "candidate_index": 0}
                    sums.row_bytes += int(sample_rows_to_table([{**blank, **result.row}]).nbytes)
                    wanted -= 1
                if wanted == 0:
                    break
    return sums


def estimate_run_size(run: Run, refs: Sequence[ClipRef]) -> str:
    """The expected size of the whole run as a text: what its clips take is extrapolated by clips, what their blocks
    take by blocks.

    By CPU seconds, which other work on the machine leaves as they are; by the clock where a GPU is waited for.
    """
    sums = measure(run, refs)
    if sums.clips == 0:
        return "\n".join(["nothing could be measured:", *sums.notes])
    factor, settings = len(refs) / sums.clips, run.config.render

    def seconds(stage: str, spent: Spent) -> float:
        return spent.wall_s if run.work.draws_on_gpu and stage in ("reconstruct", "render") else spent.cpu_s

    taken = {stage: seconds(stage, spent) for stage, spent in sums.seconds.items()}
    hours = {stage: spent_s * factor / 3600.0 for stage, spent_s in taken.items()}
    each = {stage: f"{spent_s / sums.clips:.2f} a clip" for stage, spent_s in taken.items()}
    blocks = {run.work.block(ref) for ref in refs} - {None}
    if sums.fits:
        fit_s = seconds("reconstruct", sum(sums.fits, Spent())) / len(sums.fits)
        hours = {"reconstruct": fit_s * len(blocks) / 3600.0} | hours
        each["reconstruct"] = f"{fit_s:.1f} a block"
    elif blocks:
        sums.notes.append("what blocks take is not counted: those that were looked at are in the cache")
    gb = f"{sums.row_bytes * factor / 1e9:.3f} GB before compression, {sums.cache_bytes * factor / 1e9:.3f} GB of cache"
    of = f"{len(refs)} clips" + (f" of {len(blocks)} blocks" if blocks else "")
    made = f"{sums.attempts * factor:.0f} attempts, {sums.accepted * factor:.0f} samples"
    lines = [
        f"measured on {sums.clips} clips: {sums.candidates / sums.clips:.1f} candidates a clip, "
        f"{sums.accepted} of {sums.attempts} attempts accepted",
        f"  {'stage':<12}{'CPU seconds':>16}{'core-hours':>12}",
        *(f"  {stage:<12}{each[stage]:>16}{spent:>12.2f}" for stage, spent in hours.items()),
        f"expected for {of}: {made}, {gb}, {sum(hours.values()):.2f} core-hours",
        _time_line(run, hours, machines_of(run)),
    ]
    if sums.pictures and not run.work.draws_on_gpu and settings.mode is RenderMode.AUTO:
        drawn = f"{sums.pictures * factor:,.0f} pictures of {settings.width}x{settings.height}"
        if settings.scene is SceneFrom.FIT:
            drawn += f" and {len(blocks)} fits of {settings.fit.iterations:,} iterations"
        lines.append(f"for a GPU: {drawn}; what it does a second, make gpu-check says (docs/gpu.md)")
    return "\n".join([*lines, *sums.notes])


def _time_line(run: Run, hours: Mapping[str, float], there: "Machines") -> str:
    """How long that takes on what there is, what holds it up, and what memory it wants."""
    cores = run.config.workers or there.cores
    most = max(hours, key=lambda stage: hours[stage])
    spent, bound = sum(hours.values()) / cores, f"{most}, {hours[most] / max(sum(hours.values()), 1e-9):.0%} of it"
    told = f"{spent:.2f} h on {cores} cores"
    if run.work.draws_on_gpu:
        # At most: a fit has its turn for its iterations alone.
        of_gpus = hours.get("reconstruct", 0.0) / FITS_AT_ONCE + run.config.gpu_share * hours.get("render", 0.0)
        gpus = max(there.gpus, 1)  # what was measured on, where a cluster has none yet
        told += f"; {of_gpus:.2f} GPU-hours, {of_gpus / gpus:.2f} h on {gpus} GPUs"
        if of_gpus / gpus > spent:
            bound = "the GPUs"
    claim = max(task.memory_gb for task in TASKS)
    memory = f"at most {claim:g} GB a worker, {claim * cores:g} of {there.memory_gb:.0f} GB {there.where}"
    return f"{told}, most in {bound}; {memory}"


@dataclass(frozen=True)
class Machines:
    """What a run would have."""

    where: str
    cores: int
    gpus: int
    memory_gb: float


def machines_of(run: Run) -> Machines:
    """All nodes of the cluster that the run would join, else this machine. Raises ConnectionError where none answers.

    The memory of a cluster is what Ray hands out.
    """
    if run.config.executor == "ray" and os.environ.get("RAY_ADDRESS"):
        from factory.graph.on_ray.graph import joined_cluster, per_node

        with joined_cluster():
            cores = per_node("CPU")
            where = f"on {len(cores)} nodes"
            return Machines(where, sum(cores), sum(per_node("GPU")), sum(per_node("memory")) / 2**30)
    gpus = int(require()[0].cuda.device_count()) if run.work.draws_on_gpu else 0
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return Machines("here", os.cpu_count() or 1, gpus, memory_gb)


def paper_deviations_line(config: RunConfig, vocabulary: Vocabulary, tables: Mapping[str, int]) -> str:
    """One line: settings that are not preset=paper's, with those in brackets, and what no preset makes the paper's.

    tables: trajectories of each recovery expert's table.
    """
    found = [*differences_from_paper(config, vocabulary), *differences_in_every_preset(config)]
    found += [
        f"expert.{name}: {size:,} trajectories to retrieve ({NAVTRAIN_DRIVES:,}, all of navtrain's)"
        for name, size in tables.items()
        if size < NAVTRAIN_DRIVES
    ]
    return f"set-up: not the paper's (in brackets; preset=paper comes nearest): {', '.join(found)}"


def differences_in_every_preset(config: RunConfig) -> list[str]:
    """What of this set-up is not as the paper's text (3.2, supplement) or the public code has it, in any preset."""
    found = ["walks that go on to the next candidate until one is accepted (the rates fit one draw a round)"]
    if config.traffic.mode == "idm":
        found.append("IDM along the lane graph (the public code's brakes for each lane's end: traffic=navsim)")
    if config.render.mode is not RenderMode.NONE:
        found.append("pictures from T+2.5 s on, as the release (from T)")
        gate = "the project's own picture gate" if config.render.gate.enabled else "no picture gate"
        found.append(f"{gate} (unstable renderings are left out, by a rule that is not published)")
    return found


def differences_from_paper(config: RunConfig, vocabulary: Vocabulary) -> list[str]:
    """`key=value (the paper's)` for each watched setting that is another.

    Nothing is said of pictures where none are rendered, nor of experts that do not drive.
    """
    paper = paper_config()
    given, wanted = _dotted_items(asdict(config)), dict(_dotted_items(asdict(paper)))
    found, size = [], paper.vocabulary.k
    if len(vocabulary) != size or config.vocabulary.file is None:
        kind = "kinematic" if config.vocabulary.file is None else "given"
        found.append(f"vocabulary of {len(vocabulary):,} {kind} trajectories ({size:,} human ones)")
    unseen = [f"expert.{name}" for name in paper.expert if name not in config.experts]
    if config.render.mode is not paper.render.mode:
        unseen += [key for key in WATCHED if key.startswith("render.") and key != "render.mode"]
    return found + [
        f"{key}={value} ({wanted[key]})"
        for key, value in given
        if _within(key, WATCHED) and not _within(key, unseen) and value != wanted[key]
    ]


def paper_config() -> RunConfig:
    """What `preset=paper vocabulary.file=given` composes, but for `out`.

    Read here file by file: every run asks, and Hydra takes a quarter of a second for it.
    """
    from omegaconf import OmegaConf

    def read(name: str) -> Any:
        return OmegaConf.to_container(OmegaConf.load(conf_dir() / f"{name}.yaml"))

    values = defaults_of(RunConfig)
    groups = {group: choice for line in read("run")["defaults"] if line != "_self_" for group, choice in line.items()}
    for group, choice in {**groups, "preset": "paper"}.items():
        folder, _, package = group.partition("@")
        within = [] if folder == "preset" else (package or folder).split(".")
        found = reduce(lambda inner, key: {key: inner}, reversed(within), read(f"{folder}/{choice}"))
        values = deep_merge(values, found)
    return typed_run_config(completed(deep_merge(values, {"vocabulary": {"file": "given"}, "out": "anywhere"})))


def _within(key: str, groups: Sequence[str]) -> bool:
    return any(key == group or key.startswith(f"{group}.") for group in groups)


def _dotted_items(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys with dots -> values."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _dotted_items(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
