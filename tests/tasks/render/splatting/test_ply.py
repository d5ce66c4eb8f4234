"""The standard .ply of 3D Gaussian splatting: what others write is read, what is written has their layout."""

import struct
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tasks.render.splatting import sh
from tasks.render.splatting.formats import from_ply, to_ply
from tasks.render.splatting.gaussians import EMPTY, Gaussians


def some(n: int, count: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        rng.normal(0.0, 30.0, (n, 3)).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        rng.uniform(-6.0, 1.0, (n, 3)).astype(np.float32),
        rng.uniform(0.01, 0.999, n).astype(np.float32),
        rng.uniform(0.0, 1.0, (n, 3)).astype(np.float32),
        rng.normal(0.0, 0.2, (n, count, 3)).astype(np.float32),
    )


def by_hand(values: dict[str, float], kind: str = "float") -> bytes:
    """A file of one Gaussian, its properties in the order given."""
    lines = ["ply", "format binary_little_endian 1.0", "comment by hand", "element vertex 1"]
    lines += [f"property {kind} {name}" for name in values] + ["end_header\n"]
    packed = struct.pack("<" + {"float": "f", "double": "d"}[kind] * len(values), *values.values())
    return "\n".join(lines).encode() + packed


PLAIN = {
    "x": 1.0,
    "y": 2.0,
    "z": 3.0,
    "f_dc_0": 1.0,
    "f_dc_1": 0.0,
    "f_dc_2": -1.0,
    "opacity": 0.0,
    "scale_0": -1.0,
    "scale_1": -2.0,
    "scale_2": -3.0,
    "rot_0": 2.0,
    "rot_1": 0.0,
    "rot_2": 0.0,
    "rot_3": 0.0,
}
REST = {f"f_rest_{i}": float(i) for i in range(24)}


@pytest.mark.parametrize("count", sh.COUNTS)
def test_every_degree_comes_back_as_it_was(count: int) -> None:
    scene = some(40, count)
    back = from_ply(to_ply(scene))
    for name, atol in (("means", 0.0), ("log_scales", 0.0), ("sh_rest", 0.0), ("quats", 1e-7), ("colours", 1e-6)):
        np.testing.assert_allclose(getattr(back, name), getattr(scene, name), rtol=0.0, atol=atol, err_msg=name)
    np.testing.assert_allclose(back.opacities, scene.opacities, atol=1e-6)
    assert to_ply(from_ply(to_ply(back))) == to_ply(back)


def test_the_file_has_the_properties_in_the_order_of_the_first_implementation() -> None:
    header = to_ply(some(2, 3)).split(b"end_header\n")[0].decode().splitlines()
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6"
    names += " f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert header[3:] == [f"property float {name}" for name in names.split()]


@pytest.mark.parametrize("kind", ["float", "double"])
def test_a_file_without_normals_and_in_another_order_is_read_by_its_names(kind: str) -> None:
    values = dict(reversed((PLAIN | REST | {"segment": 7.0}).items()))
    scene = from_ply(by_hand(values, kind))
    np.testing.assert_array_equal(scene.means, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(scene.colours[0], 0.5 + 0.28209479177387814 * np.array([1.0, 0.0, -1.0]), atol=1e-7)
    np.testing.assert_array_equal(scene.opacities, [0.5])
    np.testing.assert_array_equal(scene.log_scales, [[-1.0, -2.0, -3.0]])
    np.testing.assert_array_equal(scene.quats, [[1.0, 0.0, 0.0, 0.0]])  # not unit in the file
    np.testing.assert_array_equal(scene.sh_rest[0, :, 0], np.arange(8))  # red first, then green, then blue
    np.testing.assert_array_equal(scene.sh_rest[0, :, 2], np.arange(16, 24))


def test_opacities_at_the_bounds_stay_finite_and_no_gaussian_is_a_file_too() -> None:
    scene = replace(some(2, 0), opacities=np.array([0.0, 1.0], np.float32))
    np.testing.assert_allclose(from_ply(to_ply(scene)).opacities, scene.opacities, atol=1e-6)
    saturated = from_ply(by_hand(PLAIN | {"opacity": 80.0})).opacities
    assert 0.999999 < saturated[0] < 1.0
    assert len(from_ply(to_ply(EMPTY))) == 0


@pytest.mark.parametrize("name", sorted(PLAIN))
def test_an_absent_property_is_named(name: str) -> None:
    values = {key: value for key, value in PLAIN.items() if key != name}
    with pytest.raises(ValueError, match=f"property {name}: absent"):
        from_ply(by_hand(values))


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "value"), [(name, NAN) for name in ("z", "opacity", "f_rest_3", "rot_2")] + [("z", INF), ("rot_2", INF)]
)
def test_nan_and_infinity_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"property {name}: 1 of 1 values"):
        from_ply(by_hand(PLAIN | REST | {name: value}))


