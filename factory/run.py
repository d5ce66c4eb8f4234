"""`python -m factory.run`: real clips in, committed training samples out.

    python -m factory.run rounds=5                                      a first look: three clips of drawn test data
    python -m factory.run clips=av2 clips.root=<logs> vocabulary.file=<human.npy> rounds=5
    python -m factory.run preset=demo out=runs/demo                     small and quick
    python -m factory.run ... --cfg                                     the settings, resolved

What it would take: python -m factory plan. The same command again goes on where the last one stopped. Exit codes: 0
complete, 2 bad settings or no clip (nothing is written), 3 complete with failed attempts, 4 interrupted and resumable.
"""

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from typing import TYPE_CHECKING

from factory.config.arguments import command
from factory.config.compose import ConfigError
from factory.config.datasets import data_set_of
from factory.config.plugins import import_target, plugins_by_name
from factory.config.run import RunConfig, announcement, built_in_classes, load_config, photos_alone, refuse_missing_root
from factory.config.words import CommandLine, parse_command_line
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, run_program
from factory.files import why_unusable
from tasks.render.settings import RenderMode

if TYPE_CHECKING:
    from factory.pipeline import FactoryWork
    from factory.readers.base import ClipRef
    from factory.store.remake import Remake
    from factory.store.samples import Store


@command("run", RunConfig, refused=(), resumes=True)
def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    return run(parse_command_line(argv), only_plan=False)


def interleave_by_log(refs: Sequence["ClipRef"], hands: int) -> list["ClipRef"]:
    """The clips in the order of work: log by log, the logs in groups of `hands` whose clips alternate.

    Each worker then begins with a log, and so a block, of its own instead of waiting for another's reconstruction.
    Rows do not depend on the order.
    """
    logs: dict[str, list[ClipRef]] = {}
    for ref in refs:
        logs.setdefault(ref.log_id, []).append(ref)
    queues = list(logs.values())
    groups = [queues[i : i + hands] for i in range(0, len(queues), hands)]
    return [ref for group in groups for turn in zip_longest(*group) for ref in turn if ref is not None]


