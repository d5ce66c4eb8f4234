"""A clip says what was repaired in its log, wherever it is kept; and a reader may be one that refuses such clips."""

import pickle
from dataclasses import replace

import pytest

from examples.csv_logs import write_log
from factory.readers.base import BadClip, RefusesRepairs, read_clip, validate_clip
from factory.store.location import decode_tree, encode_tree
from tasks.world.clip import Clip
from tests.factory.repaired_logs import CROSSING, GAP, IMPOSSIBLE, LATE, SECOND_GAP, WHOLE, RepairedReader


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> RepairedReader:
    """Of two logs, the second of which is whole."""
    root = tmp_path_factory.mktemp("logs")
    write_log(root / "street")
    write_log(root / WHOLE)
    return RepairedReader(root, stride_s=2.4)


def clip_of(reader: RepairedReader, log_id: str, nth: int = 0) -> Clip:
    return read_clip(reader, [ref for ref in reader.index().refs if ref.log_id == log_id][nth])


def test_a_clip_has_the_repairs_of_its_window_and_of_the_whole_log(reader: RepairedReader) -> None:
    assert clip_of(reader, "street").repairs == (GAP, SECOND_GAP, IMPOSSIBLE, CROSSING)
    assert clip_of(reader, "street", 1).repairs == (SECOND_GAP, IMPOSSIBLE, CROSSING, LATE)
    assert clip_of(reader, WHOLE).repairs == ()


def test_a_clip_comes_out_of_the_cache_with_its_repairs(reader: RepairedReader) -> None:
    clip = clip_of(reader, "street")
    kept = decode_tree(encode_tree(clip))
    assert isinstance(kept, Clip) and repr(kept.repairs) == repr(clip.repairs)  # NaN differs from itself


def test_a_reader_that_refuses_repairs_names_the_first_how_many_and_the_way_out(reader: RepairedReader) -> None:
    strict = pickle.loads(pickle.dumps(RefusesRepairs(reader)))
    assert strict.index() == reader.index() and strict.name == reader.name and strict.root == reader.root
    ref = next(ref for ref in reader.index().refs if ref.log_id == "street")
    with pytest.raises(BadClip) as caught:
        read_clip(strict, ref)
    assert str(caught.value) == (
        f"clip {ref.clip_id} (csv street at 0 s): repairs: 4 repairs, the first (crossing): pc_1: a bow tie of 62 m2 "
        "-> a ring of 429 m2; put it right in the log, or read the clip with repairs=make, the default"
    )


def test_a_reader_that_refuses_repairs_reads_whole_clips_and_has_what_the_reader_has_beside(
    reader: RepairedReader,
) -> None:
    strict = RefusesRepairs(reader)
    ref = next(ref for ref in reader.index().refs if ref.log_id == WHOLE)
    assert read_clip(strict, ref).content_digest == clip_of(reader, WHOLE).content_digest
    assert not hasattr(strict, "painter") and strict.log_digest is not None
    with pytest.raises(AttributeError):
        strict.nothing_of_the_kind  # noqa: B018


def test_repairs_that_are_none_are_a_fault_of_the_clip(reader: RepairedReader) -> None:
    odd = replace(clip_of(reader, WHOLE), repairs=("gap",))  # type: ignore[arg-type]
    with pytest.raises(BadClip, match="repairs: expected"):
        validate_clip(odd, "a file")
