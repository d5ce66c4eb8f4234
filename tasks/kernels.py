"""One decorator for every compiled kernel: cached on disk, GIL released, no fastmath, no parallel reductions.

None gets the entry for C programs that numba compiles by default: nobody calls it.

Numba's own cache does not notice an edit in a callee or of a constant that lives in another file, so the cache folder
is named by a digest of all sources that hold kernels or the constants of kernels: one edit anywhere starts a new
folder. NUMBA_CACHE_DIR, when set, is left alone.
"""

import ast
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

from tasks.caches import user_cache

F = TypeVar("F", bound=Callable[..., Any])
_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("tasks", "factory")
_MARKS = (b"tasks.kernels import", b"njit")


def kernel_sources(root: Path = _ROOT) -> list[Path]:
    """Every source file that holds a kernel, and every one that such a file takes a constant from, sorted."""
    files = (path for package in _PACKAGES for path in (root / package).rglob("*.py"))
    waiting = [path for path in files if any(mark in path.read_bytes() for mark in _MARKS)]
    found: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _constants_from(path, root)
    return sorted(found)


def _constants_from(path: Path, root: Path) -> list[Path]:
    imports = (node for node in ast.parse(path.read_bytes()).body if isinstance(node, ast.ImportFrom))
    named = (node.module for node in imports if node.module and any(alias.name.isupper() for alias in node.names))
    modules = (root.joinpath(*module.split(".")).with_suffix(".py") for module in named)
    return [module for module in modules if module.is_file()]


def sources_digest(root: Path = _ROOT) -> str:
    """16 hex digits over all kernel sources and numba's version."""
    sha = hashlib.sha256(numba.__version__.encode())
    for path in kernel_sources(root):
        sha.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()[:16]


def cache_dir() -> Path:
    """Where the compiled kernels of exactly these sources are kept."""
    return user_cache() / f"kernels-{sources_digest()}"


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(cache_dir())


def kernel(function: F) -> F:
    """Compile `function` with numba on first call."""
    compiled: F = numba.njit(cache=True, nogil=True, no_cfunc_wrapper=True)(function)
    return compiled


def inlined(function: F) -> F:
    """Compile `function` into each kernel that calls it, so that loops over it, or in it, vectorise.

    A division by zero gives inf or NaN in it, as in numpy: raising would need a branch. Python cannot call it: taking
    tuples of arrays from Python and giving them back would take longer to compile than the function.
    """
    compiled: F = numba.njit(
        cache=True,
        nogil=True,
        forceinline=True,
        error_model="numpy",
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
    )(function)
    return compiled


def inner_kernel(function: F) -> F:
    """Compile `function` for kernels to call: it counts no references to the arrays in its arguments.

    Numba counts them, atomically, wherever a tuple of arrays is handed on, which can cost more than the work. Such a
    function allocates nothing (it would not compile) and returns numbers only: an array it returned would be freed
    under its owner's hands.
    """
    compiled: F = numba.njit(cache=True, nogil=True, no_cfunc_wrapper=True, _nrt=False)(function)
    return compiled
