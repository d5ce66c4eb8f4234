"""One sample, or any other attempt, in words: which is meant, its numbers and labels, and where it comes from."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from factory.config.arguments import Refused
from factory.views.status import outcome_text, rows_where, side_text, turn_text
from tasks.world.repair.records import RepairCount, counts_text

if TYPE_CHECKING:
    from factory.graph.steps import PreparedClip
    from factory.store.reader import SampleTable
    from factory.store.samples import Store
    from factory.store.table import KeyedTable
    from tasks.world.arrays import Array


def open_samples(store: "Store") -> "SampleTable":
    """Its samples. Raises Refused where there are none, or they are of another schema version."""
    from factory.store.reader import SampleTable

    if not len(store.samples):
        raise Refused(f"{store.location.uri} holds no sample; python -m factory status shows why")
    try:
        return SampleTable(store.location.uri, store.location.options)
    except ValueError as error:
        raise Refused(str(error)) from error


def find_sample_id(table: "SampleTable", store: "Store", which: str) -> str:
    """The attempt_id meant by an ordinal, an id or the beginning of one. Raises Refused."""
    from factory.store.table import keys_with_prefix

    if which.isascii() and which.isdecimal() and int(which) < len(table):
        return str(table.sample(int(which), ("attempt_id",))["attempt_id"])
    found = table.keys_with_prefix(which)
    if len(found) == 1:
        return found[0]
    if found:
        raise Refused(f"sample={which} is the beginning of {len(found)} ids: {', '.join(found[:8])}")
    dropped = keys_with_prefix(store.outcomes.keys(), which)
    if len(dropped) == 1:
        raise Refused(outcome_text(rows_where(store.outcomes, {"attempt_id": dropped[0]})[0]))
    raise Refused(f"no sample {which}: ids begin otherwise, ordinals go from 0 to {len(table) - 1}; see list=true")


def labelled_trajectories(row: dict[str, Any], file: str | None) -> "Array | None":
    """(K, 40, 3) that the row's labels are of; None where they are of a file that was not named.

    Raises Refused where the named file holds others, or the row has no labels.
    """
    from factory.config.run import VocabularyChoice
    from factory.setup.settings import choose_vocabulary
    from factory.store.reader import labels_of

    if row["label_vocabulary"] is None and file is None:
        return None
    try:
        found = choose_vocabulary(VocabularyChoice(file, len(labels_of(row))))
    except ValueError as error:
        raise Refused(str(error)) from error
    if found.digest == row["label_vocabulary"]:
        return found.trajectories
    if file is not None:
        raise Refused(f"vocabulary={file} is {found.digest}, the sample's labels are of {row['label_vocabulary']}")
    return None


def label_lines(row: dict[str, Any], drawn: bool) -> Iterable[str]:
    """What its labels say; `drawn`: the picture shows them."""
    from factory.store.reader import labels_of

    if row["label_vocabulary"] is None:
        yield "labels        none"
        return
    labels = labels_of(row)
    scores = labels.pdm_score()
    which = f"vocabulary {labels.vocabulary}, traffic {row['label_traffic']}"
    yield f"labels        {len(labels):,} trajectories of {which}"
    above = (scores > 0.0).mean()
    yield f"              EPDMS {scores.max():.3f} at best, {scores.mean():.3f} on average, {above:.0%} above 0"
    if not drawn:
        yield "              vocabulary=<its .npy> draws them"


def logged_drive(store: "Store", clip_id: str, settings_hash: str) -> "Array | None":
    """(81, 3) the log from T to T+2H, world frame, from the prepared clip; None where the cache has it no more."""
    from factory.graph.steps import cache_key
    from factory.pipeline import cached_poses
    from factory.store.location import BadCacheFile

    digests = {run["settings_hash"]: run["prepare_digest"] for run in store.runs()}
    if settings_hash not in digests:
        return None
    try:
        return cached_poses(store.cache, cache_key(clip_id, digests[settings_hash]))
    except BadCacheFile:
        return None


def prepared_episode(row: Mapping[str, Any], prepared: "PreparedClip") -> bytes:
    """The sample as one MCAP file, with the log's drive from its prepared clip; for workers of a run."""
    from factory.pipeline import logged_poses
    from factory.views.episode_messages import episode_of

    return episode_of(row, logged_poses(prepared))


