"""Pickles that the public code's own, older numpy opens, and SimScale's reward pickles, written and read."""

import pickle
import pickletools
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from factory.readers.base import BadClip
from factory.store.reader import labels_of
from factory.wording import shown
from tasks.world.arrays import Array

PROTOCOL = 3  # the newest whose globals stand as text, and whose values may follow each other in one stream
HEAD, TAIL = b"\x80\x03", b"."
EMPTY_DICT, MARK, SETITEMS = b"}", b"(", b"u"
NUMPY_2, NUMPY_1 = b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n"  # numpy < 1.26 knows the second alone


def dumps(value: object, known_as: Mapping[type, str] | None = None) -> bytes:
    """A pickle of plain values and numpy arrays, the same bytes whatever numpy writes it.

    known_as: classes of ours whose objects come back as those of another's, "module name", which need not be here.
    """
    data = pickle.dumps(value, PROTOCOL).replace(NUMPY_2, NUMPY_1)
    for kind, name in (known_as or {}).items():
        data = data.replace(_global(f"{kind.__module__} {kind.__qualname__}"), _global(name))
    return data


def write_pickled_dict(file: BinaryIO, entries: Iterable[tuple[str, object]], after: Path | None = None) -> None:
    """Pickle a dictionary of any size into `file`, one entry in memory.

    after: a file written by this function, whose entries come first.
    """
    file.write(HEAD + EMPTY_DICT)
    if after is not None:
        with after.open("rb") as earlier:
            earlier.seek(len(HEAD + EMPTY_DICT))
            shutil.copyfileobj(earlier, file, 1 << 20)
        file.seek(-len(TAIL), 2)
    for key, value in entries:
        file.write(MARK + _bare(key) + _bare(value) + SETITEMS)
    file.write(TAIL)


def _global(name: str) -> bytes:
    module, _, qualified = name.partition(" ")
    return f"c{module}\n{qualified}\n".encode()


def _bare(value: object) -> bytes:
    """A value's opcodes without head and tail. Its memo begins at 0 again, over what an earlier value left there."""
    return dumps(value)[len(HEAD) : -len(TAIL)]


# A vocabulary's labels as SimScale's reward pickles: {token: {metric: float16 (K,)}}.

# The public name of each sub-score, in the order of SimScale's gen_vocab_score (navsim/evaluate/pdm_score.py:309-319).
METRICS = {
    "no_at_fault_collisions": "nc",
    "drivable_area_compliance": "dac",
    "driving_direction_compliance": "ddc",
    "traffic_light_compliance": "tlc",
    "ego_progress": "ep",
    "time_to_collision_within_bound": "ttc",
    "lane_keeping": "lk",
    "history_comfort": "hc",
    "pdm_score": "score",
}


def reward_arrays(row: Mapping[str, Any]) -> dict[str, NDArray[np.float16]]:
    """Every metric of every trajectory of the vocabulary, from the row's label columns.

    Progress is divided as SimScale labels its vocabulary (PROGRESS_MODE=gen_gt). Raises ValueError for a row without
    labels.
    """
    labels = labels_of(row)
    values = {"ep": labels.ep("masked"), "score": labels.pdm_score("masked")}
    return {
        name: np.asarray(values[ours] if ours in values else getattr(labels, ours), np.float16)
        for name, ours in METRICS.items()
    }


# A reward pickle of SimScale, {token: {metric: float16 (K,)}}: opened by its index, read token by token.
#
# With 65,026 tokens, nine metrics and K = 16,384 one file is 19 GB. So its opcodes are followed once, nothing of it
# runs, and of every array only its place in the file is kept. What a pickler says once and refers to later may be
# text, the name of a type, or what stands in the same batch of tokens; an array of an earlier batch is refused.

