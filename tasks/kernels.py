"""One decorator for every compiled kernel: cached on disk, GIL released, no fastmath, no parallel reductions.

None gets the entry for C programs that numba compiles by default: nobody calls it.

Numba's own cache does not notice an edit in a callee or of a constant that lives in another file, and starts anew where
the same files lie in another folder, as every upload of a Ray job does. So compiled kernels lie in a folder named by a
digest of all sources that hold kernels or the constants of kernels, and in it by their place in the project: one edit
anywhere starts a new folder, a copy elsewhere starts none. Numba itself tells apart the processors that share a folder.
The folder lies in NUMBA_CACHE_DIR where that is set, else in the user's cache.
"""

import ast
import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import llvmlite.binding as llvm
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
    return Path(os.environ.get("NUMBA_CACHE_DIR") or user_cache()) / f"kernels-{_DIGEST}"


def machine() -> str:
    """What a compiled kernel runs on, beside its sources: 8 hex digits of Python's version and the processor's kind."""
    processor = llvm.get_host_cpu_name() + llvm.get_host_cpu_features().flatten()
    return hashlib.sha256(f"{sys.version_info[:2]} {processor}".encode()).hexdigest()[:8]


_DIGEST = sources_digest()


class KernelLocator:
    """Where numba keeps a function of this project, whatever folder the project lies in (NUMBA_CACHE_LOCATOR_CLASSES).

    The methods are those that numba.core.caching calls.
    """

    def __init__(self, line: int, inside: Path) -> None:
        self._line = line
        self._inside = inside

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> Self | None:
        """The locator of a function; None, so that numba asks its own, where the file is not this project's."""
        path = Path(file).resolve()
        if not any(path.is_relative_to(_ROOT / package) for package in _PACKAGES):
            return None
        locator = cls(function.__code__.co_firstlineno, path.relative_to(_ROOT).with_suffix(""))
        locator.ensure_cache_path()
        return locator

    def ensure_cache_path(self) -> None:
        """Raises OSError where the folder cannot be made."""
        Path(self.get_cache_path()).mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """A folder for each source file."""
        return str(cache_dir() / self._inside)

    def get_source_stamp(self) -> str:
        """What must be the same for a cached kernel to be used."""
        return _DIGEST

    def get_disambiguator(self) -> str:
        """Tells apart functions of one name in one file."""
        return str(self._line)


_NUMBAS_OWN = "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,IPythonCacheLocator,ZipCacheLocator"
numba.config.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelLocator.__name__},{_NUMBAS_OWN}"


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
