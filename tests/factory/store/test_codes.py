"""The index of a table's keys: a dict that takes little, and what begins so in it."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factory.store import table
from factory.store.table import (
    KeyIndex,
    fixed_bytes,
    keys_with_prefix,
)


@settings(max_examples=50, deadline=None)
@given(keys=st.sets(st.text("aé\U0001f600", min_size=1, max_size=4)), prefix=st.text("aé\U0001f600", max_size=5))
def test_what_begins_so_is_found_in_sorted_keys(keys: set[str], prefix: str) -> None:
    array = np.sort(fixed_bytes(pa.array(sorted(keys), pa.string())))
    assert keys_with_prefix(array, prefix) == [key for key in sorted(keys) if key.startswith(prefix)]


# The index of a table's keys is a dict that takes little.

KEYS = st.text("abcdé", min_size=1, max_size=4)
CHANGES = st.lists(st.tuples(st.sets(KEYS), st.dictionaries(KEYS, st.sampled_from(["x", "y", "z"]))))


@pytest.mark.parametrize("merged_at", [0, 3, 1000])
@settings(max_examples=25, deadline=None)
@given(known=st.dictionaries(KEYS, st.sampled_from(["x", "y"])), changes=CHANGES, asked=st.sets(KEYS))
def test_it_finds_what_a_dict_finds(
    merged_at: int, known: dict[str, str], changes: list[tuple[set[str], dict[str, str]]], asked: set[str]
) -> None:
    files = [(path, pa.array([key for key, of in known.items() if of == path], pa.string())) for path in ("x", "y")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(table, "MERGED_AT", merged_at)
        index, there = KeyIndex((path, pa.chunked_array([keys])) for path, keys in files), dict(known)
        for drop, add in changes:
            index.update(drop, add)
            there = {key: path for key, path in there.items() if key not in drop} | add
            assert index.files_of(asked) == {key: there[key] for key in asked if key in there}
        assert index.files_of(there) == there
        assert sorted(index) == sorted(there) and len(index) == len(there)
