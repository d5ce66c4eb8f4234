"""The settings of a run, typed, and the run they make: reader, vocabulary, experts, work."""

import dataclasses
import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factory.config.compose import ConfigError, build
from factory.config.run import RecoverySources, RunConfig, VocabularyChoice, recovery_settings, refuse_relative_root
from factory.graph.work import BENCHMARK, FOLLOW_UP_BEFORE, HUMAN
from factory.readers.base import BadClip, ClipIndex, ClipReader
from factory.setup.vocabulary import (
    build_recovery_table,
    load_recovery_table,
    load_vocabulary,
    save_recovery_table,
    train_windows,
)
from factory.stages.pipeline import FactoryWork
from factory.stages.sensors import chosen_cameras
from factory.store.identity import UNLISTED, RunIdentity, canonical_json
from tasks.caches import user_cache
from tasks.experts.follow_up import FollowUp
from tasks.experts.human import Human
from tasks.experts.pdm_closed.planner import PdmClosed, PdmSettings
from tasks.experts.protocol import Expert
from tasks.experts.recovery.expert import Recovery, RecoveryTable
from tasks.render.fit.settings import REMOVED
from tasks.render.rigs import RIGS
from tasks.render.scene import engine
from tasks.render.settings import RenderMode
from tasks.render.splatting.gsplat_backend import BackendMissing
from tasks.reward.labels import Labelling
from tasks.stages import stage_versions
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vocabulary import Vocabulary

KINEMATIC_K = 1024
RIGS_LOOKED_AT = 3  # clips, for the names of their cameras
KINDS = (
    "human",
    "pdm_closed",
    "recovery",
    "logged",
    "human_before",
    "follow_up",
    "follow_up_before",
)  # of built-in experts
ABSENT = object()
# Settings that came later: at what held before there was a choice they are left out, so that older tables go on.
ADDED: dict[str, object] = {"perturb.interleaved": True, "perturb.order": "drawn", "perturb.at_most": None}


@dataclass(frozen=True)
class Run:
    """A configured run: what to read and what to do with it."""

    config: RunConfig
    reader: ClipReader
    index: ClipIndex
    work: FactoryWork


def open_reader(clips: Mapping[str, Any]) -> tuple[ClipReader, ClipIndex]:
    """The reader of the chosen clips, and what its root holds. Raises ConfigError where that is nothing."""
    reader: ClipReader = build(clips, "clips")
    _must_have(reader, ("name", "index", "read"), "clips", "a reader (factory.readers.base.ClipReader)")
    try:
        index = reader.index()
    except (ValueError, OSError) as error:
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
    try:
        engine.check(config.render.backend)
    except BackendMissing as error:
        raise ConfigError(str(error)) from error


def assemble(config: RunConfig) -> Run:
    """Open the reader, load the vocabulary, prepare the experts. Raises ConfigError with what to mend."""
    refuse_relative_root(config.clips)
    refuse_missing_backend(config)
    try:  # what takes no clips comes first
        vocabulary = choose_vocabulary(config.vocabulary)
        labelling = choose_labelling(config, vocabulary)
        refuse_wrong_recovery(config)
        reader, index = open_reader(config.clips)
        refuse_unknown_cameras(config, reader, index)
        experts = {name: build_expert(name, config, reader, index, vocabulary) for name in config.experts}
    except ValueError as error:
        raise error if isinstance(error, ConfigError) else ConfigError(str(error)) from error
    work = FactoryWork(
        reader=reader,
        broken=index.broken,
        vocabulary=vocabulary,
        experts=experts,
        perturb=config.perturb,
        traffic=config.traffic,
        pdm=config.pdm,
        gate=config.reward,
        labelling=labelling,
        render=config.render,
        seed=config.seed,
        identity=identity_of(config, vocabulary, labelling),
        cache_dir=cache_folder(config),
    )
    return Run(config, reader, index, work)


def refuse_wrong_recovery(config: RunConfig) -> None:
    """Raises ConfigError for settings that a recovery expert does not take, and for a table that is not there."""
    for name in config.experts:
        if config.expert[name].get("kind") == "recovery":
            sources, _ = recovery_settings(config, name)
            if sources.table is not None and not Path(sources.table).is_file():
                raise ConfigError(f"expert.{name}.table={sources.table}: there is no such file")


def refuse_unknown_cameras(config: RunConfig, reader: ClipReader, index: ClipIndex) -> None:
    """Raises ConfigError where render.cameras names one that the rig of the first readable clip with cameras lacks.

    Rigs that differ from log to log are told apart by the attempts themselves.
    """
    wanted = config.render.cameras
    if not wanted or config.render.mode is RenderMode.NONE:
        return
    for ref in index.refs[:RIGS_LOOKED_AT]:
        try:
            rig = reader.read(ref).cameras
        except BadClip:
            continue
        if not rig and config.render.mode is RenderMode.MAP:
            rig = RIGS[config.render.map_rig]
        if rig:
            chosen_cameras(rig, wanted)
            return


def choose_vocabulary(choice: VocabularyChoice) -> Vocabulary:
    """The file's trajectories, or the kinematic vocabulary where no file is named."""
    if choice.file is not None:
        return load_vocabulary(choice.file, choice.k)
    return Vocabulary(kinematic_trajectories(choice.k or KINEMATIC_K, seed=0), source="kinematic")


def choose_labelling(config: RunConfig, vocabulary: Vocabulary) -> Labelling | None:
    """What samples are labelled with, None for nothing. Raises ValueError that names a vocabulary file."""
    if config.reward.labels == "none":
        return None
    named = config.reward.label_vocabulary
    chosen = vocabulary if named is None else load_vocabulary(named)
    return Labelling(chosen, dataclasses.replace(config.traffic, mode=config.reward.traffic))


