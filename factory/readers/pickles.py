"""Pickles as data: plain containers and numeric numpy arrays, nothing that runs.

A pickle is a program. Four walls stand before and around it:
1. the opcodes are read first, without running any: only those that build plain values may occur, every length is
   checked against the file, no memo index may exceed the number of opcodes (else 5 bytes could ask for 64 GB), nothing
   is nested deeper than MAX_DEPTH, and no key of a dict or set is a tuple that takes long to hash, or an integer that
   can be made to share its hash with all others;
2. every global is answered with a function made for this one load; the named object is never imported or called;
3. arrays and copied containers are paid for from a budget of `BUDGET_PER_BYTE` x file size (+ 16 MB), so that one big
   value cannot be copied without end. Opcodes themselves cost at most some 100 bytes of memory per byte read;
4. what came of it is no larger once every reference is followed than a file of its size may say, and nothing holds
   itself (`plain_values`), so that whoever compares, converts or prints a value of it comes to an end.
"""

import io
import pickle
import pickletools
import re
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from factory.files import why_no_memory
from factory.readers.base import MAX_FILE_BYTES, BadClip
from factory.wording import one_line, shown

# What a pickle will build, told from its opcodes alone: how deep it nests, and what its keys cost to hash.
#
# The stack is followed with two numbers in place of each value. `hash` of a tuple visits every value in it each time,
# so that 60 tuples of two references to the one before never end, and 100,000 nested ones overflow C's stack.

MAX_DEPTH = 100  # of containers in each other; logs have some 10
MAX_HASHED = 1000  # values that a key of a dict or a member of a set may hold; ids are texts, or tuples of a few

Shape = list[int]  # [values in it, those of its members counted wherever they are referred to; depth]
_size_of, _depth_of = itemgetter(0), itemgetter(1)
_LEAF: Shape = [1, 0]
_LONG: Shape = [MAX_HASHED + 1, 0]  # no key: Python hashes integers modulo 2^61 - 1, so that any number share one hash
KEY_BITS = 64
_CONSTANTS = """
    NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING
    UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 GLOBAL
"""
_LEAVES = frozenset(_CONSTANTS.split())
_MEMO = {"PUT", "BINPUT", "LONG_BINPUT"}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_FROM_MARK = {"TUPLE", "LIST", "DICT", "FROZENSET"}
_EMPTY = {"EMPTY_LIST", "EMPTY_DICT", "EMPTY_SET", "EMPTY_TUPLE"}


# What most of a log is: its polylines, and lists of numbers. Taken a run at a time, a log takes half as long.
_POINTS, _POINT_BYTES = re.compile(rb"(?:(?:G.{8}){3}\x87\x94)+", re.DOTALL), 29
_NUMBERS, _NUMBER_BYTES = re.compile(rb"(?:G.{8})+", re.DOTALL), 9


