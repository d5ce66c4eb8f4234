"""One stage of a finished run made again: whose settings changed, what refuses it, what of the old rows still holds.

A remake is a redo (factory.graph.plan) whose attempts take over what their stage did not change: a rejection, the
pictures, the labels. The rows that it replaces stay in their files, and run.json names the versions they are read at.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory.config.run import RemadeStage
from factory.exits import INTERRUPTED
from factory.store.reader import SampleTable
from factory.store.samples import REMADE, ChangedRun, Kind, Store, imported_from, record_differences
from factory.store.schema import BOOKKEEPING, COLUMNS, LABEL_COLUMNS, SCHEMA, RunIdentity, canonical_json
from factory.store.table import distinct_texts, fixed_bytes
from factory.store.verify import claim_for_upkeep, refuse_while_running
from tasks.stages import Rejected

LABEL_SETTINGS = ("reward.labels", "reward.label_vocabulary")
# Of the tables: else a checkpoint tidies the log of old versions away, and any program's VACUUM their files.
KEPT = dict.fromkeys(("delta.logRetentionDuration", "delta.deletedFileRetentionDuration"), "interval 36500 days")
# What drawing a sample may write; its `tags` it adds to those of the scene.
PICTURE_COLUMNS = (
    *("cameras", "images", "image_source", "cameras_left_out", "psnr", "asset_digest"),
    *("world_from_ego", "agent_center_z"),
)
DRIVEN_COLUMNS = tuple(
    name for name in SCHEMA.names if name not in (*BOOKKEEPING, *PICTURE_COLUMNS, *LABEL_COLUMNS, "tags")
)


def stage_of_change(change: str) -> RemadeStage | None:
    """Which stage a line of `record_differences` is of; None: of the drives or what they start from."""
    name = change.partition(":")[0]
    if name.startswith("render.") or name == "stage version render":
        return "render"
    if name in LABEL_SETTINGS:
        return "label"
    return "gate" if name.startswith("reward.") else None


class EarlierRows:
    """The rows of a table as they were, asked by the attempts of a remake for what the `changed` stages leave as it is.

    Some 100 bytes a sample and 300 a rejection, in each process.
    """

    def __init__(self, store: Store, versions: Mapping[str, int], changed: Sequence[str]) -> None:
        self.changed = frozenset(changed)
        self._samples = SampleTable(store.location.uri, store.location.options, versions["samples"])
        lists = store.candidates.at(versions["candidates"]).read(["clip_id", "content_digest"])
        self._content = dict(zip(lists["clip_id"].to_pylist(), lists["content_digest"].to_pylist()))
        columns = ["attempt_id", "kind", "stage", "reason", "detail", "subscores"]
        fell = store.outcomes.at(versions["outcomes"]).read(columns)
        self._fell = fell.filter(pc.equal(fell["kind"], Kind.REJECTED)).sort_by("attempt_id").combine_chunks()
        self._keys = fixed_bytes(self._fell["attempt_id"])

    def is_of(self, clip_id: str, content_digest: str) -> bool:
        """Whether the rows of a clip were made from this content."""
        return self._content.get(clip_id) == content_digest

    def rejection(self, key: str) -> tuple[Rejected, dict[str, float]] | None:
        """Of an attempt: why, and its sub-scores; None where it was not rejected."""
        at = int(np.searchsorted(self._keys, key.encode()))
        if at == len(self._keys) or self._keys[at].decode() != key:
            return None
        (row,) = self._fell.slice(at, 1).to_pylist()
        return Rejected(row["stage"], row["reason"], row["detail"]), dict(row["subscores"])

    def is_settled(self, rejected: Rejected, driven: bool) -> bool:
        """Whether a rejection holds; driven: the same drive was made again, and passes the gate."""
        if rejected.stage == "render":
            return not self.changed & ({"render"} if driven else {"gate", "render"})
        return not driven and (rejected.stage != "reward" or "gate" not in self.changed)

    def kept_columns(self, key: str, row: Mapping[str, Any]) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
        """Pictures, with the `tags` they add, and labels of an attempt's sample; None: to be made.

        They hold where the sample was made of the very drive that `row` tells, in every bit of DRIVEN_COLUMNS.
        """
        if {"render", "label"} <= self.changed or not self._samples.keys_with_prefix(key):
            return None, None
        stored, own = self._samples.sample(key), list(row["tags"])
        tags = list(stored["tags"])
        if _driven_bytes(stored) != _driven_bytes(row) or tags[: len(own)] != own:
            return None, None
        pictures = {name: stored[name] for name in PICTURE_COLUMNS} | {"tags": tags[len(own) :]}
        labels = {name: stored[name] for name in LABEL_COLUMNS}
        return None if "render" in self.changed else pictures, None if "label" in self.changed else labels


def _driven_bytes(row: Mapping[str, Any]) -> bytes:
    arrays = [COLUMNS[name].to_arrow(row.get(name)) for name in DRIVEN_COLUMNS]
    return bytes(pa.record_batch(arrays, list(DRIVEN_COLUMNS)).serialize())


@dataclass(frozen=True)
class Remake:
    """What a run makes again, as run.json keeps it, and the rows that it takes over from."""

    record: Mapping[str, Any]  # stages; settings_hash of the rows that were; versions of the tables that hold them
    earlier: EarlierRows


def remade_text(record: Mapping[str, Any]) -> str:
    """A remake's record in words."""
    versions = ", ".join(f"{name} {number}" for name, number in record["versions"].items())
    return f"{', '.join(record['stages'])}; the rows as they were (settings {record['settings_hash']}): {versions}"


