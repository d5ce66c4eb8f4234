"""What a pickle will build, told from its opcodes alone: how deep it nests, and what its keys cost to hash.

The stack is followed with two numbers in place of each value. `hash` of a tuple visits every value in it each time, so
that 60 tuples of two references to the one before never end, and 100,000 nested ones overflow C's stack.
"""

import pickletools
from collections.abc import Callable, Collection
from typing import Any, BinaryIO

from factory.readers.base import BadClip

MAX_DEPTH = 100  # of containers in each other; logs have some 10
MAX_HASHED = 1000  # values that a key of a dict or a member of a set may hold; ids are texts, or tuples of a few

Shape = list[int]  # [values in it, those of its members counted wherever they are referred to; depth]
_LEAF: Shape = [1, 0]
_CONSTANTS = """
    NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING
    UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 GLOBAL
"""
_LEAVES = frozenset(_CONSTANTS.split())
_MEMO = {"PUT", "BINPUT", "LONG_BINPUT"}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_FROM_MARK = {"TUPLE", "LIST", "DICT", "FROZENSET"}
_EMPTY = {"EMPTY_LIST", "EMPTY_DICT", "EMPTY_SET", "EMPTY_TUPLE"}


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
            items.append(_LEAF)
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
        if inside and shape is not _LEAF:  # which holds nothing
            shape[0] = min(shape[0] + sum(size for size, _ in inside), MAX_HASHED + 1)
            shape[1] = max(shape[1], 1 + max(depth for _, depth in inside))
            if shape[1] > MAX_DEPTH:
                raise self._refuse(f"values nested more than {MAX_DEPTH} deep")

    def _check_keys(self, keys: list[Shape]) -> None:
        for size, _ in keys:
            if size > MAX_HASHED:
                raise self._refuse(f"a key of more than {MAX_HASHED} values")


def check_opcodes(data: bytes | BinaryIO, file: str, allowed: Collection[str]) -> None:
    """Raises BadClip where an opcode may do more than build plain values, or builds what takes too long or too deep.

    Also where the stream is cut off, or takes from the stack what is not there. An open file is read up to its end.
    """
    position = 0

    def refuse(problem: str) -> BadClip:
        return BadClip(file, "pickle", f"{problem} at byte {position}: refused")

    stack = _Stack(refuse)
    try:
        for count, (opcode, argument, at) in enumerate(pickletools.genops(data)):
            position, name = at or 0, opcode.name
            if name not in allowed:
                raise BadClip(file, "pickle", f"opcode {name} at byte {position} is refused")
            if name in _MEMO and int(argument or 0) > count:
                raise BadClip(file, "pickle", f"memo index {argument} at byte {position} is refused")
            stack.step(name, argument)
    except (ValueError, EOFError, OverflowError, LookupError) as error:
        raise BadClip(file, "pickle", f"truncated or not a pickle ({error})") from error
