"""A store: the tables plans, candidates, samples and outcomes, the cache beside them, and what they say is done.

The sample commit is the truth. A group of results is committed in the order candidates, samples, outcomes, so that a
crash in between loses at most the outcomes, whose attempts the next run tries again with the same result.
"""

import json
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Literal

from factory.store.attempts import (
    CANDIDATES,
    OUTCOME_STATE,
    OUTCOMES,
    PLANS,
    SAMPLE_STATE,
    ClipCandidates,
    History,
    Outcome,
    candidates_table,
    history_of,
    listed_of,
    outcomes_table,
    plan_table,
)
from factory.store.cache import ClipCache
from factory.store.codes import both
from factory.store.location import Location
from factory.store.parquet_file import Shard, write_shard
from factory.store.schema import (
    LICENCES_PROPERTY,
    SAMPLES,
    SCHEMA_VERSION,
    UNLISTED,
    RunIdentity,
    canonical_json,
    why_other_schema,
)
from factory.store.table import KeyedTable
from tasks.sealed import MEMBER, sealed_json, unsealed_json

OnChange = Literal["stop", "keep", "redo"]
RUN_FILE = "run.json"
CURRENT_RUN = "current_run.json"  # what the newest run set out to do; over once last_run.json has its began_ms
LAST_RUN = "last_run.json"
IMPORTED = "import.source"  # a setting that tables of others' rows have, and no run
WAYS_OUT = "Go on with on_change=keep, replace with on_change=redo, or choose another out"
MADE_UNDER = ["attempt_id", "expert", "expert_digest", "settings_hash", "stage_versions"]


def imported_from(runs: Sequence[Mapping[str, Any]]) -> str | None:
    """Whose rows a table's are, by its records (Store.runs); None for those of a run."""
    return runs[-1]["settings"].get(IMPORTED) if runs else None


class ChangedRun(ValueError):
    """The run's settings, versions or expert inputs differ from the table's; the message says where."""


class OtherSchema(ChangedRun):
    """The tables are of another version of the schema; the message names both and says how to make them again."""


def refuse_other_schema(out: Location) -> None:
    """Raises OtherSchema by run.json alone, that of earlier versions without a checksum too; opens no table."""
    data = out.read(RUN_FILE)
    if data is None:
        return
    try:
        version = (unsealed_json(data) if f'"{MEMBER}"'.encode() in data else json.loads(data))["schema_version"]
    except (ValueError, KeyError, TypeError):  # damaged: who needs the records says so
        return
    if other := why_other_schema(out.uri, version):
        raise OtherSchema(other)


