"""Writes the scenes of any reader's clips as a bank that training loops score plans on (docs/bank.md)."""

import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, Generic, TypeVar

from factory.files import atomic_file
from factory.graph.parallel import parallel_map
from factory.readers.base import BadClip, ClipReader, ClipRef
from tasks.bank import ANSWERING, BODY, FORMAT, pack_scene, read_head
from tasks.bank_traffic import pack_traffic
from tasks.caches import Damaged, json_with_checksum
from tasks.settings import TrafficSettings
from tasks.world.clip import Clip

T = TypeVar("T")
SHARD = 128  # scenes in a file, some 10 MB: what a worker takes at once, and what a killed one has to do again


@dataclass(frozen=True)
class PackedScene:
    """A scene's bytes, and the log's own name of its frame at T, where it has one that is not the clip's id."""

    data: bytes
    token: str | None = None
    traffic: bytes | None = None  # that answers, where the bank holds it


@dataclass(frozen=True)
class _Shard(Generic[T]):
    path: Path  # of its head
    wanted: Mapping[str, T]
    traffic: TrafficSettings | None

    def __str__(self) -> str:
        return str(self.path)


def write_bank(
    folder: str | Path,
    reader: ClipReader,
    refs: Sequence[ClipRef] | None = None,
    *,
    workers: int = 1,
    traffic: TrafficSettings | None = None,
) -> dict[str, str]:
    """Write the scenes at T of a reader's clips (None: all) to a folder; the same call goes on after an interruption.

    Returns clip id -> why, for clips that cannot be read or scored. workers: processes; above 1 they are spawned, which
    asks for a reader that pickles and a caller's module that may be imported. traffic: settings of mode idm, for
    traffic that answers to plans beside the log's; None: none is kept.
    Raises ValueError for another mode, Damaged where the folder holds a bank of other clips or traffic, and as
    `parallel_map`.
    """
    chosen = reader.index().refs if refs is None else refs
    wanted = {ref.clip_id: ref for ref in chosen}
    return write_clips(folder, reader.read, wanted, workers=workers, traffic=traffic)


def write_clips(
    folder: str | Path,
    read: Callable[[T], Clip],
    wanted: Mapping[str, T],
    *,
    workers: int = 1,
    traffic: TrafficSettings | None = None,
) -> dict[str, str]:
    """The same of clips by their ids; `read` makes one of what stands beside its id, or raises as a reader."""
    if traffic is not None and traffic.mode != "idm":
        raise ValueError(f"traffic is of mode {traffic.mode}: a bank's traffic is replayed, or answers by idm")
    return write_packed(folder, partial(_packed_clip, read, traffic), wanted, workers=workers, traffic=traffic)


def write_packed(
    folder: str | Path,
    pack: Callable[[T], PackedScene],
    wanted: Mapping[str, T],
    *,
    workers: int = 1,
    traffic: TrafficSettings | None = None,
) -> dict[str, str]:
    """The same of scenes that `pack` makes of what stands beside their ids, or raises BadClip or ValueError.

    traffic: settings of what every scene then holds of it.
    """
    named = list(wanted.items())
    shards = [
        _Shard(Path(folder) / f"scenes-{number:05}.json", dict(named[first : first + SHARD]), traffic)
        for number, first in enumerate(range(0, len(named), SHARD))
    ]
    there = [shard.path.exists() for shard in shards]
    left_out = {
        clip: why for shard, is_there in zip(shards, there) if is_there for clip, why in _left_of(shard).items()
    }
    missing = [shard for shard, is_there in zip(shards, there) if not is_there]
    at_once = max(1, min(workers, len(missing)))
    with closing(parallel_map(partial(_write_shard, pack), missing, workers=at_once)) as written:
        return left_out | {clip: why for left in written for clip, why in left.items()}


def _packed_clip(read: Callable[[T], Clip], traffic: TrafficSettings | None, one: T) -> PackedScene:
    clip = read(one)
    token = clip.frame_tokens[0] if clip.frame_tokens else None
    return PackedScene(pack_scene(clip), token, None if traffic is None else pack_traffic(clip, traffic))


def _left_of(shard: _Shard[T]) -> dict[str, str]:
    """What a written shard left out. Raises Damaged where it is of other clips or traffic."""
    head = read_head(shard.path)
    left: dict[str, str] = head["left_out"]
    settings = None if shard.traffic is None else asdict(shard.traffic)
    if shard.wanted.keys() != {*head["clip_ids"], *left} or settings != head.get("traffic", {}).get("settings"):
        raise Damaged(f"{shard.path}: a bank of other clips or traffic: choose another folder, or remove it")
    return left


def _write_shard(pack: Callable[[T], PackedScene], shard: _Shard[T]) -> dict[str, str]:
    scenes, left_out = dict[str, PackedScene](), dict[str, str]()
    for clip_id, one in shard.wanted.items():
        try:
            scenes[clip_id] = pack(one)
        except (BadClip, ValueError) as error:
            left_out[clip_id] = str(error)
    write_scenes(shard.path, scenes, left_out, shard.traffic)
    return left_out


def write_scenes(
    path: Path, scenes: Mapping[str, PackedScene], left_out: Mapping[str, str], traffic: TrafficSettings | None = None
) -> None:
    """A shard of scenes by clip id: the head `scenes-<number>.json`, and the bytes beside it.

    traffic: settings of what every scene holds of it.
    """
    tokens = {scene.token: clip_id for clip_id, scene in scenes.items() if scene.token is not None}
    head = {"format": FORMAT, "clip_ids": list(scenes)}
    head |= _write_body(path.with_suffix(BODY), [scene.data for scene in scenes.values()])
    head |= {"left_out": dict(left_out), "tokens": tokens}
    if traffic is not None:
        body = _write_body(path.with_suffix(ANSWERING), [scene.traffic or b"" for scene in scenes.values()])
        head["traffic"] = {"settings": asdict(traffic)} | body
    with atomic_file(path, 100 * len(scenes)) as draft:  # last: a shard with a head is whole
        draft.write_text(json_with_checksum(head))


def _write_body(path: Path, scenes: Collection[bytes]) -> dict[str, Any]:
    ends = [*accumulate(map(len, scenes), initial=0)]
    with atomic_file(path, ends[-1]) as draft, draft.open("wb") as file:
        file.writelines(scenes)
    return {"ends": ends, "crc32": [zlib.crc32(data) for data in scenes]}