def sample_facts(row: Mapping[str, Any]) -> dict[str, str]:
    """What `show` and the sample's page say of it, without what is large."""
    vx, vy, ax, ay = row["ego_status"]
    facts = {"ego": f"{vx:.2f}, {vy:.2f} m/s; {ax:.2f}, {ay:.2f} m/s2; command {row['command']}"}
    if row["candidate_end"] is not None:
        x, y, heading, speed = row["candidate_end"]
        facts["perturbed by"] = f"{x:+.2f} m along, {side_text(y)}, {turn_text(heading)}, at {speed:.2f} m/s"
    x, y, heading = row["label_10hz"][-1]
    facts["label"] = f"ends {x:+.2f} m ahead, {side_text(y)}, turned {turn_text(heading)} after 4 s"
    if row["off_log_end"] is not None:
        metres, turn, mps = row["off_log_end"]
        facts["off the log"] = f"{metres:.2f} m, {math.degrees(turn):.1f} deg, {mps:.2f} m/s at the label's end"
    tags = ", ".join(row["tags"]) or "-"
    facts["world"] = f"{len(row['agent_ids'])} agents, {len(row['lane_ids'])} lanes; tags {tags}"
    images = row["images"] or ()
    cameras = ", ".join(dict.fromkeys(image["camera"] for image in images))
    if row["repairs"]:
        facts["repaired"] = counts_text(RepairCount(**count) for count in row["repairs"])
    facts["images"] = f"{len(images)} from source {row['image_source']}" + (f": {cameras}" if cameras else "")
    if row["psnr"] is not None:
        facts["block"] = f"{row['psnr']:.2f} dB"
    return facts


def sample_fact_lines(row: dict[str, Any]) -> Iterable[str]:
    """A sample's lineage, facts and scores."""
    from tasks.subscores import SUBSCORES

    yield f"sample        {row['attempt_id']}"
    yield f"clip          {row['clip_id']}, {row['dataset']} log {row['log_id']} at {row['clip_start_s']:.1f} s"
    yield f"              split {row['split']}, licence {row['licence'] or '-'}"
    yield f"expert        {row['expert']}, round {row['round']}, candidate {row['candidate_index']}"
    yield from (f"{name:<14}{value}" for name, value in sample_facts(row).items())
    yield f"scores        {'':11}" + "".join(f"{name:>7}" for name in (*SUBSCORES, "EPDMS"))
    for prefix, title in (("stage1", "perturbed"), ("stage2", "driven")):
        values = [row[f"{prefix}_{name}"] for name in (*SUBSCORES, "score")]
        if any(value is not None for value in values):
            texts = ("-" if value is None else f"{value:.3f}" for value in values)
            yield f"              {title:<11}" + "".join(f"{text:>7}" for text in texts)


# Where an attempt comes from: run, clip, candidate, attempt, sample, with digests, versions and files.

Row = Mapping[str, Any]
Part = tuple[str, list[tuple[str, object]]]


def lineage(store: "Store", which: str) -> list[Part]:
    """The chain, part by part. Raises Refused where no attempt, or more than one, is meant."""
    from factory.store.samples import run_number_lookup

    attempt_id = _find_attempt_id(store, which)
    is_sample = attempt_id in store.samples
    table = store.samples if is_sample else store.outcomes
    large = {"images", "cameras", "label_subscores", "label_progress"}
    small = [f.name for f in table.spec.schema if f.name not in large and not f.name.startswith(("agent_", "lane_"))]
    path, row = _file_and_row(table, attempt_id, small)
    records = store.runs()
    number = run_number_lookup(records)(row)
    record = records[number] if number >= 0 else {}
    clip: Row = {}  # of the table of candidates, with its file
    if row["clip_id"] in store.candidates:
        names = store.candidates.spec.schema.names
        file, clip = _file_and_row(store.candidates, row["clip_id"], names)
        clip = {**clip, "file": file}
    parts = [("run", _run_facts(store, record, number, row)), ("clip", _clip_facts(store, row, clip))]
    if row["candidate_index"] >= 0:
        parts.append(("candidate", _candidate_facts(row, clip, record)))
    parts.append(("attempt", _attempt_facts(store, row)))
    parts.append(
        ("sample", _sample_facts(store, row, path)) if is_sample else ("no sample", _outcome_facts(store, row, path))
    )
    return parts


