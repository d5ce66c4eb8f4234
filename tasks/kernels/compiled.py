"""One decorator for every compiled kernel: cached on disk, GIL released, no fastmath, no parallel reductions.

None gets the entry for C programs that numba compiles by default: nobody calls it.

Numba's own cache does not notice an edit in a callee or of a constant that lives in another file, and starts anew where
the same files lie in another folder, as every upload of a Ray job does. So compiled kernels lie in a folder named by a
digest of all sources that hold kernels or the constants of kernels, and in it by their place in the project: one edit
anywhere starts a new folder, a copy elsewhere starts none. The folder lies in NUMBA_CACHE_DIR where that is set, else
in the user's cache. Whoever starts one removes those of other sources that have long been unused. Nothing of numba is
changed for other code.
"""

import hashlib
import io
import logging
import os
import pickle
import re
import secrets
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, lookup_environment
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numpy.typing import NDArray

from tasks.caches import Damaged, user_cache, with_checksum, without_checksum

F = TypeVar("F", bound=Callable[..., Any])
log = logging.getLogger(__name__)
_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = ("tasks", "factory")
_FOLDER = re.compile(r"(kernels-[0-9a-f]{16})(-[0-9a-f]{8})?")  # with the second part: being removed
UNUSED_S = 30 * 86_400.0  # after which a folder of other sources is removed
_MARKS = (b"tasks.kernels.compiled import", b"njit")
_IMPORT = re.compile(rb"^from ([\w.]+) import (\([^)]*\)|.*)", re.MULTILINE)


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
    """By the text: parsing the sources would take every process 0.2 s, and a word too many only adds a file."""
    imports = _IMPORT.findall(path.read_bytes())
    named = (module for module, names in imports if any(word.isupper() for word in re.findall(rb"\w+", names)))
    modules = (root.joinpath(*module.decode().split(".")).with_suffix(".py") for module in named)
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


def make_cache_dir() -> None:
    """cache_dir(), which is there then. Whoever makes it removes what is unused beside it. Raises OSError."""
    folder = cache_dir()
    try:
        folder.mkdir(parents=True)
    except FileExistsError:  # of processes that begin at once one makes it
        return
    remove_unused_caches(folder.parent)


def remove_unused_caches(caches: Path) -> None:
    """Remove the folders of kernels that no process has used for UNUSED_S; each process that uses one marks it.

    Marked and renamed first: nobody else removes it too, and who begins to use one at this moment finds it whole, or
    not at all and compiles.
    """
    for folder in caches.iterdir():
        ours = _FOLDER.fullmatch(folder.name)
        with suppress(OSError):  # another process is about it, or it is another user's
            if ours and time.time() - folder.stat().st_mtime > UNUSED_S:
                os.utime(folder)
                shutil.rmtree(folder.rename(caches / f"{ours[1]}-{secrets.token_hex(4)}"))


@cache
def processor_key() -> str:
    """What machine code is made for: Python's version, the system, the processor and what it can do."""
    return repr((sys.version_info[:2], cpu_target.target_context.codegen().magic_tuple()))


_DIGEST = sources_digest()
USED: set[Path] = set()  # files of compiled functions that this process has loaded or written


def _mark_used(path: Path) -> None:
    """Into USED; the process's first marks the folder as used now."""
    if not USED:
        with suppress(OSError):  # another user's, to read only
            os.utime(cache_dir())
    USED.add(path)