def plan_remake(
    store: Store,
    identity: RunIdentity,
    digests: Mapping[str, str],
    asked: Sequence[str],
    wanted: Mapping[str, int],
    clip_ids: Sequence[str],
) -> Remake | None:
    """Hold a run's settings against those of a finished one; None where all its rows are these settings' already.

    digests, wanted: expert -> digest of its inputs, samples of each clip. Claims the tables. Raises ChangedRun where
    it cannot be a remake of the stages `asked`, and what `claim_for_upkeep` does.
    """
    records = store.runs()
    if not records or imported_from(records):
        raise ChangedRun(f"{store.location.uri} holds no run: nothing can be made again")
    changes = record_differences(records[-1], store.checked_records(identity, digests, "redo")[-1])
    if changes:
        _refuse_other_stages(changes, asked)
        refuse_while_running(store)
        _refuse_unfinished(store, wanted, clip_ids)
        claim_for_upkeep(store)
        for table in store.tables:
            for name, value in KEPT.items():
                if table.properties.get(name) != value:
                    table.set_property(name, value)
        stages = sorted({str(stage_of_change(change)) for change in changes})
        versions = {table.spec.name: table.version for table in store.tables}
        record = {"stages": stages, "settings_hash": records[-1]["settings_hash"], "versions": versions}
    elif is_interrupted_remake(store):
        record = records[-1][REMADE]
        _refuse_other_stages(record_differences(records[-2], records[-1]), asked)
    else:
        return None
    return Remake(record, EarlierRows(store, record["versions"], record["stages"]))


def is_interrupted_remake(store: Store) -> bool:
    """Whether the newest record is a remake's and rows that it is to replace are still there."""
    records = store.runs()
    return bool(records) and REMADE in records[-1] and _key_of(records[-2]) in _made_under(store)


def _refuse_other_stages(changes: Sequence[str], asked: Sequence[str]) -> None:
    for change in changes:
        stage = stage_of_change(change)
        if stage is None:
            raise ChangedRun(f"{change}: the drives depend on it, so this is a new run: choose another out")
        if stage not in asked:
            raise ChangedRun(f"{change}: of {stage}, not {', '.join(asked)}: remake {stage} too, or leave it as it was")


def _made_under(store: Store) -> set[tuple[str, ...]]:
    """Settings hashes and stage versions of the rows."""
    names = ["settings_hash", "stage_versions"]
    tables = (table.read(names, encoded=True) for table in (store.samples, store.outcomes))
    return {made for rows in tables for made in distinct_texts(rows, names)[0]}


def _key_of(record: Mapping[str, Any]) -> tuple[str, ...]:
    return record["settings_hash"], canonical_json(record["stage_versions"])


def _refuse_unfinished(store: Store, wanted: Mapping[str, int], clip_ids: Sequence[str]) -> None:
    """Raises ChangedRun where the table is not all of one finished run, or more than what this one is to make."""
    where, newest = store.location.uri, store.newest_run()
    if _made_under(store) - {_key_of(store.runs()[-1])}:
        raise ChangedRun(f"{where} has rows of other settings: finish its redo or remake first, or choose another out")
    if newest.goes_on or newest.last.get("exit_code") == INTERRUPTED:
        raise ChangedRun(f"{where}: its run is not finished: give its own command again first")
    for plan in store.plans.read().to_pylist():
        for expert, n in plan["rounds"]:
            if (given := wanted.get(expert, 0)) < n:
                asks = f"rounds={n} of expert {expert}, this asks for {given}: a whole table is remade"
                raise ChangedRun(f"{where} was made with {asks}, give its experts and rounds")
        if gone := sorted(set(plan["clip_ids"]) - set(clip_ids)):
            asks = "put their logs back, or give the clips that it was made of"
            raise ChangedRun(f"{where}: {len(gone)} of its clips, as {gone[0]}, are not there: {asks}")
