"""The settings of a run, typed, and the run they make: reader, vocabulary, experts, work."""

import dataclasses
import hashlib
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from inspect import signature
from pathlib import Path
from typing import Any

from factory.config.compose import ConfigError, build, fill
from factory.config.plugins import import_target
from factory.config.run import RecoverySources, Repairs, RunConfig, VocabularyChoice, photos_alone, refuse_relative_root
from factory.files import machine_fault_of
from factory.pipeline import BenchmarkWork, FactoryWork
from factory.readers.base import BadClip, ClipIndex, ClipReader, ClipRef, RefusesRepairs, read_clip
from factory.setup.vocabulary import (
    StartTrajectories,
    build_recovery_table,
    load_recovery_table,
    load_start_trajectories,
    load_vocabulary,
    save_recovery_table,
    train_windows,
)
from factory.store.schema import UNLISTED, RunIdentity, canonical_json
from tasks.caches import user_cache, verify_checksum
from tasks.experts.protocol import Expert, drives_once_per_clip
from tasks.experts.recovery import RecoveryExpert, RecoverySettings, RecoveryTable
from tasks.render.settings import RenderMode
from tasks.rollout.simulate import traffic_record
from tasks.stages import FRAMES, stage_versions
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories, refuse_other_meaning

KINEMATIC_K = 1024
RIGS_LOOKED_AT = 3  # clips, for the names of their cameras


@dataclass(frozen=True)
class Run:
    """A configured run: what to read and what to do with it."""

    config: RunConfig
    reader: ClipReader
    index: ClipIndex
    work: FactoryWork

    @property
    def refs(self) -> list[ClipRef]:
        """The clips that it is asked for, those of broken logs among them."""
        return [*self.index.refs, *self.index.broken][: self.config.limit]


@dataclass(frozen=True)
class RunContext:
    """What an expert is told of its run, where its class, or the function that makes it, takes an argument `run`."""

    config: RunConfig
    name: str  # of the expert
    clips: Callable[[], tuple[ClipReader, ClipIndex]]  # opens them when it is first called


def open_reader(clips: Mapping[str, Any], repairs: Repairs = "make") -> tuple[ClipReader, ClipIndex]:
    """The reader of the chosen clips, and what its root holds. Raises ConfigError where that is nothing."""
    reader: ClipReader = build(clips, "clips")
    _must_have(reader, ("name", "index", "read"), "clips", "a reader (factory.readers.base.ClipReader)")
    if repairs == "refuse":
        reader = RefusesRepairs(reader)
    try:
        index = reader.index()
    except (ValueError, OSError) as error:
        if machine_fault_of(error):  # a full disk under the user's cache is no wrong setting
            raise
        raise ConfigError(f"clips: {error}") from error
    if not index.refs and not index.broken:
        reasons = [f"{reason} x{count}" for reason, count in index.dropped.items()]
        reasons += [f"{log}: {reason}" for log, reason in index.skipped_logs.items()]
        raise ConfigError(
            f"clips: no clip found under {clips.get('root', 'its root')} ({'; '.join(reasons) or 'empty'})"
        )
    return reader, index


def refuse_missing_backend(config: RunConfig) -> None:
    """Raises ConfigError where images are to be drawn with what this machine lacks; a cluster's nodes say so later."""
    if config.render.mode is not RenderMode.AUTO or (config.executor == "ray" and "RAY_ADDRESS" in os.environ):
        return
    from tasks.render.scene.engine import require_backend
    from tasks.render.splatting.gsplat_backend import BackendMissing

    try:
        require_backend(config.render.backend)
    except BackendMissing as error:
        raise ConfigError(str(error)) from error


def assemble(config: RunConfig) -> Run:
    """Open the reader, load the vocabulary, prepare the experts. Raises ConfigError with what to fix."""
    refuse_relative_root(config.clips)
    refuse_missing_backend(config)

    @cache
    def opened() -> tuple[ClipReader, ClipIndex]:
        found = open_reader(config.clips, config.repairs)
        refuse_unknown_cameras(config, *found)
        return found

    try:  # what takes no clips comes first
        vocabulary = choose_vocabulary(config.vocabulary)
        labels_of = choose_labels_of(config, vocabulary)
        traffic_record(config.traffic)  # whether there is its policy
        starts = None if config.perturb.starts is None else load_start_trajectories(config.perturb.starts)
        experts = {
            name: build_expert(RunContext(config, name, opened)) for name in config.experts if name not in FRAMES
        }
        reader, index = opened()
        clip_ids = {ref.clip_id for ref in (*index.refs, *index.broken)}
        if starts is not None and starts.of_clip.keys().isdisjoint(clip_ids):
            raise ValueError(f"perturb.starts: none of its {len(starts.of_clip)} clips is among those of clips=")
    except ValueError as error:
        raise error if isinstance(error, ConfigError) else ConfigError(str(error)) from error
    frames = tuple(name for name in config.experts if name in FRAMES)
    kind = partial(BenchmarkWork, frames=frames) if frames else FactoryWork
    work = kind(
        reader=reader,
        broken=index.broken,
        vocabulary=vocabulary,
        experts=experts,
        perturb=config.perturb,
        traffic=config.traffic,
        gate=config.reward,
        labels_of=labels_of,
        render=config.render,
        seed=config.seed,
        identity=run_identity(config, vocabulary, labels_of, starts),
        cache_dir=cache_folder(config.out),
        photos_alone=photos_alone(config),
        starts={} if starts is None else starts.of_clip,
    )
    return Run(config, reader, index, work)


