"""A city's tables on disk, in the user's cache: read from the GeoPackage once, then within a fraction of a second."""

import hashlib
import logging
import secrets
import zipfile
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factory.readers.nuplan_maps.geopackage import KEYS, LINES, NUMBERS, Table, read_geopackage
from tasks.caches import user_cache
from tasks.sealed import check, seal

log = logging.getLogger(__name__)

FORMAT = 2  # raise by hand whenever a GeoPackage gives other tables, or they are kept otherwise


class BadMapCache(ValueError):
    """A kept map is damaged or of another make."""


def kept_tables(path: Path) -> dict[str, Table]:
    """The tables of a GeoPackage, from the cache where it is in order. Raises BadClip, ImportError."""
    kept = cache_file(path)
    if kept.is_file():
        try:
            return load_tables(kept)
        except BadMapCache as error:
            log.warning("%s: %s; %s is read again", kept, error, path)
    tables = read_geopackage(path)
    save_tables(kept, tables)
    return tables


def cache_file(path: Path) -> Path:
    """Named by the GeoPackage's place, size and time of change, and by this format."""
    told = path.stat()
    name = f"{path.resolve()}|{told.st_size}|{told.st_mtime_ns}|{FORMAT}"
    return user_cache() / "maps" / f"{path.parent.parent.name}-{hashlib.sha256(name.encode()).hexdigest()[:16]}.npz"


def file_digest(path: Path) -> str:
    """sha256 of a GeoPackage, read once in a process and again where its size or time of change is another."""
    told = path.stat()
    return _digest_of(path.resolve(), told.st_size, told.st_mtime_ns)


@lru_cache(maxsize=8)
def _digest_of(path: Path, _size: int, _changed_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def save_tables(path: Path, tables: dict[str, Table]) -> None:
    """Whole or not at all."""
    arrays: dict[str, NDArray[np.generic]] = {"format": np.array(FORMAT)}
    for layer, table in tables.items():
        arrays[f"{layer}.fid"] = table.fid
        arrays |= {f"{layer}.{name}": column for name, column in table.columns.items()}
        arrays[f"{layer}.xy"] = table.xy
        arrays |= {f"{layer}.offsets{i}": offset for i, offset in enumerate(table.offsets)}
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with draft.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        seal(draft, path.name)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def load_tables(path: Path) -> dict[str, Table]:
    """Raises BadMapCache."""
    try:
        check(path, path.name)
        with np.load(path, allow_pickle=False) as stored:
            if int(stored["format"]) != FORMAT:
                raise BadMapCache(f"format {int(stored['format'])}, this version reads {FORMAT}")
            return {layer: _table(stored, layer) for layer in KEYS}
    except BadMapCache:
        raise
    except (OSError, zipfile.BadZipFile, KeyError, ValueError, IndexError, EOFError) as error:
        raise BadMapCache(f"damaged ({error})") from error


def _table(stored: np.lib.npyio.NpzFile, layer: str) -> Table:
    fid = stored[f"{layer}.fid"]
    columns = {name: stored[f"{layer}.{name}"] for name in (*KEYS[layer], *NUMBERS.get(layer, ()))}
    xy = stored[f"{layer}.xy"]
    offsets = tuple(stored[f"{layer}.offsets{i}"] for i in range(1 if layer in LINES else 2))
    sizes = [len(xy), *(len(offset) - 1 for offset in offsets)]
    ends = [int(offset[-1]) for offset in offsets]
    if sizes != [*ends, len(fid)] or any(len(column) != len(fid) for column in columns.values()):
        raise BadMapCache(f"layer {layer}: arrays of unequal length")
    return Table(fid, columns, xy, offsets)
