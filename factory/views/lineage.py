"""Where an attempt comes from: run, clip, candidate, attempt, sample, with digests, versions and files."""

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from factory.config.arguments import Refused
from factory.views.status import rows_where, to_the_side, turned

if TYPE_CHECKING:
    from factory.store.samples import Store
    from factory.store.table import KeyedTable

Row = Mapping[str, Any]
Part = tuple[str, list[tuple[str, object]]]


def lineage(store: "Store", which: str) -> list[Part]:
    """The chain, part by part. Raises Refused where no attempt, or more than one, is meant."""
    from factory.store.samples import run_number_lookup

    attempt_id = _meant(store, which)
    is_sample = attempt_id in store.samples
    path, row = _row(store.samples if is_sample else store.outcomes, attempt_id)
    records = store.runs()
    number = run_number_lookup(records)(row)
    record = records[number] if number >= 0 else {}
    clip = _clip(store, row)
    parts = [("run", _run_facts(store, record, number, row)), ("clip", _clip_facts(store, row, clip))]
    if row["candidate_index"] >= 0:
        parts.append(("candidate", _candidate_facts(row, clip, record)))
    parts.append(("attempt", _attempt_facts(store, row)))
    parts.append(("sample", _sample_facts(store, row, path)) if is_sample else ("no sample", _fate(store, row, path)))
    return parts


def _meant(store: "Store", which: str) -> str:
    from factory.store.table import keys_with_prefix

    ids = store.samples.keys()
    if which.isascii() and which.isdecimal() and int(which) < len(ids):
        return ids[int(which)].decode()
    found = sorted({*keys_with_prefix(ids, which), *keys_with_prefix(store.outcomes.keys(), which)})
    if len(found) != 1:
        some = f": {', '.join(found[:8])}" if found else ""
        raise Refused(f"sample={which} is the beginning of {len(found)} attempts{some}")
    return found[0]


def _row(table: "KeyedTable", attempt_id: str) -> tuple[str, Row]:
    """The file it stands in, and the row without what is large."""
    large = {"images", "cameras", "label_subscores", "label_progress"}
    small = [f.name for f in table.spec.schema if f.name not in large and not f.name.startswith(("agent_", "lane_"))]
    return _found(table, attempt_id, small)


def _found(table: "KeyedTable", key: str, columns: Sequence[str]) -> tuple[str, Row]:
    """A key's file, and these columns of its row."""
    import pyarrow.compute as pc

    path = table.path_of(key)
    rows = table.read_file(path, table.live_files()[path], columns)
    return path, rows.filter(pc.equal(rows[table.spec.key], key)).to_pylist()[0]


def _clip(store: "Store", row: Row) -> Row:
    """The clip's row of candidates with its file, empty where it has none."""
    if row["clip_id"] not in store.candidates:
        return {}
    path, found = _found(store.candidates, row["clip_id"], store.candidates.spec.schema.names)
    return {**found, "file": path}


def _run_facts(store: "Store", record: Row, number: int, row: Row) -> list[tuple[str, object]]:
    versions = ", ".join(f"{stage} {version}" for stage, version in json.loads(row["stage_versions"]).items())
    return [
        ("settings", f"{row['settings_hash']}, record {number + 1} of {store.location.uri}/run.json"),
        ("stage versions", versions),
        ("vocabulary", record.get("vocabulary_digest")),
        ("seed", dict(record.get("settings", {})).get("seed")),
    ]


def _clip_facts(store: "Store", row: Row, clip: Row) -> list[tuple[str, object]]:
    from factory.graph.steps import cache_key

    cached = f"cache/prepared/{cache_key(row['clip_id'], clip['prepare_digest'])}.npz" if clip else ""
    start = row.get("clip_start_s")
    return [
        ("clip", row["clip_id"]),
        ("data set", row["dataset"]),
        ("log", row["log_id"] + (f" from {start:.1f} s" if start is not None else "")),
        ("split, licence", f"{row['split']}, {row['licence']}" if "split" in row else ""),
        ("content digest", row.get("content_digest") or clip.get("content_digest")),
        ("candidates", f"{clip['n_candidates']}, in candidates/{clip['file']}" if clip else "none listed"),
        ("prepared under", clip.get("prepare_digest")),
        ("prepared clip", cached if cached and store.location.has(cached) else ""),
    ]


