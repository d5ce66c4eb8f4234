"""A short fuzz of every kind of file; the full one: `make chaos`."""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from factory.readers.apart import ProcessFunction
from tests.chaos.damaged_files.fuzz import Question, answer, fuzzed
from tests.chaos.damaged_files.fuzzed_kinds import KINDS, write_all
from tests.chaos.damaged_files.mutants_of_files import rng_of

pytestmark = pytest.mark.slow  # a town is painted, and each kind's reader is warmed in the other process

SHORT = 10


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    path = tmp_path_factory.mktemp("fuzzed")
    write_all(path)
    logging.disable()
    yield path
    logging.disable(logging.NOTSET)  # other tests of this process look at what is logged


@pytest.mark.parametrize("kind", KINDS)
def test_a_mutant_is_accepted_or_refused_and_does_nothing_else(folder: Path, kind: str) -> None:
    said: list[str] = []
    told = fuzzed(folder, kind, range(SHORT), said.append)
    assert not said and sum(told.values()) == SHORT


FOUND = [
    ("pickle, OpenScene", 453),  # the same
    ("pickle, OpenScene", 3297),  # a camera whose path is an array
    ("yaml, a scene filter", 10),  # no text
    ("feather, intrinsics", 1645),  # a column whose name is no text
    ("mcap", 1909),  # an opcode that no checksum covers
]


REPAIRED = [
    ("json, a map", 284),  # an int beyond a float
    ("arrow, 123D's map", 55),  # a lane of 10^100 km
]


@pytest.mark.parametrize(("kind", "number"), [*FOUND, *REPAIRED])
def test_what_was_found_stays_found(folder: Path, kind: str, number: int) -> None:
    left_out = "accepted" if (kind, number) in REPAIRED else "refused"
    assert ProcessFunction(answer)(Question(str(folder), kind, number), kind) == left_out


def test_a_mutant_is_the_same_again_and_no_copy(folder: Path) -> None:
    for kind, opened in KINDS.items():
        readable = opened(folder)
        whole = readable.path.read_bytes()
        mutants = [readable.mutant(whole, rng_of(kind, number)) for number in (0, 1, 2, 0)]
        assert mutants[0] == mutants[3] and len({*mutants, whole}) >= 3, kind
