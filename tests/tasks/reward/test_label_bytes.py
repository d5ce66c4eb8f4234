"""Vocabulary labels as bytes: they come back as they went in, damage is seen, EP and score are the reward's."""

import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from tasks.reward.epdms import relative_progress
from tasks.reward.label_bytes import (
    CRC_BYTES,
    HALVES,
    MAX_PROGRESS_M,
    N_PLANES,
    UNITS_PER_M,
    WHOLES,
    VocabularyLabels,
    decode,
    encode,
)
from tasks.subscores import MULTIPLIERS


def labels_from(rng: np.random.Generator, k: int, reference_m: float = 20.0) -> VocabularyLabels:
    scores = {name: rng.integers(0, 3, k) / 2.0 for name in HALVES}
    scores |= {name: rng.integers(0, 2, k) * 1.0 for name in WHOLES}
    return VocabularyLabels("abc", reference_m, ep_raw_m=rng.random(k) * 80.0, **scores)


def through_bytes(labels: VocabularyLabels) -> VocabularyLabels:
    return decode(
        *encode(labels),
        vocabulary=labels.vocabulary,
        reference_progress_m=labels.reference_progress_m,
    )


@st.composite
def any_labels(draw: st.DrawFn) -> VocabularyLabels:
    k = draw(st.integers(1, 40))
    halves = {name: draw(arrays(float, k, elements=st.sampled_from([0.0, 0.5, 1.0]))) for name in HALVES}
    wholes = {name: draw(arrays(float, k, elements=st.sampled_from([0.0, 1.0]))) for name in WHOLES}
    edges = st.sampled_from([0.0, 5.0, np.nextafter(5.0, 9.0), np.nextafter(5.0, 0.0), 10.0, 256.0 / UNITS_PER_M])
    metres = draw(arrays(float, k, elements=st.one_of(st.floats(0.0, MAX_PROGRESS_M), edges)))
    return VocabularyLabels("abc", draw(st.floats(0.0, 80.0)), ep_raw_m=metres, **halves, **wholes)


@given(any_labels())
def test_sub_scores_come_back_as_they_went_in_and_progress_up_to_its_unit(labels: VocabularyLabels) -> None:
    back = through_bytes(labels)
    assert (back.vocabulary, back.reference_progress_m) == ("abc", labels.reference_progress_m)
    for name in (*HALVES, *WHOLES):
        np.testing.assert_array_equal(getattr(back, name), getattr(labels, name))
    rounded_up = back.ep_raw_m - labels.ep_raw_m
    assert (rounded_up >= 0.0).all() and (rounded_up < 1.0 / UNITS_PER_M + 1e-12).all()
    np.testing.assert_array_equal(back.ep_raw_m > 5.0, labels.ep_raw_m > 5.0)
    again = through_bytes(back)
    np.testing.assert_array_equal(again.ep_raw_m, back.ep_raw_m)


@pytest.mark.slow
@given(any_labels())
def test_rounding_moves_progress_by_at_most_its_unit_over_five_metres(labels: VocabularyLabels) -> None:
    back = through_bytes(labels)
    for normalise in ("pairs", "batch"):
        assert np.abs(back.ep(normalise) - labels.ep(normalise)).max() <= 2.0 / UNITS_PER_M / 5.0  # type: ignore[arg-type]


@pytest.mark.slow
@given(any_labels())
def test_progress_and_score_are_those_of_the_reward(labels: VocabularyLabels) -> None:
    """Row 0 of the reward's batch is PDM-Closed, here with all it was stored of it: its compliant progress."""
    np.testing.assert_array_equal(labels.multiplier, np.prod([getattr(labels, name) for name in MULTIPLIERS], axis=0))
    metres = np.append(labels.reference_progress_m, labels.ep_raw_m)
    multiplier = np.append(1.0, labels.multiplier)
    for normalise in ("pairs", "batch"):
        ep = relative_progress(metres, multiplier, normalise == "pairs")[1:]  # type: ignore[arg-type]
        np.testing.assert_array_equal(labels.ep(normalise), ep)  # type: ignore[arg-type]
        weighted = 5.0 * ep + 5.0 * labels.ttc + 2.0 * labels.lk + 2.0 * labels.hc
        np.testing.assert_allclose(labels.pdm_score(normalise), labels.multiplier * weighted / 14.0, atol=1e-15)  # type: ignore[arg-type]


