"""Writes the scenes of any reader's clips as a bank that training loops score plans on (docs/bank.md)."""

import multiprocessing
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar

from factory.files import atomic_file
from factory.readers.base import BadClip, ClipReader, ClipRef
from tasks.bank import ANSWERING, BODY, FORMAT, pack_scene, read_head
from tasks.bank_traffic import pack_traffic
from tasks.caches import Damaged, json_with_checksum
from tasks.settings import TrafficSettings
from tasks.world.clip import Clip

T = TypeVar("T")
SHARD = 1024  # scenes in a file, some 80 MB; what an interrupted process has to do again at most


def write_bank(
    folder: str | Path,
    reader: ClipReader,
    refs: Sequence[ClipRef] | None = None,
    *,
    processes: int = 1,
    traffic: TrafficSettings | None = None,
) -> dict[str, str]:
    """Write the scenes at T of a reader's clips (None: all) to a folder; the same call goes on after an interruption.

    Returns clip id -> why, for clips that cannot be read or scored. processes: above 1 they are spawned, which asks for
    a reader that pickles and a caller's module that may be imported. traffic: settings of mode idm, for traffic that
    answers to plans beside the log's; None: none is kept.
    Raises ValueError for another mode, Damaged where the folder holds a bank of other clips or traffic.
    """
    chosen = reader.index().refs if refs is None else refs
    wanted = {ref.clip_id: ref for ref in chosen}
    return write_clips(folder, reader.read, wanted, processes=processes, traffic=traffic)


def write_clips(
    folder: str | Path,
    read: Callable[[T], Clip],
    wanted: Mapping[str, T],
    *,
    processes: int = 1,
    traffic: TrafficSettings | None = None,
) -> dict[str, str]:
    """The same of clips by their ids; `read` makes one of what stands beside its id, or raises as a reader."""
    if traffic is not None and traffic.mode != "idm":
        raise ValueError(f"traffic is of mode {traffic.mode}: a bank's traffic is replayed, or answers by idm")
    named = list(wanted.items())
    shards = [dict(named[first : first + SHARD]) for first in range(0, len(named), SHARD)]
    paths = [Path(folder) / f"scenes-{number:05}.json" for number in range(len(shards))]
    write = partial(_write_shard, read, traffic)
    if processes == 1:
        return {clip: why for left in map(write, paths, shards) for clip, why in left.items()}
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        return {clip: why for left in pool.map(write, paths, shards) for clip, why in left.items()}


def _write_shard(
    read: Callable[[T], Clip], traffic: TrafficSettings | None, path: Path, wanted: Mapping[str, T]
) -> dict[str, str]:
    settings = None if traffic is None else asdict(traffic)
    if path.exists():
        head = read_head(path)
        left: dict[str, str] = head["left_out"]
        if wanted.keys() != {*head["clip_ids"], *left} or settings != head.get("traffic", {}).get("settings"):
            raise Damaged(f"{path}: a bank of other clips or traffic: choose another folder, or remove it")
        return left
    scenes, left_out, tokens = dict[str, bytes](), dict[str, str](), dict[str, str]()
    answering: dict[str, bytes] = {}
    for clip_id, one in wanted.items():
        try:
            clip = read(one)
            scene = pack_scene(clip)
            if traffic is not None:
                answering[clip_id] = pack_traffic(clip, traffic)
            scenes[clip_id] = scene
        except (BadClip, ValueError) as error:
            left_out[clip_id] = str(error)
        else:
            if clip.frame_tokens is not None:
                tokens[clip.frame_tokens[0]] = clip_id
    write_scenes(path, scenes, left_out, tokens, None if traffic is None else (traffic, answering))
    return left_out


def write_scenes(
    path: Path,
    scenes: Mapping[str, bytes],
    left_out: Mapping[str, str],
    tokens: Mapping[str, str] | None = None,
    traffic: tuple[TrafficSettings, Mapping[str, bytes]] | None = None,
) -> None:
    """A shard of packed scenes by clip id: the head `scenes-<number>.json`, and the bytes beside it.

    tokens: the log's own name of a scene's frame at T -> clip id; traffic: that answers, in the scenes' order.
    """
    head = {"format": FORMAT, "clip_ids": list(scenes)} | _write_body(path.with_suffix(BODY), scenes.values())
    head |= {"left_out": dict(left_out), "tokens": dict(tokens or {})}
    if traffic is not None:
        settings, packed = traffic
        body = _write_body(path.with_suffix(ANSWERING), packed.values())
        head["traffic"] = {"settings": asdict(settings)} | body
    with atomic_file(path, 100 * len(scenes)) as draft:  # last: a shard with a head is whole
        draft.write_text(json_with_checksum(head))


def _write_body(path: Path, scenes: Collection[bytes]) -> dict[str, Any]:
    ends = [*accumulate(map(len, scenes), initial=0)]
    with atomic_file(path, ends[-1]) as draft, draft.open("wb") as file:
        file.writelines(scenes)
    return {"ends": ends, "crc32": [zlib.crc32(data) for data in scenes]}
