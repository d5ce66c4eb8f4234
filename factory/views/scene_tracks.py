"""Where a log had the vehicles of a scene, by the prepared clips of a run: a scene's file holds none of their poses."""

import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from factory.graph.steps import cache_key
from factory.pipeline import logged_clip
from factory.stages.scene_file import BadScene
from factory.store.cache import BadCacheFile
from tasks.render.scene.asset import BlockRange, RenderAsset
from tasks.render.scene.movers import world_from_boxes
from tasks.render.splatting.formats import LoggedVehicle
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S, Clip

if TYPE_CHECKING:
    from factory.store.samples import Store

SLACK_S = 0.5 * STEP_S


def logged_vehicles(store: "Store", asset: RenderAsset) -> tuple[list[LoggedVehicle], list[str]]:
    """The scene's vehicles with their poses as the log has them, on the scene's road; and the ids of those that no clip
    of the run shows within the scene's stretch of its log.

    Raises BadScene where the scene does not say which log it is of, where the run has no prepared clip of that, and
    where two ids make one token or a file of the cache is damaged.
    """
    if (block := asset.block) is None:
        raise BadScene("out=: the scene does not say which log it is of, so that no run has its vehicles' poses")
    seen: dict[str, dict[int, Array]] = {name: {} for name in asset.nodes}  # by time [ms] since the block's start
    found = False
    for clip in _clips_in(store, block):
        found = True
        _add(seen, clip, asset, block)
    if not found:
        stretch = f"{block.log_id}, {block.start_s:.1f} to {block.end_s:.1f} s"
        raise BadScene(f"{store.location.uri}: no prepared clip of log {stretch} in its cache")
    times_ms = sorted({time_ms for boxes in seen.values() for time_ms in boxes})
    known = [name for name, boxes in seen.items() if boxes]
    tokens = _tokens(known)
    times_s = block.start_s + 1e-3 * np.array(times_ms)
    vehicles = [
        LoggedVehicle(token, asset.nodes[name], times_s, _poses(seen[name], times_ms))
        for name, token in zip(known, tokens)
    ]
    return vehicles, [name for name in seen if name not in known]


def _clips_in(store: "Store", block: BlockRange) -> Iterator[Clip]:
    """Prepared clips of the block's log that overlap its stretch, as far as the cache has them still."""
    rows = store.candidates.read(["clip_id", "dataset", "log_id", "prepare_digest"]).to_pylist()
    for row in sorted(rows, key=lambda row: str(row["clip_id"])):
        if (row["dataset"], row["log_id"]) != (block.dataset, block.log_id):
            continue
        key = cache_key(row["clip_id"], row["prepare_digest"])
        try:
            clip = logged_clip(store.cache.load(key))
        except BadCacheFile as error:
            raise BadScene(f"{store.cache.location.uri}/{key}.npz: {error}; the next run makes it again") from error
        if clip is None:
            continue
        if clip.start_s < block.end_s and clip.start_s + clip.agents.n_steps * STEP_S > block.start_s:
            yield clip


def _add(seen: dict[str, dict[int, Array]], clip: Clip, asset: RenderAsset, block: BlockRange) -> None:
    """Of a clip's tracks those that are `seen` by now, their boxes (7,), within the block."""
    first_s, length_s = clip.start_s - block.start_s, block.end_s - block.start_s
    agents, origin = asset.settled(clip.agents, first_s), np.append(asset.origin, np.zeros(4))
    for j, name in enumerate(agents.track_ids):
        for k in np.flatnonzero(agents.valid[:, j]) if name in seen else ():
            time_s = first_s + k * STEP_S
            if -SLACK_S < time_s < length_s + SLACK_S:
                x, y, heading, length, width = agents.boxes[k, j]
                box = np.array([x, y, agents.center_z[k, j], heading, length, width, agents.heights[j]])
                seen[name][round(1e3 * time_s)] = box - origin


def _poses(boxes: dict[int, Array], times_ms: Sequence[int]) -> Array:
    """(F, 4, 4) of the boxes at these times; NaN where there is none."""
    poses = np.full((len(times_ms), 4, 4), np.nan)
    rows = [i for i, time_ms in enumerate(times_ms) if time_ms in boxes]
    poses[rows] = world_from_boxes(np.stack([boxes[times_ms[i]] for i in rows]))
    return poses


def _tokens(names: Sequence[str]) -> list[str]:
    """Names as WorldEngine takes them: it cuts at underscores, and a point would nest."""
    tokens = [re.sub(r"[^A-Za-z0-9-]", "-", name) for name in names]
    if len(set(tokens)) < len(tokens):
        raise BadScene(f"track ids {', '.join(names)}: two of them make the same token")
    return tokens
