"""One sample in words: which is meant, its numbers, its labels, the log's own drive."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from factory.config.arguments import Refused
from factory.views.status import fate, rows_where

if TYPE_CHECKING:
    from factory.graph.steps import PreparedClip
    from factory.store.reader import SampleTable
    from factory.store.samples import Store
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


def find(table: "SampleTable", store: "Store", which: str) -> str:
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
        raise Refused(fate(rows_where(store.outcomes, {"attempt_id": dropped[0]})[0]))
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
    yield f"labels        {len(labels):,} trajectories of vocabulary {labels.vocabulary}, traffic {labels.traffic}"
    above = (scores > 0.0).mean()
    yield f"              EPDMS {scores.max():.3f} at best, {scores.mean():.3f} on average, {above:.0%} above 0"
    if not drawn:
        yield "              vocabulary=<its .npy> draws them"


def logged_drive(store: "Store", row: dict[str, Any]) -> "Array | None":
    """(81, 3) the log from T to T+2H, world frame, from the prepared clip; None where the cache has it no more."""
    from factory.graph.steps import cache_key
    from factory.pipeline import logged_poses
    from factory.store.location import BadCacheFile

    digests = {run["settings_hash"]: run["prepare_digest"] for run in store.runs()}
    if row["settings_hash"] not in digests:
        return None
    try:
        return logged_poses(store.cache.load(cache_key(row["clip_id"], digests[row["settings_hash"]])))
    except BadCacheFile:
        return None


def prepared_episode(row: Mapping[str, Any], prepared: "PreparedClip") -> bytes:
    """The sample as one MCAP file, with the log's drive from its prepared clip; for workers of a run."""
    from factory.pipeline import logged_poses
    from factory.views.episode_messages import episode_of

    return episode_of(row, logged_poses(prepared))


def number_lines(row: dict[str, Any]) -> Iterable[str]:
    """A sample's numbers, without what is large."""
    from factory.views.status import to_the_side, turned
    from tasks.subscores import SUBSCORES

    yield f"sample        {row['attempt_id']}"
    yield f"clip          {row['clip_id']}, {row['dataset']} log {row['log_id']} at {row['clip_start_s']:.1f} s"
    yield f"              split {row['split']}, licence {row['licence'] or '-'}"
    yield f"expert        {row['expert']}, round {row['round']}, candidate {row['candidate_index']}"
    vx, vy, ax, ay = row["ego_status"]
    yield f"ego           {vx:.2f}, {vy:.2f} m/s; {ax:.2f}, {ay:.2f} m/s2; command {row['command']}"
    if row["candidate_end"] is not None:
        x, y, heading, speed = row["candidate_end"]
        yield f"perturbed by  {x:+.2f} m along, {to_the_side(y)}, {turned(heading)}, at {speed:.2f} m/s"
    x, y, heading = row["label_10hz"][-1]
    yield f"label         ends {x:+.2f} m ahead, {to_the_side(y)}, turned {turned(heading)} after 4 s"
    images, source = row["images"] or (), row["image_source"]
    cameras = ", ".join(dict.fromkeys(image["camera"] for image in images))
    tags = ", ".join(row["tags"]) or "-"
    yield f"world         {len(row['agent_ids'])} agents, {len(row['lane_ids'])} lanes; tags {tags}"
    yield f"images        {len(images)} from source {source}" + (f": {cameras}" if cameras else "")
    if row["psnr"] is not None:
        yield f"block         {row['psnr']:.2f} dB"
    yield f"scores        {'':11}" + "".join(f"{name:>7}" for name in (*SUBSCORES, "EPDMS"))
    for prefix, title in (("stage1", "perturbed"), ("stage2", "driven")):
        values = [row[f"{prefix}_{name}"] for name in (*SUBSCORES, "score")]
        if any(value is not None for value in values):
            texts = ("-" if value is None else f"{value:.3f}" for value in values)
            yield f"              {title:<11}" + "".join(f"{text:>7}" for text in texts)