def _find_attempt_id(store: "Store", which: str) -> str:
    from factory.store.table import keys_with_prefix

    ids = store.samples.keys()
    if which.isascii() and which.isdecimal() and int(which) < len(ids):
        return ids[int(which)].decode()
    found = sorted({*keys_with_prefix(ids, which), *keys_with_prefix(store.outcomes.keys(), which)})
    if len(found) != 1:
        some = f": {', '.join(found[:8])}" if found else ""
        raise Refused(f"sample={which} is the beginning of {len(found)} attempts{some}")
    return found[0]


def _file_and_row(table: "KeyedTable", key: str, columns: Sequence[str]) -> tuple[str, Row]:
    """A key's file, and these columns of its row."""
    import pyarrow.compute as pc

    path = table.path_of(key)
    rows = table.read_file(path, table.live_files()[path], columns)
    return path, rows.filter(pc.equal(rows[table.spec.key], key)).to_pylist()[0]


def _run_facts(store: "Store", record: Row, number: int, row: Row) -> list[tuple[str, object]]:
    from factory.store.remake import remade_text
    from factory.store.samples import REMADE

    versions = ", ".join(f"{stage} {version}" for stage, version in json.loads(row["stage_versions"]).items())
    return [
        ("settings", f"{row['settings_hash']}, record {number + 1} of {store.location.uri}/run.json"),
        ("stage versions", versions),
        ("vocabulary", record.get("vocabulary_digest")),
        ("seed", dict(record.get("settings", {})).get("seed")),
        ("remade", remade_text(record[REMADE]) if REMADE in record else ""),
    ]


def _clip_facts(store: "Store", row: Row, clip: Row) -> list[tuple[str, object]]:
    from factory.graph.steps import cache_key
    from factory.store.location import CLIP_SUFFIX

    cached = f"cache/prepared/{cache_key(row['clip_id'], clip['prepare_digest'])}{CLIP_SUFFIX}" if clip else ""
    start = row.get("clip_start_s")
    return [
        ("clip", row["clip_id"]),
        ("data set", row["dataset"]),
        ("log", row["log_id"] + (f" from {start:.1f} s" if start is not None else "")),
        ("split, licence", f"{row['split']}, {row['licence']}" if "split" in row else ""),
        ("content digest", row.get("content_digest") or clip.get("content_digest")),
        ("candidates", f"{clip['n_candidates']}, in candidates/{clip['file']}" if clip else "none listed"),
        ("repaired", counts_text(RepairCount(**count) for count in clip.get("repairs", ()))),
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
        _perturbation_fact(found["vocabulary_index"], clip, record),
        ("ends", f"{x:+.2f} m along, {side_text(y)}, {turn_text(heading)}, at {speed:.2f} m/s"),
        ("grid cell", ", ".join(map(str, found["cell"]))),
        ("EPDMS", f"{found['score']:.3f} against log replay, {found['reactive_score']:.3f} among reacting agents"),
    ]


def _perturbation_fact(index: int, clip: Row, record: Row) -> tuple[str, object]:
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


def _outcome_facts(store: "Store", row: Row, path: str) -> list[tuple[str, object]]:
    return [
        ("became", row["kind"]),
        ("by", f"{row['stage']}.{row['reason']}".strip(".")),
        ("detail", row["detail"]),
        ("error", row["error"].strip().splitlines()[-1] if row["error"] else ""),
        ("file", f"{store.outcomes.location.uri}/{path}"),
    ]


def _score(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
