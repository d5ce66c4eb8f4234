"""Pickles as data: plain containers and numeric numpy arrays, nothing that runs.

A pickle is a program. Four walls stand before and around it:
1. the opcodes are read first, without running any: only those that build plain values may occur, every length is
   checked against the file, no memo index may exceed the number of opcodes (else 5 bytes could ask for 64 GB), nothing
   is nested deeper than `pickle_shape.MAX_DEPTH`, and no key of a dict or set is a tuple that takes long to hash;
2. every global is answered with a function made for this one load; the named object is never imported or called;
3. arrays and copied containers are paid for from a budget of `BUDGET_PER_BYTE` x file size (+ 16 MB), so that one big
   value cannot be copied without end. Opcodes themselves cost at most some 100 bytes of memory per byte read;
4. what came of it is no larger once every reference is followed than a file of its size may say, and nothing holds
   itself (`plain_values`), so that whoever compares, converts or prints a value of it comes to an end.
"""

import io
import pickle
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, ClassVar

import numpy as np

from factory.readers.base import MAX_FILE_BYTES, BadClip
from factory.readers.pickle_shape import MAX_HASHED, check_opcodes
from factory.readers.plain_values import check_values
from factory.wording import shown

BUDGET_PER_BYTE = 8
BUDGET_BASE_BYTES = 1 << 24
RECORD_BYTES = 512  # what a record is paid for with

_ALL_PLAIN = """
    PROTO FRAME STOP MARK POP POP_MARK DUP NONE NEWTRUE NEWFALSE
    INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT
    STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8
    BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8
    EMPTY_LIST APPEND APPENDS LIST EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3
    EMPTY_DICT DICT SETITEM SETITEMS EMPTY_SET ADDITEMS FROZENSET
    GET BINGET LONG_BINGET PUT BINPUT LONG_BINPUT MEMOIZE
    GLOBAL STACK_GLOBAL REDUCE BUILD
"""
PLAIN_OPCODES = frozenset(_ALL_PLAIN.split())
_DTYPE = re.compile(r"([biuf])(1|2|4|8)|[SU][1-9]\d{0,4}")
# What a hostile or truncated stream can make the unpickler raise; BadClip passes through it untouched.
_LOAD_ERRORS = (
    *(pickle.UnpicklingError, EOFError, ValueError, TypeError, LookupError, AttributeError),
    *(OverflowError, MemoryError, RecursionError),
)


def load_plain(data: bytes, file: str) -> Any:
    """The value pickled in `data`: dicts (for defaultdict and OrderedDict too), lists, tuples, sets, scalars, arrays.

    `file` names the source in errors. Raises BadClip for a truncated stream, a global that is not one of the plain
    containers or numpy's own array constructors (named), an array of objects, or a stream that outgrows its budget.
    """
    return _load(data, file, PLAIN_OPCODES, frozenset())


def load_records(data: bytes, file: str, classes: Collection[str]) -> Any:
    """As `load_plain`, where objects of these `classes` ("module name" each) are records of what the pickle says.

    Nothing of them is imported, called or looked up. Raises BadClip as `load_plain` does.
    """
    return _load(data, file, PLAIN_OPCODES | {"NEWOBJ"}, frozenset(classes))


class Record:
    """An object that a pickle describes: its class, what it was made with, and its state. Inert."""

    module: ClassVar[str]
    name: ClassVar[str]
    arguments: tuple[Any, ...]
    state: Mapping[str, Any]  # field -> value
    spend: ClassVar[Callable[[int], None]]

    def __new__(cls, *arguments: Any) -> "Record":
        """Called by the unpickler alone, for a class of one load."""
        cls.spend(RECORD_BYTES)
        made = super().__new__(cls)
        made.arguments, made.state = arguments, {}
        return made

    def __setstate__(self, state: Any) -> None:
        parts = state if isinstance(state, tuple) else (state,)  # with __slots__: (dict or None, dict of the slots)
        if len(parts) > 2 or not all(isinstance(part, dict | None) for part in parts):
            raise ValueError(f"state of a {self.name} that is no dict of its fields")
        self.state = {name: value for part in parts for name, value in (part or {}).items()}


def _load(data: bytes, file: str, opcodes: frozenset[str], classes: frozenset[str]) -> Any:
    if len(data) > MAX_FILE_BYTES:
        raise BadClip(file, "pickle", f"{len(data)} bytes; more than {MAX_FILE_BYTES} are refused")
    check_opcodes(data, file, opcodes)
    try:
        value = _Unpickler(data, file, classes).load()
    except _LOAD_ERRORS as error:
        raise BadClip(file, "pickle", f"not a readable pickle ({type(error).__name__}: {error})") from error
    check_values(value, len(data), file, "pickle")
    return value