def test_masked_progress_is_that_of_the_compliant_metres() -> None:
    """Rows: compliant, half a collision, off the road, more than the reference, half of more; then a short scene."""
    nc, dac, metres = [1.0, 0.5, 1.0, 1.0, 0.5], [1.0, 1.0, 0.0, 1.0, 1.0], [10.0, 16.0, 30.0, 40.0, 60.0]
    ones = np.ones(5)
    labels = VocabularyLabels("v", 20.0, np.array(nc), np.array(dac), *[ones] * 5, np.array(metres))
    np.testing.assert_array_equal(labels.ep("masked"), [0.5, 0.4, 0.0, 1.0, 1.0])
    np.testing.assert_array_equal(labels.ep("pairs"), [0.5, 0.8, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(labels.pdm_score("masked")[:3], [11.5 / 14.0, 5.5 / 14.0, 0.0], rtol=0, atol=1e-15)
    short = replace(labels, reference_progress_m=5.0, ep_raw_m=labels.ep_raw_m / 10.0)
    np.testing.assert_array_equal(short.ep("masked"), ones)


@pytest.mark.parametrize("k", [1, 7, 8, 9, 1024, 16384])
def test_the_bytes_are_as_many_as_the_docs_say(k: int) -> None:
    subscores, progress = encode(labels_from(np.random.default_rng(k), k))
    assert len(subscores) == 9 * -(-k // 8) + 4
    assert len(progress) == 2 * k + 4


def test_the_bits_lie_where_the_docs_say() -> None:
    labels = labels_from(np.random.default_rng(0), 12)
    subscores, progress = encode(labels)
    planes = np.unpackbits(np.frombuffer(subscores[:-CRC_BYTES], np.uint8).reshape(N_PLANES, 2), axis=1)[:, :12]
    halved = [labels.nc == 1.0, labels.nc == 0.5, labels.ddc == 1.0, labels.ddc == 0.5]
    whole = [getattr(labels, name) == 1.0 for name in ("dac", "tlc", "ttc", "lk", "hc")]
    np.testing.assert_array_equal(planes, np.array(halved + whole))
    units = np.ceil(labels.ep_raw_m * 128.0).astype(int)
    assert list(progress[:12]) == (units % 256).tolist() and list(progress[12:24]) == (units // 256).tolist()


@given(st.integers(0, 10**6), st.integers(0, 7), st.booleans())
def test_one_flipped_bit_is_seen(place: int, bit: int, in_progress: bool) -> None:
    made = [bytearray(part) for part in encode(labels_from(np.random.default_rng(1), 50))]
    damaged = made[in_progress]
    damaged[place % len(damaged)] ^= 1 << bit
    with pytest.raises(ValueError, match="^progress: " if in_progress else "^subscores: "):
        decode(*map(bytes, made), vocabulary="abc", reference_progress_m=1.0)


@pytest.mark.parametrize("cut", [0, 1, 3, 4, 20])
def test_bytes_of_another_length_are_refused(cut: int) -> None:
    subscores, progress = encode(labels_from(np.random.default_rng(2), 50))
    header = {"vocabulary": "abc", "reference_progress_m": 1.0}
    for a, b in ((subscores[:cut], progress), (subscores, progress[:cut])):
        with pytest.raises(ValueError, match="checksum"):
            decode(a, b, **header)  # type: ignore[arg-type]
    other = encode(labels_from(np.random.default_rng(2), 60))
    with pytest.raises(ValueError, match=r"subscores: 72 bytes, 63 expected for 50 trajectories"):
        decode(other[0], progress, **header)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("nc", 0.25, r"nc: must be 0, 0\.5 or 1"),
        ("dac", 0.5, "dac: must be 0 or 1"),
        ("hc", np.nan, "hc: must be 0 or 1"),
        ("ep_raw_m", 600.0, r"ep_raw_m: must lie within 0 \.\. 511\.99 m"),
        ("ep_raw_m", -0.001, "ep_raw_m"),
        ("ep_raw_m", np.nan, "ep_raw_m"),
    ],
)
def test_a_value_that_the_bytes_cannot_say_is_refused_by_name(name: str, value: float, message: str) -> None:
    labels = labels_from(np.random.default_rng(3), 9)
    column: NDArray[np.float64] = getattr(labels, name).copy()
    column[4] = value
    with pytest.raises(ValueError, match=message):
        encode(replace(labels, **{name: column}))


def test_columns_of_different_lengths_are_refused_by_name() -> None:
    labels = labels_from(np.random.default_rng(4), 9)
    with pytest.raises(ValueError, match="lk: "):
        encode(replace(labels, lk=labels.lk[1:]))


def test_every_array_of_the_labels_is_in_the_bytes() -> None:
    arrays_of = {f.name for f in fields(VocabularyLabels)} - {"vocabulary", "reference_progress_m"}
    assert arrays_of == {*HALVES, *WHOLES, "ep_raw_m"}


def test_decoding_needs_numpy_only() -> None:
    code = (
        "import sys, tasks.reward.label_bytes; "
        "sys.exit(bool({'numba', 'shapely', 'scipy', 'pyarrow', 'torch'} & {m.split('.')[0] for m in sys.modules}))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
