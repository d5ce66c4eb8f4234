"""How much a value out of a file is once every reference in it is followed, before anything is computed from it.

A file can refer to one value many times: 60 tuples of three references to the one before are 300 bytes of pickle, and
3^60 values to whatever walks through them: `repr`, `==`, `numpy.asarray`, a recursive function. A list may hold itself,
and an integer have more digits than Python writes out.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from numbers import Integral

from factory.readers.base import BadClip
from factory.readers.pickle_shape import MAX_DEPTH

VALUES_PER_BYTE, VALUES_BASE = 8, 1 << 20  # of a file: those of shared containers counted wherever they are referred to
MAX_INT_BITS = 1024  # of an integer; Python writes out some 14,000, ids that are digests have 256
BYTES_A_VALUE = 8  # of texts and arrays, so that copies of one large one are no way round
_LEAVES = frozenset({str, int, float, bool, bytes, bytearray, type(None)})


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


def id_text(value: object) -> str | None:
    """What names a thing in a file, as text: a text or a whole number; None of all that names nothing.

    `str` would make one thing of all those whose id is None, NaN or empty.
    """
    if isinstance(value, str):
        return str(value) if value.strip() else None
    return str(int(value)) if isinstance(value, Integral) and not isinstance(value, bool) else None


def _parts(value: object) -> Iterable[object] | None:
    """What a container holds; None of what is none."""
    if type(value) in _LEAVES:
        return None
    if isinstance(value, dict):
        return chain(value.keys(), value.values())
    if isinstance(value, list | tuple | set | frozenset):
        return value
    if hasattr(value, "nbytes"):  # an array, a tensor
        return None
    if isinstance(value, Mapping):
        return chain(value.keys(), value.values())
    return vars(value).values() if hasattr(value, "__dict__") else None  # of records


def _size(value: object, refuse: Callable[[str], BadClip]) -> int:
    if isinstance(value, int):
        if value.bit_length() > MAX_INT_BITS:
            raise refuse(f"an integer of {value.bit_length():,} bits")
        return 1
    n_bytes = len(value) if isinstance(value, str | bytes | bytearray) else int(getattr(value, "nbytes", 0))
    return 1 + n_bytes // BYTES_A_VALUE