class _Unpickler(pickle.Unpickler):
    """Answers globals with stand-ins bound to this load's file name and memory budget."""

    def __init__(self, data: bytes, file: str, classes: frozenset[str]) -> None:
        super().__init__(io.BytesIO(data))
        self._file = file
        self._stand_ins = _stand_ins(file, BUDGET_BASE_BYTES + BUDGET_PER_BYTE * len(data), classes)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._stand_ins:
            problem = f"refused global {module}.{name}; only plain containers and arrays load"
            raise BadClip(self._file, "pickle", problem)
        return self._stand_ins[module, name]


class _Dtype:
    """What a pickled numpy dtype says; becomes a real one only after it was checked."""

    def __init__(self, spec: object, file: str) -> None:
        if not isinstance(spec, str) or not _DTYPE.fullmatch(spec):
            raise BadClip(file, "pickle", f"refused array type {shown(spec)}; only numbers, flags and text load")
        self.dtype = np.dtype(spec)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array still without content; numpy's own __setstate__ checks that bytes and shape agree."""

    spend: Callable[[int], None]

    def __setstate__(self, state: Any) -> None:
        version, shape, dtype, is_fortran, raw = state
        if not isinstance(dtype, _Dtype) or not isinstance(raw, bytes):
            raise ValueError("array state without a checked dtype and bytes")
        self.spend(len(raw))
        checked: Any = (version, shape, dtype.dtype, bool(is_fortran), raw)
        super().__setstate__(checked)


def _hashed(value: object, left: int) -> int:
    """What is left of `left` values once those that hashing a tuple goes through are taken; below 0: too many."""
    left -= 1
    for item in value if isinstance(value, tuple) and left >= 0 else ():
        left = _hashed(item, left)
        if left < 0:
            break
    return left


def _stand_ins(file: str, budget: int, classes: frozenset[str]) -> dict[tuple[str, str], Callable[..., Any]]:
    """(module, name) -> what a global stands for. Functions are made anew per load: no stream can alter another's.

    budget: bytes that arrays and copies may take.
    """
    left = budget

    def spend(n_bytes: int) -> None:
        nonlocal left
        left -= n_bytes
        if left < 0:
            raise BadClip(file, "pickle", "arrays outgrow the memory that a file of this size may ask for")

    def content(raw: object, dtype: object) -> np.ndarray:
        if not isinstance(raw, bytes | bytearray) or not isinstance(dtype, _Dtype):
            raise ValueError("values without a checked dtype and bytes")
        spend(len(raw))
        return np.frombuffer(bytes(raw), dtype=dtype.dtype)

    def array_class(*_: object) -> object:
        raise BadClip(file, "pickle", "refused a direct call of numpy.ndarray")

    def reconstruct(subtype: object, shape: object, code: object) -> np.ndarray:
        if subtype is not array_class:
            raise BadClip(file, "pickle", f"refused array subclass {shown(subtype)}")
        empty = np.empty(0, np.uint8).view(_Array)
        empty.spend = spend
        return empty

    def from_buffer(raw: object, dtype: object, shape: tuple[int, ...], order: str) -> np.ndarray:
        return content(raw, dtype).reshape(shape, order="F" if order == "F" else "C").copy()

    def scalar(dtype: object, raw: object) -> Any:
        (value,) = content(raw, dtype)
        return value

    def encode(text: str, encoding: str) -> bytes:
        """How Python 2's protocols write bytes."""
        if encoding != "latin1":
            raise ValueError(f"bytes written as {encoding}")
        spend(len(text))
        return text.encode("latin1")

    def plain_dict(*arguments: object) -> dict[Any, Any]:
        """defaultdict(factory) and OrderedDict(); their items follow as opcodes. The factory is dropped."""
        return {}

    def copied(kind: Callable[[Iterable[object]], Any]) -> Callable[..., Any]:
        def build(items: list[object] | tuple[object, ...] | str = ()) -> Any:
            spend(64 * len(items))
            if kind in (set, frozenset) and any(_hashed(item, MAX_HASHED) < 0 for item in items):
                raise BadClip(file, "pickle", "a member of a set is a tuple of too many")
            return kind(items)

        return build

    table: dict[tuple[str, str], Callable[..., Any]] = {
        ("collections", "defaultdict"): plain_dict,
        ("collections", "OrderedDict"): plain_dict,
        ("numpy", "ndarray"): array_class,
        ("numpy", "dtype"): lambda spec, align=False, copy=False: _Dtype(spec, file),
        ("_codecs", "encode"): encode,
    }
    for package in ("numpy.core", "numpy._core"):  # numpy 1 and 2
        table[package + ".multiarray", "_reconstruct"] = reconstruct
        table[package + ".multiarray", "scalar"] = scalar
        table[package + ".numeric", "_frombuffer"] = from_buffer
    for builtins in ("builtins", "__builtin__"):  # Python 3 and 2 names
        for kind in (set, frozenset, list, tuple):
            table[builtins, kind.__name__] = copied(kind)
        for name in ("dict", "int", "float", "bool", "str"):  # only ever factories of a defaultdict
            table[builtins, name] = plain_dict
    for module, name in (words.split(" ") for words in classes):
        inert = {"module": module, "name": name, "spend": staticmethod(spend)}
        table[module, name] = type("Record", (Record,), inert)
    return table
