"""Checks a store from its files alone.

Damage is what must not be: a file of the log that is missing or fails its checksums, or whose own expert and round are
not those that the log says; a key twice, a round out of order, an episode that is not whole.
Orphans are harmless: files no commit names, left behind by a run that died, and episodes of rows that were replaced;
readers ignore them.
"""

from collections import defaultdict
from dataclasses import dataclass

import pyarrow.compute as pc

from factory.store.episodes import FOLDER, check_episode, episode_name
from factory.store.samples import IMPORTED, Store
from factory.store.table import KeyedTable, read_parquet


@dataclass(frozen=True)
class Verdict:
    """What verify found."""

    n_samples: int
    damage: tuple[str, ...]
    orphans: tuple[str, ...]  # relative to `out`


def verify(store: Store) -> Verdict:
    """Read every live file and episode with its checksums, and hold the tables against each other."""
    damage: list[str] = []
    orphans: list[str] = []
    for table in (store.samples, store.candidates, store.outcomes):
        damage += _damaged_files(table)
        live, name = table.live_files(), table.spec.name
        files = [file for file in table.location.names() if not file.startswith("_delta_log/")]
        orphans += [f"{name}/{file}" for file in files if file not in live]
    if damage:
        return Verdict(0, (*damage, "keys and rounds were not checked: fix the files first"), tuple(orphans))
    damage += _twice(store) + _broken_rounds(store)
    broken, outdated = _episodes(store)
    damage, orphans = damage + broken, orphans + outdated
    known = {run["settings_hash"] for run in store.runs()}
    for name in sorted(set(store.samples.read(["settings_hash"])["settings_hash"].to_pylist()) - known):
        damage.append(f"samples: settings_hash {name} is not in run.json")
    return Verdict(len(store.samples), tuple(damage), tuple(orphans))


def _damaged_files(table: KeyedTable) -> list[str]:
    found = []
    for path, partition in sorted(table.live_files().items()):
        try:
            table.read_file(path, partition)
            stated = read_parquet(table.location, path, list(partition))  # nothing in a file of a version before 0.2
        except OSError as error:
            found.append(str(error))
            continue
        for name in stated.column_names:
            values = sorted(map(str, pc.unique(stated[name]).to_pylist()))
            if values != [partition[name]]:
                found.append(f"{table.spec.name}/{path}: {name} is {', '.join(values)}, the log says {partition[name]}")
    return found


def _twice(store: Store) -> list[str]:
    found = []
    for table in (store.samples, store.candidates, store.outcomes):
        seen: set[str] = set()
        for path, rows in table.files([table.spec.key]):
            for key in rows[table.spec.key].to_pylist():
                if key in seen:
                    found.append(f"{table.spec.name}: {key} stands twice, again in {path}")
                seen.add(key)
    return found


def _broken_rounds(store: Store) -> list[str]:
    """Rounds of a walk count 0, 1, 2 ... in the order of its candidates. Of imported rows they are their source's."""
    imported = {run["settings_hash"] for run in store.runs() if IMPORTED in run["settings"]}
    walks: dict[tuple[str, str], list[tuple[int, int]]] = defaultdict(list)
    for row in store.samples.read(["clip_id", "expert", "candidate_index", "round", "settings_hash"]).to_pylist():
        if row["settings_hash"] not in imported:
            walks[row["clip_id"], row["expert"]].append((row["candidate_index"], row["round"]))
    return [
        f"samples: clip {clip_id}, expert {expert}: candidates and rounds {sorted(rows)}"
        for (clip_id, expert), rows in sorted(walks.items())
        if [number for _, number in sorted(rows)] != list(range(len(rows)))
    ]


def _episodes(store: Store) -> tuple[list[str], list[str]]:
    """Damaged episodes, and files beside them that are no episode of a row that is there."""
    folder = store.location.child(FOLDER)
    rows = store.samples.read(["attempt_id", "settings_hash", "stage_versions"]).to_pylist()
    live = {episode_name(row) for row in rows}
    damage, orphans = [], []
    for name in folder.names():
        if name not in live:
            orphans.append(f"{FOLDER}/{name}")
            continue
        try:
            check_episode(folder.read(name) or b"")
        except ValueError as error:
            damage.append(f"{FOLDER}/{name}: {error}; remove it, the command that made the run writes it again")
    return damage, orphans
