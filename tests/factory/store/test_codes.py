"""Texts as numbers: what is counted over millions of rows is what a loop over a few would count."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factory.store import table
from factory.store.table import (
    PACKED_ROWS,
    KeyIndex,
    distinct_rows,
    fixed_bytes,
    keys_with_prefix,
    packed_tables,
    text_codes,
    text_equals,
)

WORDS = st.lists(st.sampled_from(["", "a", "ab", "b", "é", "z"]), max_size=12)
PARTS = st.lists(WORDS, max_size=5)


@settings(max_examples=50, deadline=None)
@given(parts=PARTS, encoded=st.booleans())
def test_codes_number_the_different_texts_in_their_order(parts: list[list[str]], encoded: bool) -> None:
    chunks = [pa.array(words, pa.string()) for words in parts]
    kind = pa.dictionary(pa.int32(), pa.string()) if encoded else pa.string()
    column = pa.chunked_array([chunk.dictionary_encode() if encoded else chunk for chunk in chunks], kind)
    numbers, texts = text_codes(column)
    flat = [word for words in parts for word in words]
    assert texts == tuple(sorted(set(flat))) and [texts[i] for i in numbers] == flat
    assert text_equals(column, "ab").tolist() == [word == "ab" for word in flat]


@settings(max_examples=50, deadline=None)
@given(rows=st.lists(st.tuples(st.integers(0, 3), st.integers(0, 40), st.integers(0, 2)), max_size=20))
def test_distinct_rows_are_those_of_a_set(rows: list[tuple[int, int, int]]) -> None:
    columns = [np.array([row[i] for row in rows], np.int32) for i in range(3)]
    found, at = distinct_rows(columns)
    assert list(map(tuple, found.tolist())) == sorted(set(rows))
    assert [tuple(found[i].tolist()) for i in at] == rows


@settings(max_examples=50, deadline=None)
@given(keys=st.sets(st.text("aé\U0001f600", min_size=1, max_size=4)), prefix=st.text("aé\U0001f600", max_size=5))
def test_what_begins_so_is_found_in_sorted_keys(keys: set[str], prefix: str) -> None:
    array = np.sort(fixed_bytes(pa.array(sorted(keys), pa.string())))
    assert keys_with_prefix(array, prefix) == [key for key in sorted(keys) if key.startswith(prefix)]


def test_packed_rows_are_the_same_in_fewer_tables() -> None:
    n = PACKED_ROWS // 4
    parts = [pa.table({"key": [f"{i}-{j}" for j in range(n)], "x": ["a", f"b{i}"] * (n // 2)}) for i in range(10)]
    found = list(packed_tables(parts, "key"))
    assert [rows.num_rows for rows in found] == [4 * n, 4 * n, 2 * n]
    assert all(pa.types.is_dictionary(rows.schema.field("x").type) for rows in found)
    assert all(column.num_chunks == 1 for rows in found for column in rows.columns)
    whole = pa.concat_tables(found).cast(parts[0].schema)
    assert whole.equals(pa.concat_tables(parts).combine_chunks())
    assert list(packed_tables([], "key")) == []


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