class _Stack:
    """Of shapes; marks are places in it."""

    def __init__(self, refuse: Callable[[str], BadClip]) -> None:
        self.items: list[Shape] = []
        self._marks: list[int] = []
        self._memo: dict[int, Shape] = {}
        self._refuse = refuse

    def step(self, name: str, argument: Any) -> None:
        """One opcode. Raises IndexError and KeyError where it takes what is not there."""
        items = self.items
        if name in _LEAVES:
            items.append(_LONG if isinstance(argument, int) and argument.bit_length() > KEY_BITS else _LEAF)
        elif name == "MARK":
            self._marks.append(len(items))
        elif name in _MEMO:
            self._memo[int(argument)] = items[-1]
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = items[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            items.append(self._memo[int(argument)])
        elif name in _EMPTY:
            items.append([1, 1])
        elif name in _TUPLES:
            self._push(self._pop(_TUPLES[name]))
        elif name in _FROM_MARK:
            inside = self._slice()
            self._check_keys(inside[::2] if name == "DICT" else inside if name == "FROZENSET" else [])
            self._push(inside)
        elif name == "APPEND":
            self._into(self._pop(1))
        elif name == "APPENDS":
            self._into(self._slice())
        elif name == "SETITEM":
            pair = self._pop(2)
            self._check_keys(pair[:1])
            self._into(pair)
        elif name in ("SETITEMS", "ADDITEMS"):
            inside = self._slice()
            self._check_keys(inside[::2] if name == "SETITEMS" else inside)
            self._into(inside)
        elif name in ("REDUCE", "NEWOBJ", "STACK_GLOBAL"):
            self._push(self._pop(2))
        elif name == "BUILD":
            self._into(self._pop(1))
        elif name == "BINPERSID":
            self._pop(1)
            items.append(_LEAF)
        elif name == "DUP":
            items.append(items[-1])
        elif name == "POP":
            if self._marks and self._marks[-1] == len(items):
                self._marks.pop()
            else:
                self._pop(1)
        elif name == "POP_MARK":
            self._slice()

    def numbers(self, count: int) -> None:
        """BINFLOAT that often."""
        self.items += [_LEAF] * count

    def points(self, count: int) -> None:
        """Three BINFLOAT, TUPLE3 and MEMOIZE that often."""
        shapes = [[4, 1] for _ in range(count)]
        self.items += shapes
        self._memo.update(enumerate(shapes, len(self._memo)))

    def _pop(self, count: int) -> list[Shape]:
        if len(self.items) < count + (self._marks[-1] if self._marks else 0):
            raise IndexError("an empty stack")
        taken = self.items[-count:]
        del self.items[-count:]
        return taken

    def _slice(self) -> list[Shape]:
        start = self._marks.pop()
        taken = self.items[start:]
        del self.items[start:]
        return taken

    def _push(self, inside: list[Shape]) -> None:
        shape = [1, 1]
        self.items.append(shape)
        self._add(shape, inside)

    def _into(self, inside: list[Shape]) -> None:
        self._add(self.items[-1], inside)

    def _add(self, shape: Shape, inside: list[Shape]) -> None:
        if inside and shape[1]:  # a leaf holds nothing
            shape[0] = min(shape[0] + sum(map(_size_of, inside)), MAX_HASHED + 1)
            shape[1] = max(shape[1], 1 + max(map(_depth_of, inside)))
            if shape[1] > MAX_DEPTH:
                raise self._refuse(f"values nested more than {MAX_DEPTH} deep")

    def _check_keys(self, keys: list[Shape]) -> None:
        for size, _ in keys:
            if size > MAX_HASHED:
                raise self._refuse(f"a key of more than {MAX_HASHED} values or {KEY_BITS} bits")


def check_opcodes(data: bytes | BinaryIO, file: str, allowed: Collection[str]) -> None:
    """Raises BadClip where an opcode may do more than build plain values, or builds what takes too long or too deep.

    Also where the stream is cut off, or takes from the stack what is not there. An open file is read up to its end.
    """
    position = 0

    def refuse(problem: str) -> BadClip:
        return BadClip(file, "pickle", f"{problem} at byte {position}: refused")

    stack, count = _Stack(refuse), 0
    stream = io.BytesIO(data) if isinstance(data, bytes) else data
    try:
        for opcode, argument, at in pickletools.genops(stream):
            position, name = at or 0, opcode.name
            if name not in allowed:
                raise BadClip(file, "pickle", f"opcode {name} at byte {position} is refused")
            if name in _MEMO and int(argument or 0) > count:
                raise BadClip(file, "pickle", f"memo index {argument} at byte {position} is refused")
            stack.step(name, argument)
            count += 1
            if name in ("MARK", "MEMOIZE", "APPENDS") and isinstance(data, bytes):
                if run := _POINTS.match(data, at := stream.tell()):
                    stack.points(n := (run.end() - at) // _POINT_BYTES)
                    count += 5 * n
                elif run := _NUMBERS.match(data, at):
                    stack.numbers(n := (run.end() - at) // _NUMBER_BYTES)
                    count += n
                if run:
                    stream.seek(run.end())
    except (ValueError, EOFError, OverflowError, LookupError) as error:
        raise BadClip(file, "pickle", f"truncated or not a pickle ({error})") from error


# How much a value out of a file is once every reference in it is followed, before anything is computed from it.
#
# A file can refer to one value many times: 60 tuples of three references to the one before are 300 bytes of pickle,
# and 3^60 values to whatever walks through them: `repr`, `==`, `numpy.asarray`, a recursive function. A list may hold
# itself, and an integer have more digits than Python writes out.

VALUES_PER_BYTE, VALUES_BASE = 8, 1 << 20  # of a file: those of shared containers counted wherever they are referred to
MAX_INT_BITS = 1024  # of an integer; Python writes out some 14,000, ids that are digests have 256
BYTES_A_VALUE = 8  # of texts and arrays, so that copies of one large one are no way round
_NUMBERS_ALONE = frozenset({float, bool, type(None)})
_PLAIN_LEAVES = frozenset({str, int, float, bool, bytes, bytearray, type(None)})


def check_values(value: object, n_bytes: int, file: str, field: str) -> None:
    """Raises BadClip where a value is more, or deeper, than a file of `n_bytes` may say, or holds itself.

    Containers are walked through once each, however often they are referred to.
    """
    most = VALUES_BASE + VALUES_PER_BYTE * n_bytes
    known: dict[int, tuple[int, int]] = {}  # container -> [values in it, depth]; all live as long as `value` does
    path: list[tuple[int, Iterator[object], list[int]]] = []
    inside: set[int] = set()  # containers that are on the path

    def refuse(problem: str) -> BadClip:
        return BadClip(file, field, f"{problem}: refused")

    top = [0, 0]
    items: Iterator[object] = iter((value,))
    so_far, here = top, 0
    while True:
        for item in items:
            if isinstance(item, list | tuple) and _NUMBERS_ALONE.issuperset(map(type, item)):  # most of a log
                so_far[0] += 1 + len(item)
                so_far[1] = max(so_far[1], 1)
                continue
            parts = _parts(item)
            if parts is None:
                so_far[0] += _size(item, refuse)
                continue
            if (found := known.get(id(item))) is not None:
                so_far[0] += found[0]
                so_far[1] = max(so_far[1], found[1] + 1)
                continue
            if id(item) in inside:
                raise refuse(f"a {type(item).__name__} that holds itself")
            path.append((here, items, so_far))
            here, items, so_far = id(item), iter(parts), [1, 0]
            inside.add(here)
            if len(path) > MAX_DEPTH:
                raise refuse(f"values nested more than {MAX_DEPTH} deep")
            break
        else:
            if not path:
                return
            size, depth = so_far
            known[here] = size, depth
            inside.discard(here)
            here, items, so_far = path.pop()
            so_far[0] += size
            so_far[1] = max(so_far[1], depth + 1)
        if so_far[1] > MAX_DEPTH:
            raise refuse(f"values nested more than {MAX_DEPTH} deep")
        if so_far[0] > most:
            raise refuse(f"values that refer to each other so often that they are more than {most:,}")


def _parts(value: object) -> Iterable[object] | None:
    """What a container holds; None of what is none."""
    if type(value) in _PLAIN_LEAVES:
        return None
    if isinstance(value, dict):
        return chain(value.keys(), value.values())
    if isinstance(value, list | tuple | set | frozenset):
        return value
    if hasattr(type(value), "nbytes"):  # an array, a tensor; a sparse one's raises
        return None
    if isinstance(value, Mapping):
        return chain(value.keys(), value.values())
    return vars(value).values() if hasattr(value, "__dict__") else None  # of records


def _size(value: object, refuse: Callable[[str], BadClip]) -> int:
    if isinstance(value, int):
        if value.bit_length() > MAX_INT_BITS:
            raise refuse(f"an integer of {value.bit_length():,} bits")
        return 1
    try:
        n_bytes = len(value) if isinstance(value, str | bytes | bytearray) else int(getattr(value, "nbytes", 0))
    except RuntimeError as error:
        raise refuse("a sparse tensor") from error
    return 1 + n_bytes // BYTES_A_VALUE


BUDGET_PER_BYTE = 8
BUDGET_BASE_BYTES = 1 << 24
RECORD_BYTES = 256  # what a record is paid for with

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
    return _load(data, file, PLAIN_OPCODES)


def load_records(data: bytes, file: str, classes: Collection[str], *, drop_object_arrays: bool = False) -> Any:
    """As `load_plain`, where objects of these `classes` ("module name" each) are records of what the pickle says.

    Nothing of them is imported, called or looked up. drop_object_arrays: an array of objects comes back empty, for
    files whose objects stand elsewhere too. Raises BadClip as `load_plain` does.
    """
    return _load(data, file, PLAIN_OPCODES | {"NEWOBJ"}, frozenset(classes), drop_object_arrays)


class Record:
    """An object that a pickle describes: its class, what it was made with, and its state. Inert."""

    __slots__ = ("arguments", "state")  # files hold ten thousands of them
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


def _load(
    data: bytes,
    file: str,
    opcodes: frozenset[str],
    classes: frozenset[str] = frozenset(),
    drop_object_arrays: bool = False,
) -> Any:
    if len(data) > MAX_FILE_BYTES:
        raise BadClip(file, "pickle", f"{len(data)} bytes; more than {MAX_FILE_BYTES} are refused")
    check_opcodes(data, file, opcodes)
    try:
        value = _Unpickler(data, file, classes, drop_object_arrays).load()
    except _LOAD_ERRORS as error:
        raise BadClip(file, "pickle", f"not a readable pickle ({type(error).__name__}: {error})") from error
    check_values(value, len(data), file, "pickle")
    return value


class _Unpickler(pickle.Unpickler):
    """Answers globals with stand-ins bound to this load's file name and memory budget."""

    def __init__(self, data: bytes, file: str, classes: frozenset[str], drop_object_arrays: bool) -> None:
        super().__init__(io.BytesIO(data))
        self._file = file
        budget = BUDGET_BASE_BYTES + BUDGET_PER_BYTE * len(data)
        self._stand_ins = _stand_ins(file, budget, classes, drop_object_arrays)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._stand_ins:
            problem = f"refused global {module}.{name}; only plain containers and arrays load"
            raise BadClip(self._file, "pickle", problem)
        return self._stand_ins[module, name]


class _Dtype:
    """What a pickled numpy dtype says; becomes a real one only after it was checked."""

    def __init__(self, spec: object, file: str, may_be_object: bool) -> None:
        if not isinstance(spec, str) or not (_DTYPE.fullmatch(spec) or (may_be_object and spec == "O8")):
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
        if isinstance(dtype, _Dtype) and dtype.dtype.hasobject:
            return  # as it is: empty
        if not isinstance(dtype, _Dtype) or not isinstance(raw, bytes):
            raise ValueError("array state without a checked dtype and bytes")
        self.spend(len(raw))
        checked: Any = (version, shape, dtype.dtype, bool(is_fortran), raw)
        super().__setstate__(checked)


def _left_after_hashing(value: object, left: int) -> int:
    """What is left of `left` values once those that hashing a tuple goes through are taken; below 0: too many, or an
    integer that is no key."""
    left -= MAX_HASHED + 1 if isinstance(value, int) and value.bit_length() > KEY_BITS else 1
    for item in value if isinstance(value, tuple) and left >= 0 else ():
        left = _left_after_hashing(item, left)
        if left < 0:
            break
    return left


def _stand_ins(
    file: str, budget: int, classes: frozenset[str], drop_object_arrays: bool
) -> dict[tuple[str, str], Callable[..., Any]]:
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
            if kind in (set, frozenset) and any(_left_after_hashing(item, MAX_HASHED) < 0 for item in items):
                raise BadClip(file, "pickle", "a member of a set is a tuple of too many, or an integer too large")
            return kind(items)

        return build

    table: dict[tuple[str, str], Callable[..., Any]] = {
        ("collections", "defaultdict"): plain_dict,
        ("collections", "OrderedDict"): plain_dict,
        ("numpy", "ndarray"): array_class,
        ("numpy", "dtype"): lambda spec, align=False, copy=False: _Dtype(spec, file, drop_object_arrays),
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
        inert = {"module": module, "name": name, "spend": staticmethod(spend), "__slots__": ()}
        table[module, name] = type("Record", (Record,), inert)
    return table


# Checkpoints of torch as data: tensors, arrays and plain values, nothing that runs, and no more than the file may
# say.
#
# `torch.load` of weights alone calls nothing of a stranger's; what it builds is as large as its references make it,
# and a key of a dictionary may take for ever to hash. So the streams are looked through before, and the value after.

OPCODES = PLAIN_OPCODES | {"NEWOBJ", "BINPERSID"}  # objects and storages, of which torch takes its own alone
OLD_STREAMS = 5  # pickles before the numbers in files of before 1.6: magic, version, machine, content, storages
MOST_EXPANDED = 2  # members are stored as they are


def load_tensors(path: Path, safe: Sequence[Any] = ()) -> Any:
    """What a checkpoint holds, its tensors on the CPU; safe: further classes that it may name.

    Raises ValueError that names the file and says in one line why it is none, OSError, and ImportError without torch.
    """
    import torch

    check_checkpoint(path)
    try:
        with torch.serialization.safe_globals(list(safe)):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # whatever a damaged file, or an object that is refused, raises
        said = why_no_memory(error) or one_line(error).partition(". ")[0]
        raise ValueError(f"{path}: cannot be read as a checkpoint of tensors and plain values: {said}") from error
    try:
        check_values(content, path.stat().st_size, str(path), "checkpoint")
    except BadClip as error:
        raise ValueError(str(error)) from error
    return content


def check_checkpoint(path: Path) -> None:
    """Raises ValueError where a stream of the file would take for ever or without end to load, and OSError."""
    try:
        if not zipfile.is_zipfile(path):
            with path.open("rb") as stream:
                for _ in range(OLD_STREAMS):
                    check_opcodes(stream, str(path), OPCODES)
            return
        with zipfile.ZipFile(path) as packed:
            members = packed.infolist()
            if sum(member.file_size for member in members) > MOST_EXPANDED * path.stat().st_size:
                raise BadClip(str(path), "checkpoint", "its members are packed to less than half their size: refused")
            for member in members:
                if member.filename.endswith(".pkl"):
                    check_opcodes(packed.read(member), str(path), OPCODES)
    except (BadClip, zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError) as error:
        said = error.problem if isinstance(error, BadClip) else one_line(error)
        raise ValueError(f"{path}: cannot be read as a checkpoint of tensors and plain values: {said}") from error