LONG_BYTES = 2  # from here on bytes are content, of which the place is kept; one letter names an order
TYPES = ("f2", "f4", "f8")
HEAD_BYTES = {"SHORT_BINBYTES": 2, "BINBYTES": 5, "BINBYTES8": 9, "BYTEARRAY8": 9}  # opcode and length
NUMBERS = ("BININT", "BININT1", "BININT2", "LONG1")
TEXTS = ("BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8")
CONSTANTS: Mapping[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
RECONSTRUCT = ("numpy.core.multiarray _reconstruct", "numpy._core.multiarray _reconstruct")  # numpy 1 and 2
FROM_BUFFER = ("numpy.core.numeric _frombuffer", "numpy._core.numeric _frombuffer")
GLOBALS = (*RECONSTRUCT, *FROM_BUFFER, "numpy ndarray", "numpy dtype")


@dataclass(frozen=True)
class _Global:
    name: str


@dataclass(frozen=True)
class _Place:
    """Where content stands in the file."""

    offset: int
    size: int


@dataclass
class _Type:
    """A dtype: its letters, and the byte order that its state says."""

    code: str
    order: str = "<"


@dataclass
class _Numbers:
    """An array; without a place until its state is known."""

    place: _Place | None = None
    type: str = ""

    def fill(self, shape: Any, kind: Any, place: Any) -> None:
        """Raises ValueError for what is no (K,) of floating point numbers with a place."""
        if not isinstance(kind, _Type) or kind.code not in TYPES:
            raise ValueError(f"an array of {shown(getattr(kind, 'code', kind))}, expected floating point numbers")
        self.type = kind.order + kind.code
        if not isinstance(place, _Place) or shape != (place.size // np.dtype(self.type).itemsize,):
            raise ValueError(f"an array of shape {shown(shape)}, expected (K,)")
        self.place = place


class RewardFile:
    """The rewards of many tokens on disk."""

    def __init__(self, path: Path) -> None:
        """Raises BadClip for what is no such pickle."""
        self.path = path
        self._places: dict[str, tuple[_Place, ...]] = {}  # by token, in the order of `metrics`
        self.metrics: tuple[str, ...] = ()
        self.type = ""
        try:
            with path.open("rb") as file:
                _for_each_entry(file, self._add)
        except OSError as error:
            raise BadClip(str(path), "file", f"cannot be read: {error.strerror}") from error
        except (ValueError, TypeError, LookupError, OverflowError) as error:  # of a broken or foreign stream
            raise BadClip(str(path), "pickle", f"no {{token: {{metric: array}}}}: {error}") from error

    def __contains__(self, token: str) -> bool:
        return token in self._places

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, token: str) -> dict[str, Array]:
        """Metric -> float64 (K,). Raises KeyError for another's token."""
        found = {}
        with self.path.open("rb") as file:
            for name, place in zip(self.metrics, self._places[token]):
                file.seek(place.offset)
                found[name] = np.frombuffer(file.read(place.size), self.type).astype(np.float64)
        return found

    def _add(self, token: Any, metrics: Any) -> None:
        """One entry of the outer dictionary. Raises ValueError."""
        if not isinstance(token, str) or not isinstance(metrics, dict) or not metrics:
            raise ValueError(f"{shown(token)} is not the token of a dict of metrics")
        places = [value.place for value in metrics.values() if isinstance(value, _Numbers) and value.place]
        types = {value.type for value in metrics.values() if isinstance(value, _Numbers)}
        if len(places) < len(metrics) or len({place.size for place in places}) > 1 or len(types) > 1:
            raise ValueError(f"token {token}: its metrics are not arrays of one length and type")
        self.metrics, self.type = self.metrics or tuple(metrics), self.type or types.pop()
        if tuple(metrics) != self.metrics or types - {self.type}:
            raise ValueError(f"token {token}: its metrics or their type are not those of the tokens before it")
        self._places[token] = tuple(places)


def _for_each_entry(file: BinaryIO, add: Any) -> None:
    """Call `add(token, metrics)` for each entry of the pickled dictionary. Raises ValueError and what a stream may."""
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}
    remembered = 0

    def popped(n: int) -> list[Any]:
        if len(stack) < n:
            raise ValueError("the stack runs empty")
        taken = stack[len(stack) - n :]
        del stack[len(stack) - n :]
        return taken

    argument: Any  # of the type that its opcode says
    for opcode, argument, position in pickletools.genops(file):
        name = opcode.name
        if name in HEAD_BYTES:
            place = _Place((position or 0) + HEAD_BYTES[name], len(argument))
            stack.append(place if len(argument) >= LONG_BYTES else bytes(argument))
        elif name in TEXTS or name in NUMBERS:
            stack.append(argument)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name == "EMPTY_DICT":
            stack.append({})
        elif name == "MARK":
            marks.append(len(stack))
        elif name == "TUPLE":
            stack.append(tuple(popped(len(stack) - marks.pop())))
        elif name in TUPLES:
            stack.append(tuple(popped(TUPLES[name])))
        elif name == "GLOBAL":
            stack.append(_known(argument))
        elif name == "STACK_GLOBAL":
            stack.append(_known(" ".join(popped(2))))
        elif name == "REDUCE":
            called, arguments = popped(2)
            stack.append(_called(called, arguments))
        elif name == "BUILD":
            (state,) = popped(1)
            _build(stack[-1], state)
        elif name in ("SETITEMS", "SETITEM"):
            items = popped(len(stack) - marks.pop() if name == "SETITEMS" else 2)
            if not all(isinstance(key, str) for key in items[::2]):  # to hash a tuple may take for ever
                raise ValueError(f"a key at byte {position} is no text")
            pairs = zip(items[::2], items[1::2], strict=True)
            if len(stack) > 1:
                stack[-1].update(pairs)
                continue
            for token, metrics in pairs:
                add(token, metrics)
            memo = {i: value for i, value in memo.items() if isinstance(value, str | bytes | _Global | _Type | dict)}
            memo = {i: value for i, value in memo.items() if not isinstance(value, dict) or value is stack[0]}
        elif name == "MEMOIZE":
            memo[remembered] = stack[-1]
            remembered += 1
        elif name in ("BINPUT", "LONG_BINPUT"):
            memo[argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            if argument not in memo:
                raise ValueError(f"byte {position} refers to an array of earlier tokens; write each of its own")
            stack.append(memo[argument])
        elif name not in ("PROTO", "FRAME", "STOP"):
            raise ValueError(f"opcode {name} at byte {position} is refused")
    if len(stack) != 1 or not isinstance(stack[0], dict):
        raise ValueError("it holds no dictionary")


def _known(name: str) -> _Global:
    if name not in GLOBALS:
        raise ValueError(f"refused global {name.replace(' ', '.')}")
    return _Global(name)


def _called(called: Any, arguments: Any) -> _Type | _Numbers:
    """What a call stands for. Raises ValueError for any other than numpy's own of arrays."""
    name = called.name if isinstance(called, _Global) else ""
    if name == "numpy dtype":
        (code, *_) = arguments
        return _Type(code if isinstance(code, str) else "")
    numbers = _Numbers()
    if name in FROM_BUFFER:
        place, kind, shape, _ = arguments
        numbers.fill(shape, kind, place)
    elif name not in RECONSTRUCT:
        raise ValueError(f"refused call of {name or shown(called)}")
    return numbers


def _build(made: Any, state: Any) -> None:
    if isinstance(made, _Type):
        made.order = ">" if state[1] == ">" else "<"
    elif isinstance(made, _Numbers):
        _, shape, kind, _, place = state
        made.fill(shape, kind, place)
    else:
        raise ValueError(f"refused state of a {type(made).__name__}")