def _candidate_facts(row: Row, clip: Row, record: Row) -> list[tuple[str, object]]:
    found = next((c for c in clip.get("candidates", ()) if c["index"] == row["candidate_index"]), None)
    facts: list[tuple[str, object]] = [("place in the list", row["candidate_index"])]
    if found is None:
        return facts
    x, y, heading, speed = (found[name] for name in ("end_x", "end_y", "end_heading", "end_speed"))
    return [
        *facts,
        _moved_by(found["vocabulary_index"], clip, record),
        ("ends", f"{x:+.2f} m along, {to_the_side(y)}, {turned(heading)}, at {speed:.2f} m/s"),
        ("grid cell", ", ".join(map(str, found["cell"]))),
        ("EPDMS", f"{found['score']:.3f} against log replay, {found['reactive_score']:.3f} among reacting agents"),
    ]


def _moved_by(index: int, clip: Row, record: Row) -> tuple[str, object]:
    """What perturbs the ego: a row of the vocabulary, or a start of the clip's own; or nothing does."""
    from tasks.world.vocabulary import FIRST_START, OF_LOG

    if index == OF_LOG:
        return "perturbed by", "nothing: the log itself"
    if index <= FIRST_START:
        starts = dict(record.get("settings", {})).get("perturb.starts")
        return "perturbed by", f"start {FIRST_START - index} of the clip in perturb.starts {starts}"
    return "vocabulary row", f"{index} of {clip['vocabulary_digest']}"


def _attempt_facts(store: "Store", row: Row) -> list[tuple[str, object]]:
    walk = {"clip_id": row["clip_id"], "expert": row["expert"]}
    earlier = [
        f"{o['candidate_index']} {o['kind']} by {o['stage']}.{o['reason']}".rstrip(".").removesuffix(" by ")
        for o in rows_where(store.outcomes, walk, ("candidate_index", "kind", "stage", "reason"))
        if 0 <= o["candidate_index"] < row["candidate_index"]
    ]
    return [
        ("attempt", row["attempt_id"]),
        ("expert", f"{row['expert']}, inputs {row['expert_digest']}" if row["expert"] else "the clip as a whole"),
        ("tried before it", "; ".join(sorted(earlier, key=lambda text: int(text.split()[0])))),
    ]


def _sample_facts(store: "Store", row: Row, path: str) -> list[tuple[str, object]]:
    from factory.store.episodes import EPISODES_FOLDER, episode_name

    labels = f"{row['label_vocabulary']}, traffic {row['label_traffic']}" if row["label_vocabulary"] else "none"
    episode = f"{EPISODES_FOLDER}/{episode_name(row)}"
    asset, psnr = row["asset_digest"], row["psnr"]
    return [
        ("round", row["round"]),
        ("scores", f"EPDMS {_score(row['stage1_score'])} perturbed, {_score(row['stage2_score'])} driven"),
        ("images", f"source {row['image_source']}"),
        ("scene", f"{asset}" + (f", {psnr:.2f} dB on held-out photos" if psnr is not None else "") if asset else ""),
        ("labels", labels),
        ("file", f"{store.samples.location.uri}/{path}"),
        ("table version", store.samples.version),
        ("episode", episode if store.location.has(episode) else ""),
    ]


def _fate(store: "Store", row: Row, path: str) -> list[tuple[str, object]]:
    return [
        ("became", row["kind"]),
        ("by", f"{row['stage']}.{row['reason']}".strip(".")),
        ("detail", row["detail"]),
        ("error", row["error"].strip().splitlines()[-1] if row["error"] else ""),
        ("file", f"{store.outcomes.location.uri}/{path}"),
    ]


def _score(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
