"""Random streams: the same everywhere, different for everything they are drawn for."""

from itertools import combinations

import numpy as np

from tasks.world.clip import random_stream


def draws(*words: object) -> np.ndarray:
    return random_stream(*words).random(4)  # type: ignore[arg-type]


def test_equal_arguments_give_equal_numbers_on_every_machine() -> None:
    """Recorded once: Philox keyed by SHA-256 is the same for every numpy and processor."""
    expected = [63_895, 127_121, 976_219]
    np.testing.assert_array_equal(random_stream(7, "clip", "perturb").integers(0, 1_000_000, 3), expected)
    np.testing.assert_array_equal(draws(7, "clip", "perturb"), draws(7, "clip", "perturb"))


def test_every_argument_starts_another_stream() -> None:
    streams = [
        draws(0, "clip", "perturb"),
        draws(1, "clip", "perturb"),
        draws(0, "clip2", "perturb"),
        draws(0, "clip", "expert"),
        draws(0, "clip", "perturb", 0),
        draws(0, "clip", "perturb", 1),
        draws(0, "clipp", "erturb"),  # words do not run into each other
    ]
    assert all(not np.array_equal(a, b) for a, b in combinations(streams, 2))


def test_a_stream_does_not_know_what_was_drawn_before() -> None:
    np.random.default_rng(0).random(100)
    first = draws(0, "a", "expert.recovery", 5)
    draws(0, "a", "expert.recovery", 4)
    np.testing.assert_array_equal(first, draws(0, "a", "expert.recovery", 5))