class Store:
    """One run's view of everything under `out`. Opening writes nothing, and raises OtherSchema before any table is."""

    def __init__(
        self, out: str | os.PathLike[str] | Location, storage_options: Mapping[str, str] | None = None
    ) -> None:
        self.location = out if isinstance(out, Location) else Location.parse(out, storage_options)
        refuse_other_schema(self.location)
        self.samples = KeyedTable(self.location.child("samples"), SAMPLES)
        self.candidates = KeyedTable(self.location.child("candidates"), CANDIDATES)
        self.outcomes = KeyedTable(self.location.child("outcomes"), OUTCOMES)
        self.plans = KeyedTable(self.location.child("plans"), PLANS)

    @property
    def tables(self) -> tuple[KeyedTable, ...]:
        """In the order in which they are written."""
        return self.plans, self.candidates, self.samples, self.outcomes

    @property
    def cache(self) -> ClipCache:
        return ClipCache(self.location.child("cache/prepared"))

    def agree(
        self, identity: RunIdentity, expert_digests: Mapping[str, str], on_change: OnChange
    ) -> list[dict[str, Any]]:
        """Hold the run against the newest record of run.json; the records as they are to be, with this run's as newest.

        A record's on_change says whether rows of older records may stand among its own ("keep"); its expert digests
        are those of all experts so far. Writes nothing. Raises ChangedRun where they differ, on_change is "stop" and
        there are samples; without one the run starts over.
        """
        for expert in expert_digests:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", expert):
                raise ChangedRun(f"expert {expert!r}: a name is letters, digits, _ and - (it becomes a folder)")
        for table in self.tables:
            if (lost := table.lost_commit()) is not None:
                where = f"{table.location.uri}: commit {lost} is gone from the table's log"
                raise ChangedRun(f"{where}; python -m factory verify out={self.location.uri} repair=true puts it back")
        records = self.runs()
        record: dict[str, Any] = {
            "settings": dict(identity.settings),
            "settings_hash": identity.settings_hash,
            "stage_versions": dict(identity.stage_versions),
            "vocabulary_digest": identity.vocabulary_digest,
            "prepare_digest": identity.prepare_digest,
            "expert_digests": dict(expert_digests),
            "on_change": on_change,
        }
        record = json.loads(canonical_json(record))
        if not records and (len(self.samples) or len(self.outcomes)):
            raise ChangedRun(
                f"{self.location.uri}: {RUN_FILE} is missing beside tables with rows; restore it or take another out"
            )
        if records:
            changes = differences(records[-1], record)
            if changes and on_change == "stop" and not len(self.samples):
                return [record]  # nothing stands on the settings that were: they were tried, found wrong and corrected
            if changes and on_change == "stop":
                raise ChangedRun(f"{self.location.uri} was made with other settings: {'; '.join(changes)}. {WAYS_OUT}")
            record["expert_digests"] = records[-1]["expert_digests"] | record["expert_digests"]
            if identity.prepare_digest == UNLISTED:  # lists of earlier runs stay what they are
                record["prepare_digest"] = records[-1]["prepare_digest"]
            if on_change == "stop":
                record["on_change"] = records[-1]["on_change"]
            if not changes:
                records = records[:-1]
        return [*records, record]

    def starts_over(self, records: Sequence[Mapping[str, object]]) -> bool:
        """Whether `records` of agree() take the place of settings that made no sample."""
        known = self.runs()
        return bool(known) and len(records) == 1 and bool(differences(known[-1], records[0]))

    def begin(self, records: Sequence[Mapping[str, object]]) -> bool:
        """The first writes of a run: fence off older runs, record its settings, tidy up after a crash.

        Of two runs the one that begins later wins: whatever the older has not committed by now it never will. Of runs
        that begin at once it is the one whose claim comes last in the log of candidates. True: another run committed
        something since this store was opened, so that what was known of it is out of date. Raises AnotherWriter.

        A run that starts over drops what became of attempts under the settings that were. A crash between two commits
        leaves a failed outcome beside the sample that its retry became; it goes. One that is newer than the sample of
        the same attempt, of a redo that failed, stays.
        """
        starts_over = self.starts_over(records)
        before = [set(table.live_files()) for table in self.tables]
        self.claim()
        moved = [set(table.live_files()) for table in self.tables] != before
        if starts_over:
            for table in (self.plans, self.candidates, self.outcomes):
                table.commit([], drop=list(table))
        if list(records) != self.runs():
            document = json.loads(canonical_json({"schema_version": SCHEMA_VERSION, "runs": list(records)}))
            self.location.write(RUN_FILE, sealed_json(document).encode())
        twice = {key.decode() for key in both(self.outcomes.keys(), self.samples.keys()).tolist()}
        if twice:
            age = run_number(records)
            samples, outcomes = (
                {
                    row["attempt_id"]: age(row)
                    for row in table.read(MADE_UNDER).to_pylist()
                    if row["attempt_id"] in twice
                }
                for table in (self.samples, self.outcomes)
            )
            self.outcomes.commit([], drop=[key for key in twice if outcomes[key] <= samples[key]])
        return moved

    def claim(self, create: bool = True) -> None:
        """Fence off every run that began earlier: it commits nothing any more. Raises AnotherWriter.

        create: tables that are not there yet; else they are left out.
        """
        tables = (self.candidates, self.plans, self.samples, self.outcomes)
        above = max(table.epoch for table in tables)  # which differ only where one was put back or made anew
        epoch = None
        for table in tables:
            if create or table.version is not None:
                epoch = table.claim(epoch, above)

    def runs(self) -> list[dict[str, Any]]:
        """The settings the rows were made with, oldest first. Raises ChangedRun for an unreadable run.json."""
        data = self.location.read(RUN_FILE)
        if data is None:
            return []
        try:
            return list(unsealed_json(data)["runs"])
        except (ValueError, KeyError, TypeError) as error:
            raise ChangedRun(f"{self.location.uri}/{RUN_FILE}: not readable: {error}") from error

    def began_ms(self, ended: bool = False) -> int:
        """When the newest run began, since 1970; ended: when that which ended last did. 0 where nothing says so."""
        try:
            return int(json.loads(self.location.read(LAST_RUN if ended else CURRENT_RUN) or b"{}").get("began_ms", 0))
        except (ValueError, TypeError, AttributeError):  # damaged: it is for people, and verify names it
            return 0

    def history(self, identity: RunIdentity, expert_digests: Mapping[str, str]) -> History:
        """Everything the tables know, samples winning over outcomes of the same attempt."""
        return history_of(
            self.outcomes.read(OUTCOME_STATE, encoded=True),
            self.samples.read(SAMPLE_STATE, encoded=True),
            listed_of(self.candidates),
            (identity.settings_hash, identity.versions_json),
            expert_digests,
        )

    def plan(self, rounds: Mapping[str, int], clip_ids: Sequence[str]) -> None:
        """Write down what a run sets out to do, expert -> samples of each clip; nothing where that is known already.

        Raises AnotherWriter.
        """
        rows = plan_table(rounds, clip_ids)
        if rows["plan_id"][0].as_py() not in self.plans:
            self.plans.commit([write_shard(self.plans.location, PLANS, rows)])

    def commit(
        self,
        candidates: Sequence[ClipCandidates],
        shards: Sequence[Shard],
        outcomes: Sequence[Outcome],
        replaced: Sequence[str] = (),
        unlisted: Sequence[str] = (),
        licences: Collection[str] = (),
    ) -> None:
        """Commit one group of results, in place of the rows of attempts `replaced` and the lists of clips `unlisted`.

        Raises DuplicateKey and AnotherWriter.
        """
        lists = [write_shard(self.candidates.location, CANDIDATES, candidates_table(candidates))] if candidates else []
        self.candidates.commit(lists, drop=[*unlisted, *(row.clip_id for row in candidates)])
        accepted = [key for shard in shards for key in shard.keys]
        self._note_licences(licences)
        self.samples.commit(shards, drop=replaced)
        # A failed outcome stands until its attempt succeeds: then it goes, and it never stands twice.
        files = [write_shard(self.outcomes.location, OUTCOMES, outcomes_table(outcomes))] if outcomes else []
        self.outcomes.commit(files, drop=[*accepted, *replaced, *(o.attempt_id for o in outcomes)])

    def _note_licences(self, licences: Collection[str]) -> None:
        """The table's own metadata names every licence of its rows, before the first such row is there."""
        known = self.samples.properties.get(LICENCES_PROPERTY, "")
        named = {line for line in (*known.split("; "), *licences) if line}
        if "; ".join(sorted(named)) != known:
            self.samples.set_property(LICENCES_PROPERTY, "; ".join(sorted(named)))