def build_expert(name: str, config: RunConfig, reader: ClipReader, index: ClipIndex, vocabulary: Vocabulary) -> Expert:
    """One of the built-in kinds, or a user's `_target_`. Raises ConfigError for what the expert does not take."""
    spec, where = dict(config.expert[name]), f"expert.{name}"
    match spec.pop("kind", None):
        case "human" | "human_before" | "logged" | "pdm_closed" | "follow_up" | "follow_up_before" as kind:
            if spec:
                raise ConfigError(f"unknown setting {', '.join(f'{where}.{key}' for key in spec)}")
            return _without_settings(kind, config.pdm)
        case "recovery":
            sources, settings = recovery_settings(config, name)
            return Recovery(recovery_table(config, reader, index, sources), settings)
        case None:
            expert: Expert = build(spec, where, labels=())
            _must_have(expert, ("name", "digest", "plan"), where, "an expert (tasks.experts.protocol.Expert)")
            return expert
        case other:
            raise ConfigError(f"{where}.kind={other} is none of {', '.join(KINDS)}; or give _target_")


def _without_settings(kind: str, pdm: PdmSettings) -> Expert:
    match kind:
        case "human" | "human_before" | "logged":
            return Human(kind)
        case "pdm_closed":
            return PdmClosed(pdm)
        case _:
            return FollowUp(pdm, before=kind == FOLLOW_UP_BEFORE)


def _must_have(plugged: object, members: Sequence[str], where: str, what: str) -> None:
    missing = [member for member in members if not hasattr(plugged, member)]
    if missing:
        raise ConfigError(f"{where}: {type(plugged).__name__} is not {what}: it has no {', '.join(missing)}")


def recovery_table(config: RunConfig, reader: ClipReader, index: ClipIndex, sources: RecoverySources) -> RecoveryTable:
    """The named table, else one of all TRAIN windows and the vocabulary files, kept in the user's cache."""
    if sources.table is not None:
        if sources.vocabularies:
            raise ConfigError(
                "expert.recovery: give table or vocabularies; a finished table takes no more trajectories"
            )
        return load_recovery_table(sources.table)
    files = [*sources.vocabularies, *([config.vocabulary.file] if config.vocabulary.file else [])]
    loaded = [load_vocabulary(file) for file in dict.fromkeys(files)]
    digests = log_digests(reader, index)
    if digests is None:
        return build_recovery_table([train_windows(reader)], loaded)
    made_of = [stage_versions()["clip"], digests, sorted(ref.clip_id for ref in index.refs), [v.digest for v in loaded]]
    key = hashlib.sha256(canonical_json(made_of).encode()).hexdigest()[:16]
    cached = user_cache() / "tables" / f"recovery-{key}.npz"
    if cached.is_file():
        return load_recovery_table(cached)
    built = build_recovery_table([train_windows(reader)], loaded)
    save_recovery_table(cached, built, {"clips": len(index.refs), "vocabularies": files})
    return built


def log_digests(reader: ClipReader, index: ClipIndex) -> list[str] | None:
    """Content digest of every log; None where the reader cannot tell them without reading the clips."""
    digest = getattr(reader, "digest", None)
    if digest is None:
        return None
    first_of_log = {ref.log_id: ref for ref in reversed(index.refs)}
    return [str(digest(first_of_log[log_id])) for log_id in sorted(first_of_log)]


def identity_of(config: RunConfig, vocabulary: Vocabulary, labelling: Labelling | None) -> RunIdentity:
    """What the rows depend on besides clip, candidate and expert. Where data lies and who works on it is not in it."""
    science: dict[str, Any] = {
        "perturb": config.perturb,
        "traffic": config.traffic,
        "pdm": config.pdm,
        "reward": config.reward,
        "render": config.render,
    }
    settings: dict[str, object] = {"seed": config.seed, "vocabulary": vocabulary.digest}
    for group, value in science.items():
        settings |= {f"{group}.{key}": plain for key, plain in dataclasses.asdict(value).items()}
    settings["render.fit"] = dataclasses.asdict(config.render.fit) | REMOVED
    settings = {key: plain for key, plain in settings.items() if plain != ADDED.get(key, ABSENT)}
    settings["reward.label_vocabulary"] = None if labelling is None else labelling.vocabulary.digest
    versions = stage_versions()
    early: dict[str, object] = {
        key: value for key, value in settings.items() if not key.startswith(("reward.", "render."))
    }
    stages = ["clip", "perturb", "rollout", "expert", "reward"]
    if config.render.refuses_blocks:  # then the block's verdict is part of what is prepared
        early |= {key: value for key, value in settings.items() if key.startswith("render.")}
        stages.append("render")
    made_of: list[object] = [early, {stage: versions[stage] for stage in stages}]
    if set(config.experts) & BENCHMARK:  # then a prepared clip has its earlier frame
        made_of.append("earlier frame")
    prepared = canonical_json(made_of)
    digest = hashlib.sha256(prepared.encode()).hexdigest()[:16]
    return RunIdentity(settings, versions, vocabulary.digest, UNLISTED if set(config.experts) == {HUMAN} else digest)


def cache_folder(config: RunConfig) -> str:
    """Where blocks and tables are kept: beside the run's tables when `out` is a folder, else in the user's cache."""
    if "://" in config.out:
        return str(user_cache() / "assets")
    return str(Path(config.out).absolute() / "cache")