def refuse_unknown_cameras(config: RunConfig, reader: ClipReader, index: ClipIndex) -> None:
    """Raises ConfigError where render.cameras or a mask names one that the rig of the first readable clip lacks.

    Rigs that differ from log to log are told apart by the attempts themselves.
    """
    wanted, masks = config.render.cameras, config.render.own_body
    if not (wanted or masks) or config.render.mode is RenderMode.NONE:
        return
    from factory.stages.sensors import choose_cameras, refuse_unknown_masks
    from tasks.render.views import MAP_RIG

    for ref in index.refs[:RIGS_LOOKED_AT]:
        try:
            rig = read_clip(reader, ref).cameras
        except BadClip:
            continue
        if not rig and config.render.mode is RenderMode.MAP:
            rig = MAP_RIG
        if rig:
            choose_cameras(rig, wanted)
            refuse_unknown_masks(masks, rig)
            return


def choose_vocabulary(choice: VocabularyChoice) -> Vocabulary:
    """The file's trajectories, or the kinematic vocabulary where no file is named."""
    if choice.file is not None:
        return load_vocabulary(choice.file, choice.k)
    return Vocabulary(kinematic_trajectories(choice.k or KINEMATIC_K, seed=0), source="kinematic")


def choose_labels_of(config: RunConfig, vocabulary: Vocabulary) -> Vocabulary | None:
    """What samples are labelled with, None for nothing. Raises ValueError that names a vocabulary file."""
    if config.reward.labels == "none":
        return None
    named = config.reward.label_vocabulary
    return vocabulary if named is None else load_vocabulary(named)


def build_expert(run: RunContext) -> Expert:
    """What the expert's `_target_` makes of its settings and, where it asks for it, of `run`. Raises ConfigError."""
    where = f"expert.{run.name}"
    target, spec = _target(run.config, run.name), run.config.expert[run.name]
    if not _asks_for_run(target):
        made = build(spec, where, labels=())
    else:
        try:
            signature(target).bind(run=run, **{key: value for key, value in spec.items() if key != "_target_"})
        except TypeError as error:
            raise ConfigError(f"{where}: {spec['_target_']}: does not take these settings: {error}") from error
        made = build({**spec, "_partial_": True}, where, labels=())(run=run)
    _must_have(made, ("name", "digest", "plan"), where, "an expert (tasks.experts.protocol.Expert)")
    expert: Expert = made
    return expert


def _target(config: RunConfig, name: str) -> Callable[..., Any]:
    """What `expert.<name>._target_` names. Raises ConfigError."""
    found: Callable[..., Any] = import_target(config.expert[name], f"expert.{name}", "my_package.MyExpert")
    return found


def _asks_for_run(target: Callable[..., Any]) -> bool:
    try:
        return "run" in signature(target).parameters
    except (TypeError, ValueError):  # nothing to call, or written in C
        return False


def simulates(config: RunConfig) -> bool:
    """Whether the run drives from candidates: not where all its experts are tried once, on the log itself."""
    return any(name in FRAMES or not drives_once_per_clip(_target(config, name)) for name in config.experts)


def _must_have(plugged: object, members: Sequence[str], where: str, what: str) -> None:
    missing = [member for member in members if not hasattr(plugged, member)]
    if missing:
        raise ConfigError(f"{where}: {type(plugged).__name__} is not {what}: it has no {', '.join(missing)}")