@contextmanager
def out_of_collections() -> Iterator[None]:
    """What is loaded is not looked through for garbage, again and again, while the run goes on."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def needed_kernel_parts(config: RunConfig) -> list[str]:
    """The parts of factory.stages.warm that the run will ask for."""
    from factory.setup.settings import simulates
    from factory.stages.warm import kernel_parts

    return kernel_parts(simulates(config), config.traffic.mode, config.render, photos_alone(config))


def needs_own_process(config: RunConfig) -> bool:
    """Whether executor=local works in a process of its own: where asked for, a plug-in works, or logs can do harm."""
    used = [config.clips, *(spec for name, spec in config.expert.items() if name in config.experts)]
    foreign = any(not str(spec.get("_target_", "")).startswith(("factory.", "tasks.")) for spec in used)
    foreign |= config.traffic.policy is not None
    foreign |= bool(getattr(import_target(config.clips, "clips", "my_package.MyReader"), "untrusted", False))
    return config.graph.isolated == "always" or (config.graph.isolated == "auto" and foreign)


def run(asked: CommandLine, only_plan: bool) -> int:
    """Plan, execute, commit, report; or plan alone. The command line is checked before anything heavy is imported.

    A run on Ray, unless this process has joined a cluster already, is a process of its own, which Ray may end.
    """
    from factory.graph.own_process import check_address_answers, run_in_own_process

    config = _checked(asked)
    if config.executor == "ray":
        try:
            check_address_answers(os.environ.get("RAY_ADDRESS", ""))
        except ConnectionError as error:
            raise ConfigError(str(error)) from error
    print(announcement(config, asked.words), flush=True)
    if config.executor == "local" or only_plan or ("ray" in sys.modules and sys.modules["ray"].is_initialized()):
        return _run(config, asked, only_plan)
    work = partial(_run_in_child, tuple(asked.words), time.monotonic())
    return run_in_own_process(work, not os.environ.get("RAY_ADDRESS"), lambda line: print(line, flush=True))


def _checked(asked: CommandLine) -> RunConfig:
    config = load_config(asked.words)
    if unusable := why_unusable(config.out):
        raise ConfigError(unusable)
    refuse_missing_root(config.clips)
    refuse_missing_classes(config)
    refuse_cameras_of_no_rig(config)
    return config


def _run_in_child(words: Sequence[str], first_began: float, begun: int, tell: Callable[[str], None]) -> int:
    """The run in its own process. first_began: of the first one, on the monotonic clock; begun: clusters begun anew."""

    def say(line: str) -> None:
        print(line, flush=True)
        tell(line)

    began = first_began if begun else None

    def work(argv: Sequence[str]) -> int:
        asked = parse_command_line(argv)
        return _run(_checked(asked), asked, False, began, begun, say)

    return replace(main, does=work)(words)


def _run(
    config: RunConfig,
    asked: CommandLine,
    only_plan: bool,
    began: float | None = None,
    begun: int = 0,
    say: Callable[[str], None] = print,
) -> int:
    from factory.graph.driver import EpisodeSettings
    from factory.graph.execute import Execution, execute, rerun_on_new_clusters
    from factory.graph.local import Claims, Limits
    from factory.setup.calibrate import estimate_run_size, plan_text
    from factory.setup.settings import assemble
    from factory.stages.benchmark import NEEDED, write_benchmark
    from factory.stages.warm import compiling_ahead
    from factory.store.funnel import image_sources_text
    from factory.store.location import BadLocation, Location
    from factory.store.samples import OtherSchema, Store
    from factory.views.board.report import write_pages
    from factory.views.sample_text import prepared_episode
    from factory.views.status import failure_summary

    try:
        store = Store(Location.parse(config.out))
    except (BadLocation, OtherSchema) as error:
        raise ConfigError(str(error)) from error
    elsewhere = config.executor == "ray" and "RAY_ADDRESS" in os.environ  # a cluster's nodes compile for themselves
    with nullcontext() if elsewhere else compiling_ahead(needed_kernel_parts(config)):
        assembled = assemble(config)
        refs = interleave_by_log(assembled.refs, config.workers or os.cpu_count() or 1)
        print(plan_text(assembled, refs), flush=True)
        if only_plan:
            print(estimate_run_size(assembled, refs))
            return 0
        remake = _planned_remake(config, assembled.work, store, refs) if config.remake else None
        work = assembled.work if remake is None else replace(assembled.work, earlier=remake.earlier)
        since = time.monotonic() if began is None else began
        with out_of_collections():
            summary = rerun_on_new_clusters(
                lambda: execute(
                    work,
                    refs,
                    config.experts,
                    config.rounds,
                    store,
                    Execution(
                        config.executor,
                        config.workers,
                        claims=Claims(config.gpu_share if assembled.work.draws_on_gpu else 0.0, config.graph.memory_gb),
                        isolated=needs_own_process(config),
                        limits=Limits(config.graph.limit_s, config.graph.limit_gb),
                        on_change=config.on_change if remake is None else "redo",
                        remade=None if remake is None else remake.record,
                        retry=config.retry_failed,
                        shard_seconds=config.shard_seconds,
                        minutes=config.minutes and max(0.0, config.minutes - (time.monotonic() - since) / 60.0),
                        episodes=EpisodeSettings(config.one_episode_in, prepared_episode)
                        if config.one_episode_in
                        else None,
                        command=asked.words,
                    ),
                ),
                say,
                begun,
            )
    if summary.exit_code == BAD_CONFIG:
        raise ConfigError(summary.message)
    if summary.message:
        print(summary.message, file=sys.stderr)
    if summary.funnel is None:
        return summary.exit_code
    print(summary.funnel.text())
    if summary.is_broken:
        return summary.exit_code
    print(image_sources_text(store, [ref.clip_id for ref in refs]))
    if summary.seconds:
        print(f"{'stage':<12}{'tasks':>8}{'CPU s':>10}{'each':>10}{'seconds':>10}")
        for stage, (n, spent) in summary.seconds.items():
            print(f"{stage:<12}{n:>8}{spent.cpu_s:>10.1f}{spent.cpu_s / n:>10.3f}{spent.wall_s:>10.1f}")
    if set(config.experts) >= NEEDED and summary.exit_code == COMPLETE:
        print(write_benchmark(store, refs, assembled.work.identity, config.rounds, config.benchmark))
    report, card = write_pages(store, assembled)
    print(f"report: {report}\ncard: {card}\nlook at samples: python -m factory dashboard out={store.location.uri}")
    if summary.exit_code == COMPLETE_WITH_FAILURES:
        print(failure_summary(store))
    return summary.exit_code


def _planned_remake(
    config: RunConfig, work: "FactoryWork", store: "Store", refs: Sequence["ClipRef"]
) -> "Remake | None":
    """What `remake` makes again, told; None where nothing is. Raises ConfigError where it cannot."""
    from factory.store.location import BadLocation
    from factory.store.remake import plan_remake, remade_text
    from factory.store.samples import ChangedRun
    from factory.store.table import AnotherWriter
    from factory.store.verify import RunInProgress

    digests = {expert: work.expert_digest(expert) for expert in config.experts}
    wanted = {expert: 1 if work.once(expert) else config.rounds for expert in config.experts}
    try:
        remake = plan_remake(store, work.identity, digests, config.remake, wanted, [ref.clip_id for ref in refs])
    except (ChangedRun, RunInProgress, AnotherWriter, BadLocation) as error:
        raise ConfigError(f"remake: {error}") from error
    told = "every row is of these settings already" if remake is None else remade_text(remake.record)
    print(f"remake: {told}", flush=True)
    return remake


# What a run names outside its settings, looked up before anything heavy is imported and any clip is read.
#
# Classes of plug-ins, folders of logs, the cameras of their rigs. What only reading a clip can tell comes later.


def refuse_missing_classes(config: RunConfig) -> None:
    """Raises ConfigError where the class of the reader, or of an expert that the user configured, is not there."""
    named = {"clips": (config.clips, "my_package.MyReader")}
    others = {plugin.target for plugins in plugins_by_name("expert").values() for plugin in plugins}
    for name, spec in config.expert.items():
        if name in config.experts or spec.get("_target_") not in others:  # an installed one may lie idle, and broken
            named[f"expert.{name}"] = (spec, "my_package.MyExpert")
    built_in = {*built_in_classes("clips").values(), *built_in_classes("expert").values()}
    for where, (spec, example) in named.items():
        if spec.get("_target_") not in built_in:
            import_target(spec, where, example)


def refuse_cameras_of_no_rig(config: RunConfig) -> None:
    """Raises ConfigError for a root without logs, and for a camera in render.cameras that the rig of no log has.

    Settings of rigs are held against themselves; the rig of a user's own reader is known when a clip is read.
    """
    clips, wanted = config.clips, config.render.cameras
    look = getattr(data_set_of(clips), "camera_names", None)
    if look is None:
        return
    try:
        rig: tuple[str, ...] = look(clips)
    except ValueError as error:
        raise ConfigError(f"clips: {error}") from error
    if not wanted or config.render.mode is RenderMode.NONE:
        return
    if not rig and config.render.mode is RenderMode.MAP:
        from tasks.render.views import MAP_RIG

        rig = tuple(camera.name for camera in MAP_RIG)
    if missing := [name for name in wanted if name not in rig]:
        none = f"no log under {clips['root']} has calibrated cameras"
        if "cameras" in clips:
            none += "; clips.cameras=<sidecar> brings some"
        has = f"this rig has {', '.join(rig)}" if rig else none
        raise ConfigError(f"render.cameras: no camera {', '.join(missing)}; {has}")


if __name__ == "__main__":
    run_program(main)