def run_number(records: Sequence[Mapping[str, Any]]) -> Callable[[Mapping[str, Any]], int]:
    """Of a row with the columns MADE_UNDER: the place of the newest record that it could be made under, -1 for none."""
    made: dict[tuple[str, str], list[tuple[int, Mapping[str, str]]]] = defaultdict(list)
    for number, record in enumerate(records):
        key = record["settings_hash"], canonical_json(record["stage_versions"])
        made[key].insert(0, (number, record["expert_digests"]))

    def of(row: Mapping[str, Any]) -> int:
        expert, digest = row["expert"], row["expert_digest"]
        found = made.get((row["settings_hash"], row["stage_versions"]), [])
        return next((number for number, digests in found if digests.get(expert, digest) == digest), -1)

    return of


def differences(old: Mapping[str, object], new: Mapping[str, object]) -> list[str]:
    """What differs between two records of run.json, in words; an expert that only one of them has is no difference."""
    found = []
    for part, word in (("settings", ""), ("stage_versions", "stage version "), ("expert_digests", "inputs of expert ")):
        a, b = dict(old[part]), dict(new[part])  # type: ignore[call-overload]
        names = sorted(set(a) & set(b)) if part == "expert_digests" else sorted(set(a) | set(b))
        missing = "not set"
        found += [
            f"{word}{n}: {a.get(n, missing)} -> {b.get(n, missing)}"
            for n in names
            if a.get(n, missing) != b.get(n, missing)
        ]
    for part, word in (("vocabulary_digest", "vocabulary"), ("prepare_digest", "what perturb depends on")):
        if (
            old[part] != new[part]
            and UNLISTED not in (old[part], new[part])
            and not (part == "prepare_digest" and found)
        ):
            found.append(f"{word}: {old[part]} -> {new[part]}")
    return found
