"""The recovery expert of a run: its table is built from the run's own clips and vocabularies where none is named."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from factory.config.compose import ConfigError, fill
from factory.config.run import RecoverySources
from factory.readers.base import ClipIndex, ClipReader
from factory.setup.settings import RunContext
from factory.setup.vocabulary import (
    build_recovery_table,
    load_recovery_table,
    load_vocabulary,
    save_recovery_table,
    train_windows,
)
from factory.store.schema import canonical_json
from tasks.caches import user_cache
from tasks.experts.recovery.expert import Recovery, RecoverySettings, RecoveryTable
from tasks.sealed import check
from tasks.stages import stage_versions

log = logging.getLogger(__name__)


def recovery(run: RunContext, **settings: Any) -> Recovery:
    """Of conf/expert/recovery.yaml. Raises ConfigError."""
    where = f"expert.{run.name}"
    sources = fill(RecoverySources, settings, where)
    chosen = RecoverySettings(sources.smooth, sources.weights, sources.feasible)
    if sources.table is None:
        return Recovery(_table_of(run, sources.vocabularies), chosen)
    if not Path(sources.table).is_file():
        raise ConfigError(f"{where}.table={sources.table}: there is no such file")
    if sources.vocabularies:
        raise ConfigError(f"{where}: give table or vocabularies; a finished table takes no more trajectories")
    return Recovery(load_recovery_table(sources.table), chosen)


def _table_of(run: RunContext, vocabularies: Sequence[str]) -> RecoveryTable:
    """Of all TRAIN windows and the vocabulary files, kept in the user's cache."""
    reader, index = run.clips()
    named = run.config.vocabulary.file
    files = [*vocabularies, *([named] if named else [])]
    loaded = [load_vocabulary(file) for file in dict.fromkeys(files)]
    digests = _log_digests(reader, index)
    if digests is None:
        return build_recovery_table([train_windows(reader)], loaded)
    chosen = dict(run.config.clips)  # where logs lie, and what splits them, decides which are train
    made_of = [stage_versions()["clip"], chosen, digests, sorted(ref.clip_id for ref in index.refs)]
    made_of.append([vocabulary.digest for vocabulary in loaded])
    key = hashlib.sha256(canonical_json(made_of).encode()).hexdigest()[:16]
    cached = user_cache() / "tables" / f"recovery-{key}.npz"
    if cached.is_file():
        try:
            check(cached, cached.name)
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
