"""What NAVSIM's loaders read: names of source logs, and pickles of any size by the numpy that it pins."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from factory.datasets.navsim.frames import hex16, source_log_name
from factory.datasets.navsim.pickles import dumps, write_pickled_dict


@pytest.mark.parametrize(
    ("log_id", "name"),
    [
        ("2021.05.12.22.00.38_veh-35_01008_01518", "2021.05.12.22.00.38_veh-35_01008_01518"),
        ("02678d04-cc9f-3148-9f95-1ba66347dff9", "02678d04_cc9f_3148_9f95_1ba66347dff9-{}"),
        ("town_0", "town_0-{}"),
        ("a b/c-d", "a_b_c_d-{}"),
    ],
)
def test_a_source_log_s_name_has_one_dash(log_id: str, name: str) -> None:
    assert source_log_name("av2", log_id) == name.format(hex16("av2", log_id)[:8])
    assert source_log_name("av2", log_id).count("-") == 1


def test_a_dictionary_of_any_size_is_pickled_entry_by_entry(tmp_path: Path) -> None:
    """And one goes on behind another; equal strings and shared arrays do not lead from one entry to another."""
    shared = np.arange(3.0)
    first = {"a": {"x": shared, "y": shared}, "b": ["text", "text"]}
    second = {"c": shared, "a2": {"x": np.float16([1, 2])}}
    for name, entries, after in (("1", first, None), ("2", second, tmp_path / "1")):
        with (tmp_path / name).open("w+b") as file:
            write_pickled_dict(file, entries.items(), after)
    np.testing.assert_equal(pickle.loads((tmp_path / "1").read_bytes()), first)
    np.testing.assert_equal(pickle.loads((tmp_path / "2").read_bytes()), first | second)
    assert list(pickle.loads((tmp_path / "2").read_bytes())) == ["a", "b", "c", "a2"]


def test_pickles_name_the_numpy_that_navsim_pins() -> None:
    data = dumps({"a": np.zeros(2), "b": np.array(["x"])})
    assert b"numpy.core.multiarray" in data and b"numpy._core" not in data
    np.testing.assert_equal(pickle.loads(data), {"a": np.zeros(2), "b": np.array(["x"])})