class KernelCache:
    """The compiled forms of one function on disk: a file for each, named by the types it takes and the processor.

    Numba's own cache keeps an index of them, which two processes that compile one function at once write over each
    other's, so that the index may name machine code for other types. Here a file is written whole and replaced by its
    like. The methods are those that numba's dispatcher calls.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        code = function.__code__
        self._source = Path(code.co_filename).resolve()
        self._module = function.__module__  # what is kept names it, and one file may be loaded under two names
        self._name = f"{function.__qualname__.replace('<locals>.', '')}-{code.co_firstlineno}"
        # Of a function inside another one, what it takes from there is compiled in.
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        self._enclosed = hashlib.sha256(code.co_code + (dumps(cells) if cells else b"")).hexdigest()

    @property
    def cache_path(self) -> str:
        """A folder for each source file; that of a file outside the project has its content in its name."""
        if any(self._source.is_relative_to(_ROOT / package) for package in _PACKAGES):
            return str(cache_dir() / self._source.relative_to(_ROOT).with_suffix(""))
        content = hashlib.sha256(self._source.read_bytes()).hexdigest()[:16]
        return str(cache_dir() / "elsewhere" / f"{self._module}-{content}")

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The form compiled for `signature`; None where there is none."""
        rtsys.initialize(target)  # all that machine code needs of numba; what compiling needs takes 0.4 s to load
        path = self._path(signature)
        try:
            kept = without_checksum(path.read_bytes(), _cache_key(path))
        except OSError:  # not there, or nobody's to read: compiled again, and save_overload says what is wrong
            return None
        except Damaged as error:
            log.warning("%s: %s; compiled again", path, error)
            return None
        _mark_used(path)
        return CompileResult._rebuild(target, *_Kept(io.BytesIO(kept)).load())

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep it; warn, once a process, where that cannot be done: then every process compiles for itself."""
        if compiled.library.has_dynamic_globals:  # addresses of this process
            return
        path = self._path(signature)
        try:
            make_cache_dir()
            write_whole(path, with_checksum(dumps(compiled._reduce()), _cache_key(path)))
        except OSError as error:
            warnings.warn(cache_write_error(error), RuntimeWarning, stacklevel=1)
            return
        _mark_used(path)

    def _path(self, signature: Any) -> Path:
        takes = f"{signature} {processor_key()} {self._enclosed}"
        return Path(self.cache_path) / f"{self._name}-{hashlib.sha256(takes.encode()).hexdigest()[:16]}.kernel"

    def flush(self) -> None:
        """Forget every form of the function."""
        for path in Path(self.cache_path).glob(f"{self._name}-*.kernel"):
            path.unlink(missing_ok=True)


class _Kept(pickle.Unpickler):
    """Reads what save_overload wrote; of numba's functions that are compiled in not even the modules are loaded."""

    def find_class(self, module: str, name: str) -> Any:
        is_environment = (module, name) == ("numba.core.environment", "_rebuild_env")
        return _environment if is_environment else super().find_class(module, name)


def _environment(module: str, constants: list[Any], name: str) -> Environment:
    """The objects that a function's machine code refers to, as numba makes it again but for the module's globals.

    Machine code that never calls the interpreter asks for none of them; those of numba's arrays take 0.15 s to load.
    """
    found = lookup_environment(name)
    if found is None:
        found = Environment(vars(sys.modules[module]) if module in sys.modules else {"__name__": module})
        found.consts[:], found.env_name = constants, name
        Environment._memo[name] = found
    return found


def _cache_key(path: Path) -> str:
    """A kernel's file by its place in the cache: another one's machine code is not run for it."""
    return path.relative_to(cache_dir()).as_posix()


def write_whole(path: Path, data: bytes) -> None:
    """Under its name at once, or not at all. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        draft.write_bytes(data)
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise


def cache_write_error(error: OSError) -> str:
    """What to say where the cache folder cannot be written."""
    why = error.strerror or str(error)
    return f"compiled kernels cannot be kept in {cache_dir()} ({why}): name a folder with free space in NUMBA_CACHE_DIR"


def read_only(array: NDArray[Any], dtype: type = np.float64) -> NDArray[Any]:
    """A contiguous array that may not be written: one compiled kernel serves those of a shared store and others."""
    view: NDArray[Any] = np.ascontiguousarray(array, dtype).view()
    view.flags.writeable = False
    return view


def _compiled(function: F, **options: Any) -> F:
    compiled: F = numba.njit(nogil=True, no_cfunc_wrapper=True, **options)(function)
    if Path(function.__code__.co_filename).is_file():  # else typed at a prompt
        compiled._cache = KernelCache(function)  # type: ignore[attr-defined]
    return compiled


def kernel(function: F) -> F:
    """Compile `function` with numba on first call."""
    return _compiled(function)


def inlined(function: F) -> F:
    """Compile `function` into each kernel that calls it, so that loops over it, or in it, vectorise.

    A division by zero gives inf or NaN in it, as in numpy: raising would need a branch. Python cannot call it: taking
    tuples of arrays from Python and giving them back would take longer to compile than the function.
    """
    return _compiled(function, forceinline=True, error_model="numpy", no_cpython_wrapper=True)


def numpy_division_kernel(function: F) -> F:
    """As `kernel`, but dividing as numpy does.

    Without Python's ZeroDivisionError behind every division the synthetic town's shading compiles in half the time.
    """
    return _compiled(function, error_model="numpy")


def inner_kernel(function: F) -> F:
    """Compile `function` for kernels to call: it counts no references to the arrays in its arguments.

    Numba counts them, atomically, wherever a tuple of arrays is handed on, which can cost more than the work. Such a
    function allocates nothing (it would not compile) and returns numbers only: an array it returned would be freed
    under its owner's hands.
    """
    return _compiled(function, _nrt=False)


def hidden_kernel(function: F) -> F:
    """As `inner_kernel`, but Python cannot call it: taking tuples of arrays from Python would take as long to compile
    as the function.
    """
    return _compiled(function, _nrt=False, no_cpython_wrapper=True)
