"""A pickle is data here: plain values come back equal, and nothing in it ever runs."""

import collections
import io
import os
import pickle
import struct

import numpy as np
import pytest

from factory.readers.base import BadClip
from factory.readers.pickles import load_plain


def roundtrip(value, protocol=4):
    return load_plain(pickle.dumps(value, protocol=protocol), "clip.pkl")


class Evil:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plain_values_come_back_equal_in_every_protocol(protocol):
    value = {
        "a": [1, -2, 2.5, True, None, "text", b"bytes"],
        "b": (1, (2, 3)),
        "c": {4, 5},
        "f64": np.linspace(0.0, 1.0, 7).reshape(7, 1),
        "f32": np.arange(6, dtype=np.float32).reshape(2, 3),
        "flags": np.array([True, False]),
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "big_endian": np.arange(3, dtype=">i4"),
        "scalar": np.float64(3.25),
    }
    got = roundtrip(value, protocol)
    assert got["a"][:6] == value["a"][:6]
    assert got["b"] == value["b"] and got["c"] == value["c"]
    for name in ("f64", "f32", "flags", "fortran", "big_endian", "scalar"):
        np.testing.assert_array_equal(got[name], value[name])
        kept = np.asarray(got[name]).dtype
        assert (kept.kind, kept.itemsize) == (value[name].dtype.kind, value[name].dtype.itemsize)


def test_default_and_ordered_dicts_come_back_as_plain_dicts():
    counts = collections.defaultdict(int, {"car": 3})
    ordered = collections.OrderedDict([("z", 1), ("a", 2)])
    got = roundtrip({"counts": counts, "ordered": ordered})
    assert type(got["counts"]) is dict and got["counts"] == {"car": 3}
    assert list(got["ordered"].items()) == [("z", 1), ("a", 2)]


def test_code_in_a_pickle_never_runs_and_the_refused_global_is_named(tmp_path):
    target = tmp_path / "ran"
    with pytest.raises(BadClip, match=r"clip.pkl: pickle: refused global (posix|nt)\.system"):
        roundtrip({"x": Evil(os.system, f"touch {target}")})
    assert not target.exists()


@pytest.mark.parametrize(
    "function, arguments",
    [(eval, ("1",)), (getattr, ("a", "upper")), (np.load, ("f",)), (bytearray, (10,)), (io.open, ("/etc/passwd",))],
)
def test_callables_that_are_no_container_are_refused(function, arguments):
    with pytest.raises(BadClip, match="refused global"):
        roundtrip(Evil(function, *arguments))


def test_a_container_is_never_a_way_to_a_method_of_it():
    stream = b"\x80\x04\x8c\x08builtins\x8c\x0ddict.fromkeys\x93."
    with pytest.raises(BadClip, match=r"refused global builtins\.dict\.fromkeys"):
        load_plain(stream, "clip.pkl")


def test_arrays_of_objects_are_refused():
    with pytest.raises(BadClip, match="refused array type 'O8'"):
        roundtrip(np.array([{}, []], dtype=object))


@pytest.mark.parametrize("value", [np.zeros(2, dtype=[("x", "f8")]), np.array(["2020"], dtype="M8[s]")])
def test_structured_and_time_arrays_are_refused(value):
    with pytest.raises(BadClip, match="refused"):
        roundtrip(value)


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_stream_is_a_bad_clip_at_any_cut(kept):
    stream = pickle.dumps({"x": np.arange(1000.0), "y": ["text"] * 50})
    with pytest.raises(BadClip, match=r"clip\.pkl: pickle: "):
        load_plain(stream[: int(kept * len(stream))], "clip.pkl")


def test_a_claimed_length_or_memo_index_beyond_the_file_is_refused_before_memory_is_asked_for():
    for stream in (
        b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"x.",  # BINBYTES8 of a terabyte
        b"\x80\x04N" + b"r" + struct.pack("<I", 0xFFFFFFF0) + b".",  # LONG_BINPUT at four billion
    ):
        with pytest.raises(BadClip, match="pickle"):
            load_plain(stream, "clip.pkl")