def run_identity(
    config: RunConfig, vocabulary: Vocabulary, labels_of: Vocabulary | None, starts: StartTrajectories | None = None
) -> RunIdentity:
    """What the rows depend on besides clip, candidate and expert. Where data lies and who works on it is not in it.

    Candidates of the vocabulary and start states of the clips' own share one numbering, so where there are starts the
    vocabulary's digest, and with it every attempt's id, covers both.
    """
    science: dict[str, Any] = {
        "perturb": config.perturb,
        "reward": config.reward,
        "render": config.render,
    }
    settings: dict[str, object] = {"seed": config.seed, "repairs": config.repairs, "vocabulary": vocabulary.digest}
    for group, value in science.items():
        settings |= {f"{group}.{key}": plain for key, plain in dataclasses.asdict(value).items()}
    settings |= {f"traffic.{key}": plain for key, plain in traffic_record(config.traffic).items()}
    del settings["perturb.starts"]  # a path
    digest = vocabulary.digest
    if starts is not None:
        settings["perturb.starts"] = starts.digest
        digest = hashlib.sha256(canonical_json([digest, starts.digest]).encode()).hexdigest()[:16]
    if config.render.own_body:
        from factory.stages.sensors import masks_digest

        settings["render.own_body"] = masks_digest(config.render.own_body)
    settings["reward.label_vocabulary"] = None if labels_of is None else labels_of.digest
    versions = stage_versions()
    early: dict[str, object] = {
        key: value for key, value in settings.items() if not key.startswith(("reward.", "render."))
    }
    stages = ["clip", "perturb", "rollout", "expert", "reward"]
    if config.render.refuses_blocks:  # then the block's verdict is part of what is prepared
        early |= {key: value for key, value in settings.items() if key.startswith("render.")}
        stages.append("render")
    made_of: list[object] = [early, {stage: versions[stage] for stage in stages}]
    if set(config.experts) & set(FRAMES):  # then a prepared clip has its earlier frame
        made_of.append("earlier frame")
    prepared = canonical_json(made_of)
    listed = hashlib.sha256(prepared.encode()).hexdigest()[:16] if simulates(config) else UNLISTED
    return RunIdentity(settings, versions, digest, listed)


def cache_folder(out: str) -> str:
    """Where blocks and tables are kept: beside the run's tables when `out` is a folder, else in the user's cache."""
    if "://" in out:
        return str(user_cache() / "assets")
    return str(Path(out).absolute() / "cache")


# The recovery expert of a run: its table is built from the run's own clips and vocabularies where none is named.

log = logging.getLogger(__name__)


def recovery_expert(run: RunContext, **settings: Any) -> RecoveryExpert:
    """Of conf/expert/recovery.yaml. Raises ConfigError."""
    where = f"expert.{run.name}"
    sources = fill(RecoverySources, settings, where)
    chosen = RecoverySettings(sources.match)
    if sources.table is None:
        return RecoveryExpert(_recovery_table(run, sources.vocabularies), chosen)
    if not Path(sources.table).is_file():
        raise ConfigError(f"{where}.table={sources.table}: there is no such file")
    if sources.vocabularies:
        raise ConfigError(f"{where}: give table or vocabularies; a finished table takes no more trajectories")
    table = load_recovery_table(sources.table)
    refuse_other_meaning(table.trajectories, sources.table)
    return RecoveryExpert(table, chosen)


def _recovery_table(run: RunContext, vocabularies: Sequence[str]) -> RecoveryTable:
    """Of all TRAIN windows and the vocabulary files, kept in the user's cache."""
    named = run.config.vocabulary.file
    files = [*vocabularies, *([named] if named else [])]
    loaded = [load_vocabulary(file) for file in dict.fromkeys(files)]  # before clips, which may be hours of listing
    reader, index = run.clips()
    digests = _log_digests(reader, index)
    if digests is None:
        return build_recovery_table([train_windows(reader)], loaded)
    chosen = dict(run.config.clips)  # where logs lie, and what splits them, decides which are train
    made_of = [stage_versions()["clip"], run.config.repairs, chosen, digests, sorted(ref.clip_id for ref in index.refs)]
    made_of.append([vocabulary.digest for vocabulary in loaded])
    key = hashlib.sha256(canonical_json(made_of).encode()).hexdigest()[:16]
    cached = user_cache() / "tables" / f"recovery-{key}.npz"
    if cached.is_file():
        try:
            verify_checksum(cached, cached.name)
            return load_recovery_table(cached)
        except ValueError as error:  # Damaged among them
            log.warning("%s: %s; it is made again", cached, str(error).removeprefix(f"{cached}: "))
    built = build_recovery_table([train_windows(reader)], loaded)
    save_recovery_table(cached, built, {"clips": len(index.refs), "vocabularies": files}, cached.name)
    return built


def _log_digests(reader: ClipReader, index: ClipIndex) -> list[str] | None:
    """Content digest of every log; None where the reader cannot tell them without reading the clips."""
    digest = getattr(reader, "digest", None)
    if digest is None:
        return None
    first_of_log = {ref.log_id: ref for ref in reversed(index.refs)}
    return [str(digest(first_of_log[log_id])) for log_id in sorted(first_of_log)]
