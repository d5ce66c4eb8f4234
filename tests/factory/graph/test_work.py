"""The key of an attempt: the same for the same attempt anywhere, another for every other one."""

import pytest

from factory.store.schema import RunIdentity, attempt_id

KEY = {"clip_id": "clip", "candidate": 3, "vocabulary_digest": "v1", "expert": "recovery", "expert_digest": "table-1"}


@pytest.mark.parametrize(
    ("part", "other"),
    [
        ("clip_id", "clip2"),
        ("candidate", 4),
        ("vocabulary_digest", "v2"),
        ("expert", "pdm_closed"),
        ("expert_digest", "table-2"),
    ],
)
def test_an_attempt_is_another_one_when_any_of_its_inputs_is(part: str, other: object) -> None:
    assert attempt_id(**KEY) != attempt_id(**(KEY | {part: other}))  # type: ignore[arg-type]
    assert attempt_id(**KEY) == attempt_id(**KEY)  # type: ignore[arg-type]


def test_where_one_input_ends_and_the_next_begins_is_part_of_the_key() -> None:
    assert attempt_id("clip1", 2, "v", "human", "d") != attempt_id("clip", 12, "v", "human", "d")
    assert attempt_id("clip", 1, "2v", "human", "d") != attempt_id("clip", 12, "v", "human", "d")


def test_settings_are_one_whatever_their_order_and_another_with_any_other_value() -> None:
    def hash_of(**settings: object) -> str:
        return RunIdentity(settings, {}, "v", "p").settings_hash

    assert hash_of(a=1, b=2.5) == hash_of(b=2.5, a=1)
    assert len({hash_of(a=1, b=2.5), hash_of(a=1, b=2.6), hash_of(a=1), hash_of(a=1, c=2.5)}) == 4
