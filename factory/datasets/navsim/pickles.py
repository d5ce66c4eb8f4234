"""Pickles that the public code's own, older numpy opens, and a large dictionary pickled entry by entry."""

import pickle
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from factory.store.reader import labels_of

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


def write_dict(file: BinaryIO, entries: Iterable[tuple[str, object]], after: Path | None = None) -> None:
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


def write_rewards(draft: Path, labelled: Iterable[tuple[str, Mapping[str, Any]]], earlier: Path | None) -> None:
    """The rewards of tokens and their rows after those of the rounds before.

    A file is cumulative because SimScale opens the last round's for each of the rounds (gtrs_agent.py:231-235).
    """
    with draft.open("w+b") as file:
        write_dict(file, ((token, reward_arrays(row)) for token, row in labelled), earlier)