def test_a_shape_larger_than_its_bytes_is_refused():
    with pytest.raises(BadClip):
        load_plain(pickle.dumps(np.zeros(3)).replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85"), "clip.pkl")
    with pytest.raises(BadClip, match=r"direct call of numpy\.ndarray"):
        roundtrip(Evil(np.ndarray, (1 << 40,)))


def test_copies_of_one_big_value_outgrow_the_budget():
    # One megabyte of bytes, then 1000 arrays that each copy it: 14 kB of opcodes would ask for a gigabyte.
    raw = bytes(1 << 20)
    arrays = [np.frombuffer(raw, np.uint8) for _ in range(1000)]

    class Copies(pickle._Pickler):  # the Python pickler memoises the shared bytes object
        def reducer_override(self, value):
            if isinstance(value, np.ndarray):
                state = (1, (1 << 20,), np.dtype("u1"), False, raw)
                return np.zeros(0).__reduce__()[0], (np.ndarray, (0,), b"b"), state
            return NotImplemented

    out = io.BytesIO()
    Copies(out, 4).dump(arrays)
    assert len(out.getvalue()) < 2 << 20
    with pytest.raises(BadClip, match="outgrow the memory"):
        load_plain(out.getvalue(), "clip.pkl")


def test_persistent_ids_and_extension_codes_are_refused():
    for stream in (b"Pname\n.", b"\x80\x02\x82\x01."):
        with pytest.raises(BadClip, match="opcode"):
            load_plain(stream, "clip.pkl")


DOUBLED = b"2\x86"  # DUP TUPLE2: twice the value before


@pytest.mark.parametrize(
    "stream",
    [
        b"\x80\x04}K\x01" + DOUBLED * 180 + b"K\x01s.",
        b"\x80\x04}K\x01" + DOUBLED * 50 + b"K\x01s.",
        b"\x80\x04\x8f(K\x01" + DOUBLED * 50 + b"\x90.",
        b"\x80\x04(K\x01" + DOUBLED * 50 + b"\x91.",
        b"\x80\x04(K\x01" + DOUBLED * 50 + b"K\x01d.",
        b"\x80\x04}(K\x01" + DOUBLED * 50 + b"K\x01u.",
        b"\x80\x04cbuiltins\nset\n(K\x01" + DOUBLED * 50 + b"l\x85R.",
        b"\x80\x04}cbuiltins\ntuple\n(K\x01" + DOUBLED * 50 + b"l\x85RK\x01s.",
        b"\x80\x04}K\x01" + b"\x85" * 300_000 + b"K\x01s.",
        b"\x80\x04" + b"]" * 100_000 + b"a" * 99_999 + b".",
        b"\x80\x04" + b"}K\x01" * 100_000 + b"}" + b"s" * 100_000 + b".",
    ],
    ids=lambda stream: f"{len(stream)} bytes",
)
def test_keys_that_never_hash_and_nests_that_overflow_are_refused_unread(stream: bytes) -> None:
    """180 pairs of the pair before hold 2^180 values: in 370 bytes a key whose hash never ends."""
    with pytest.raises(BadClip, match=r"clip.pkl: pickle: (a member of|(values nested|a key of).* at byte)"):
        load_plain(stream, "clip.pkl")


def test_keys_of_a_few_values_and_large_tuples_that_are_no_keys_load() -> None:
    value = {(1, ("a", 2.5)): tuple(range(5000)), "deep": [[[[(), {}]]]], "set": {(1, 2), frozenset({(3,)})}}
    for protocol in (0, 2, 4, 5):
        assert roundtrip(value, protocol) == value


def test_what_is_taken_from_an_empty_stack_is_no_pickle() -> None:
    for stream in (b"\x80\x04\x85.", b"\x80\x04a.", b"\x80\x04(s.", b"\x80\x04h\x05.", b"0.", b"1."):
        with pytest.raises(BadClip, match="truncated or not a pickle"):
            load_plain(stream, "clip.pkl")


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_polylines_load_and_count_as_keys_and_references_like_any_values(protocol: int) -> None:
    line = [(0.5 * i, -1.0, 2.5) for i in range(400)]
    value = {"line": line, "again": line[-1], "numbers": [0.25] * 500, "mixed": [1.5, line[3], None, 2, [3.5, 4.5]]}
    got = roundtrip(value, protocol)
    assert got == value and got["again"] is got["line"][-1]
    assert roundtrip({tuple(line[:200]): 1}, protocol) == {tuple(line[:200]): 1}  # 801 values
    for key in (tuple(line[:300]), tuple(map(float, range(1200)))):
        with pytest.raises(BadClip, match="a key of more than"):
            roundtrip({key: 1}, protocol)
    data = pickle.dumps(value, protocol)
    for cut in range(40, len(data), 97):
        with pytest.raises(BadClip):
            load_plain(data[:cut], "clip.pkl")