def test_a_logit_without_bound_is_an_opacity_of_0_or_1() -> None:
    """As the tools of .spz write them, whose 8 bits know both."""
    for logit, opacity in ((float("inf"), 1.0), (float("-inf"), 0.0)):
        found = from_ply(by_hand(PLAIN | {"opacity": logit})).opacities
        assert 0.0 < found[0] < 1.0 and found[0] == pytest.approx(opacity, abs=1e-6)


WHOLE = by_hand(PLAIN)
FAULTS = {
    "magic": (b"PLY" + WHOLE[3:], "magic"),
    "empty": (b"", "magic"),
    "no end": (WHOLE.replace(b"end_header", b"and_header"), "end_header"),
    "ascii": (WHOLE.replace(b"binary_little_endian", b"ascii"), "format: ascii 1.0, expected"),
    "big endian": (WHOLE.replace(b"little", b"big"), "format: binary_big_endian"),
    "no format": (WHOLE.replace(b"format binary_little_endian 1.0\n", b""), "format: absent"),
    "type": (WHOLE.replace(b"float opacity", b"uint opacity"), "property opacity: expected float"),
    "unknown type": (WHOLE.replace(b"float y", b"vec3 y"), "'property vec3 y'"),
    "list": (WHOLE.replace(b"float y", b"list uchar int y"), "list uchar int y"),
    "twice": (WHOLE.replace(b"float y", b"float x"), "property x: stands twice"),
    "truncated": (WHOLE[:-3], "vertex: 1 rows of 56 bytes announced, 53 found: truncated"),
    "too long": (WHOLE + b"\0", "something follows"),
    "count": (WHOLE.replace(b"vertex 1", b"vertex 9999999999999999"), "truncated"),
    "negative": (WHOLE.replace(b"vertex 1", b"vertex -1"), "'element vertex -1'"),
    "no vertex": (WHOLE.replace(b"vertex", b"points"), "found points"),
    "compressed": (
        WHOLE.replace(b"element vertex", b"element chunk 1\nproperty float min_x\nelement vertex"),
        "a compressed scene",
    ),
    "zero rotation": (by_hand(PLAIN | {"rot_0": 0.0}), "rot: 1 rotations are all zero"),
    "rest": (by_hand(PLAIN | {"f_rest_0": 0.0}), "f_rest: 1 coefficients"),
    "gap in rest": (by_hand(PLAIN | {f"f_rest_{i + 1}": 0.0 for i in range(9)}), "property f_rest_0: absent"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_file_is_refused_with_the_field_that_is_wrong(fault: str) -> None:
    data, said = FAULTS[fault]
    with pytest.raises(ValueError, match=said):
        from_ply(data)


def test_a_scene_with_nan_is_not_written() -> None:
    scene = some(3, 0)
    scene.means[1, 2] = np.nan
    with pytest.raises(ValueError, match="ply: x, y, z: NaN"):
        to_ply(scene)


@given(st.binary(max_size=8), st.integers(0, len(WHOLE) - 1))
def test_no_damage_is_worse_than_a_value_error(noise: bytes, at: int) -> None:
    with suppress(ValueError):
        from_ply(WHOLE[:at] + noise + WHOLE[at + len(noise) :])
