"""One decorator for every compiled kernel: cached on disk, GIL released, no fastmath, no parallel reductions.

Numba's own cache does not notice an edit in a callee that lives in another file, so the cache folder is named by a
digest of all sources that hold kernels: one edit anywhere starts a new folder. NUMBA_CACHE_DIR, when set, is left alone.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])
_PACKAGES = ("tasks", "factory")


def kernel_sources() -> list[Path]:
    """Every source file that holds a kernel, sorted."""
    root = Path(__file__).resolve().parent.parent
    files = (path for package in _PACKAGES for path in (root / package).rglob("*.py"))
    return sorted(path for path in files if b"tasks.kernels import" in path.read_bytes())


def sources_digest() -> str:
    """16 hex digits over all kernel sources and numba's version."""
    sha = hashlib.sha256(numba.__version__.encode())
    for path in kernel_sources():
        sha.update(path.name.encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()[:16]


def cache_dir() -> Path:
    """Where the compiled kernels of exactly these sources are kept."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "driving-data-factory" / f"kernels-{sources_digest()}"


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(cache_dir())


def kernel(function: F) -> F:
    """Compile `function` with numba on first call."""
    compiled: F = numba.njit(cache=True, nogil=True)(function)
    return compiled
