"""Scenes from the checkpoints of other programs, and into them: names and arrays, no file and no torch.

* nerfstudio's splatfacto (50e0e3c): `pipeline` holds `_model.gauss_params.<parameter>`, in old files
  `_model.<parameter>`
* MTGS (8e16dbb): `pipeline` holds `_model.gaussian_models.<part>.gauss_params.<parameter>`; parts are `background`,
  `skybox`, `rigid_object_<token>`, `deformable_node_<token>`
* WorldEngine (a14fd10, render/mtgs/mtgs.py): part -> `config` and `state_dict` with `gauss_params.<parameter>`

Parameters: means, log scales (one or three), quaternions w first and not of length 1, logits of opacity, features_dc
and features_rest, which are coefficients of spherical harmonics, or without any of the latter logits of colours.

What a scene here does not have is made one value: colours that traversals give a point by `features_adapters` are those
of one traversal or their mean; a vehicle's that change with time or with the side it is seen from, as sums of waves,
are their mean; coefficients of a vehicle, there of directions in the world, are turned into its box at the pose that it
has in the middle of its log. Bending bodies need their network and are left out by name.
"""

import gzip
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians, concatenate, quats_of, rotations_of
from tasks.render.splatting.project import ANTIALIASED, ScreenFilter
from tasks.world.arrays import F32, Array

# Gaussians as the bytes of a standard 3D Gaussian splatting `.ply`, and back.
#
# The format of Kerbl et al. 2023, which gsplat, nerfstudio (and MTGS, which is built on it) and SuperSplat read and
# write: one element `vertex` of floats, binary little endian: x y z nx ny nz, f_dc_0..2, f_rest_*, opacity,
# scale_0..2, rot_0..3. Opacity is a logit, scales are natural logs, rotations are w first and need not be unit;
# f_rest counts channel by channel (all of red, then green, then blue). Properties are found by name: gsplat leaves
# the normals out, editors add others. Nothing says where the frame's origin lies in the world; that stays with the
# scene.

FORMAT = "binary_little_endian 1.0"
MAX_HEADER_BYTES = 1 << 16
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
POSITION, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
REQUIRED = (*POSITION, *COLOUR, "opacity", *SCALE, *ROTATION)
LEAST, MOST = np.float32(2.0**-24), np.float32(1.0 - 2.0**-24)  # opacities whose logit is finite in 32 bits


def to_ply(gaussians: Gaussians) -> bytes:
    """The file's bytes, with the normals that old viewers ask for as zeros. Raises ValueError for NaN or infinity."""
    count = gaussians.sh_rest.shape[1]
    opacity = np.clip(gaussians.opacities, LEAST, MOST).astype(np.float64)
    columns = {
        POSITION: gaussians.means,
        NORMAL: np.zeros((len(gaussians), 3), np.float32),
        COLOUR: (gaussians.colours - 0.5) / sh.C0,
        _rest(3 * count): gaussians.sh_rest.transpose(0, 2, 1).reshape(len(gaussians), 3 * count),
        ("opacity",): np.log(opacity / (1.0 - opacity))[:, None],
        SCALE: gaussians.log_scales,
        ROTATION: gaussians.quats,
    }
    for group, values in columns.items():
        if not np.isfinite(values).all():
            raise ValueError(f"ply: {', '.join(group[:3])}: NaN or infinity")
    names = [name for group in columns for name in group]
    header = ["ply", f"format {FORMAT}", f"element vertex {len(gaussians)}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    rows = np.concatenate(list(columns.values()), axis=1).astype("<f4")
    return "\n".join(header).encode() + rows.tobytes()


def from_ply(data: bytes) -> Gaussians:
    """The Gaussians of a file, SH degree 0 to 3, rotations made unit.

    Raises ValueError that names the field: for a file that is ascii, compressed or no ply, for properties that are
    absent or of another type than float, truncated data, NaN and, but for an opacity, infinity.
    """
    header = _header(data)
    absent = [name for name in REQUIRED if name not in header.types]
    if absent:
        raise ValueError(f"ply: property {', '.join(absent)}: absent from element vertex, this is no 3DGS scene")
    found = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in header.types)
    if found not in [3 * count for count in sh.COUNTS]:
        raise ValueError(f"ply: f_rest: {found} coefficients, expected 0, 9, 24 or 45")
    rest = _rest(found)
    missing = [name for name in rest if name not in header.types]
    if missing:
        raise ValueError(f"ply: property {missing[0]}: absent, while there are {found} f_rest coefficients")
    for name in (*REQUIRED, *rest):
        if header.types[name] not in ("<f4", "<f8"):
            raise ValueError(f"ply: property {name}: expected float, found {header.types[name]}")
    table = _table(data, header)
    quats = _columns(table, ROTATION).astype(np.float64)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    if not (length > 0.0).all():
        raise ValueError(f"ply: rot: {int((length == 0.0).sum())} rotations are all zero")
    logit = _columns(table, ("opacity",), infinite=True)[:, 0].astype(np.float64)  # of 0 and 1, as spz's tools write
    coefficients = _columns(table, rest).reshape(len(table), 3, found // 3).transpose(0, 2, 1)
    return Gaussians(
        means=_columns(table, POSITION),
        quats=(quats / length).astype(np.float32),
        log_scales=_columns(table, SCALE),
        opacities=np.clip(0.5 + 0.5 * np.tanh(0.5 * logit), LEAST, MOST).astype(np.float32),
        colours=(0.5 + sh.C0 * _columns(table, COLOUR)).astype(np.float32),
        sh_rest=np.ascontiguousarray(coefficients),
    )


@dataclass(frozen=True)
class _Header:
    types: dict[str, str]  # property -> numpy's name of its type, in the order of the file
    count: int  # rows of element vertex
    start: int  # byte at which they begin
    is_last: bool  # no other element follows


def _header(data: bytes) -> _Header:
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise ValueError("ply: magic: the file does not begin with the line 'ply'")
    end = re.search(rb"\nend_header\r?\n", data[:MAX_HEADER_BYTES])
    if end is None:
        raise ValueError(f"ply: end_header: not within the first {MAX_HEADER_BYTES} bytes")
    types: dict[str, str] = {}
    elements: list[str] = []
    count, form = 0, ""
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", *words]:
                form = " ".join(words)
            case ["element", name, number] if number.isascii() and number.isdigit():
                elements.append(name)
                count = int(number) if name == "vertex" else count
            case ["property", kind, name] if kind in TYPES and elements:
                if elements[-1] == "vertex":
                    if name in types:
                        raise ValueError(f"ply: property {name}: stands twice")
                    types[name] = TYPES[kind]
            case ["property", "list", *_, name] if elements and elements[-1] != "vertex":
                pass  # of an element behind the vertices, which is not read
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"ply: header: cannot be understood: {line[:80]!r}")
    if form != FORMAT:
        raise ValueError(f"ply: format: {form or 'absent'}, expected {FORMAT}; save it as a binary file")
    if "chunk" in elements:
        raise ValueError("ply: element chunk: a compressed scene; save it as an uncompressed .ply")
    if elements[:1] != ["vertex"] or elements.count("vertex") > 1:
        raise ValueError(f"ply: element: expected vertex first and once, found {', '.join(elements) or 'none'}")
    return _Header(types, count, end.end(), len(elements) == 1)


def _table(data: bytes, header: _Header) -> NDArray[np.void]:
    row = np.dtype(list(header.types.items()))
    wanted, there = header.count * row.itemsize, len(data) - header.start
    if there < wanted or (there > wanted and header.is_last):
        fault = "truncated" if there < wanted else "something follows them"
        raise ValueError(f"ply: vertex: {header.count} rows of {row.itemsize} bytes announced, {there} found: {fault}")
    return np.frombuffer(data, row, header.count, header.start)


def _columns(table: NDArray[np.void], names: tuple[str, ...], infinite: bool = False) -> F32:
    """(N, len(names)), finite unless `infinite` is a value too."""
    out = np.empty((len(table), len(names)), np.float32)
    for k, name in enumerate(names):
        with np.errstate(over="ignore"):  # a double that is infinite as a float is found below
            out[:, k] = table[name]
        good = ~np.isnan(out[:, k]) if infinite else np.isfinite(out[:, k])
        if not good.all():
            fault = "NaN" if infinite else "NaN or infinite"
            raise ValueError(f"ply: property {name}: {int((~good).sum())} of {len(table)} values are {fault}")
    return out


def _rest(n: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(n))


PARAMETERS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
BACKGROUND, SKY, RIGID, BENDING = "background", "skybox", "rigid_object_", "deformable_node_"
OUT_OF_LOG_M = 1000.0  # height above which a pose says that the vehicle is not there (mtgs.py)
ABSENT_M = 100_000.0  # the height that is written for one
MIRRORED = "MirroredRigidSubModel"
# Coefficients beyond the constant one that change their sign in a mirror of y (rigid_object_mirrored.py: m < 0).
MIRROR_SH = np.array([-1, 1, 1, -1, -1, 1, 1, 1, -1, -1, -1, 1, 1, 1, 1], np.float32)
MIRROR_QUATS = np.array([1.0, -1.0, 1.0, -1.0], np.float32)
SAMPLES = 256  # of the time in a log, for the mean of a colour
Params = Mapping[str, Array]


@dataclass(frozen=True)
class SplatCheckpoint:
    """What of a checkpoint a scene can hold."""

    background: Gaussians  # with the sky, where there is one
    nodes: Mapping[str, Gaussians] = field(default_factory=dict)  # token -> in its box's frame
    origin: Array | None = None  # (3,) [m] of the scene's zero in the world, where the file says it
    left_out: tuple[str, ...] = ()  # parts
    screen: ScreenFilter | None = None  # what it was made to be drawn through, where the file says it


@dataclass(frozen=True)
class LoggedVehicle:
    """A vehicle, and where the log had it."""

    token: str  # without an underscore, at which WorldEngine cuts names
    gaussians: Gaussians  # in its box's frame
    times_s: Array  # (F,) since the log's first instant
    scene_from_box: Array  # (F, 4, 4) [m]; NaN where it is not there


@dataclass(frozen=True)
class _StoredPart:
    params: Params
    config: Mapping[str, Any]
    poses: tuple[Array, Array] | None = None  # quaternions (F, 4) and places (F, 3) in the log


def from_checkpoint(content: object, traversal: int | None = None) -> SplatCheckpoint:
    """The scene of a checkpoint's content, tensors as arrays.

    traversal: whose colours points have, counted from 0; None: the mean. Raises ValueError that names what is absent.
    """
    parts = _parts(content)
    if BACKGROUND not in parts:
        raise ValueError(f"checkpoint: no part {BACKGROUND!r} among {', '.join(sorted(parts)) or 'none'}")
    left_out = tuple(sorted(name for name in parts if name.startswith(BENDING)))
    nodes = {
        name.split("_")[-1]: _node(part, name)
        for name, part in parts.items()
        if name not in (BACKGROUND, SKY, *left_out)
    }
    street = [_gaussians(parts[name], name, traversal) for name in (BACKGROUND, SKY) if name in parts]
    origin = parts[BACKGROUND].config.get("recon2world_translation")
    # No scene of several parts, whose classes are MTGS's.
    pipeline = content.get("pipeline", ()) if isinstance(content, Mapping) else ()
    splatfacto = bool(pipeline) and not any("gaussian_models." in name for name in pipeline)
    return SplatCheckpoint(
        concatenate(street),
        nodes,
        None if origin is None else np.asarray(origin, np.float64).reshape(-1)[:3],
        left_out,
        None if splatfacto else ANTIALIASED,  # rasterize_mode of mtgs.yaml and of MTGS.py; eps2d as it is
    )


def to_splatfacto(gaussians: Gaussians) -> dict[str, Any]:
    """What nerfstudio's splatfacto would have saved of them."""
    return {"step": 0, "pipeline": {f"_model.gauss_params.{name}": a for name, a in parameters_of(gaussians).items()}}


def to_worldengine(
    background: Gaussians, origin: Array, vehicles: Sequence[LoggedVehicle] = (), sky: Gaussians | None = None
) -> dict[str, Any]:
    """A street as WorldEngine reads it, `origin` (3,) [m] in the world, with its vehicles, and a sky that is drawn.

    Raises ValueError for a vehicle that is nowhere in the log.
    """
    config = _config("VanillaGaussianSplattingModel", background)
    config["recon2world_translation"] = [float(value) for value in origin]
    street = {BACKGROUND: {"config": config, "state_dict": gauss_params(background)}}
    if sky is not None:
        config = _config("SkyboxGaussianSplattingModel", sky)
        street[SKY] = {"config": config, "state_dict": gauss_params(sky)}
    return street | {f"{RIGID}{vehicle.token}": _vehicle_part(vehicle) for vehicle in vehicles}


def _config(kind: str, gaussians: Gaussians) -> dict[str, Any]:
    return {"type": kind, "sh_degree": sh.COUNTS.index(gaussians.sh_rest.shape[1]), "scale_dim": 3}


def _vehicle_part(vehicle: LoggedVehicle) -> dict[str, Any]:
    """A vehicle's part, as `_node` takes it back; stamps are microseconds (rigid_object.py)."""
    rotations, places = vehicle.scene_from_box[:, :3, :3], vehicle.scene_from_box[:, :3, 3]
    there = np.flatnonzero(np.isfinite(places).all(axis=1))
    if not len(there) or len(places) < 2:  # of one pose WorldEngine takes it for a thing that never moves
        raise ValueError(f"{vehicle.token}: it takes two instants, and a place at one of them, to write a vehicle")
    middle = rotations[there[len(there) // 2]]
    gaussians = replace(vehicle.gaussians, sh_rest=sh.rotate_coefficients(vehicle.gaussians.sh_rest, middle))
    poses = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, ABSENT_M], (len(places), 1))
    poses[there] = np.concatenate([quats_of(rotations[there]), places[there]], axis=1)
    config = _config("RigidSubModel", gaussians)
    config["log_timestamps"] = np.rint(1e6 * vehicle.times_s).astype(np.int64)
    logged = {"instance_quats": poses[:, :4].astype(np.float32), "instance_trans": poses[:, 4:].astype(np.float32)}
    return {"config": config, "state_dict": gauss_params(gaussians) | logged}


def gauss_params(gaussians: Gaussians) -> dict[str, F32]:
    """The parameters under the names of a state dict."""
    return {f"gauss_params.{name}": values for name, values in parameters_of(gaussians).items()}


def parameters_of(gaussians: Gaussians) -> dict[str, F32]:
    """What those programs learn, of our Gaussians."""
    opacities = np.clip(gaussians.opacities, LEAST, MOST).astype(np.float64)
    if gaussians.sh_rest.shape[1]:
        constant = (gaussians.colours - 0.5) / sh.C0
    else:
        colours = np.clip(gaussians.colours, LEAST, MOST).astype(np.float64)
        constant = np.log(colours / (1.0 - colours))
    return {
        "means": gaussians.means,
        "scales": gaussians.log_scales,
        "quats": gaussians.quats,
        "features_dc": constant.astype(np.float32),
        "features_rest": gaussians.sh_rest,
        "opacities": np.log(opacities / (1.0 - opacities))[:, None].astype(np.float32),
    }


def _parts(content: object) -> dict[str, _StoredPart]:
    """Name -> part. Raises ValueError where nothing in it looks like Gaussians."""
    if not isinstance(content, Mapping):
        raise ValueError(f"checkpoint: expected names and values, found {type(content).__name__}")
    if isinstance(content.get("pipeline"), Mapping):
        return _training_parts(content["pipeline"])
    if content and all(
        isinstance(part, Mapping) and {"config", "state_dict"} <= set(part) for part in content.values()
    ):
        return {name: _worldengine_part(name, part) for name, part in content.items()}
    raise ValueError(
        "checkpoint: neither 'pipeline', as nerfstudio and MTGS have it, nor parts of 'config' and 'state_dict', as "
        "WorldEngine has them"
    )


def _training_parts(pipeline: Mapping[str, Any]) -> dict[str, _StoredPart]:
    """Of a training's checkpoint."""
    states: dict[str, dict[str, Array]] = {}
    for name, value in pipeline.items():
        words = name.removeprefix("module.").removeprefix("_model.").split(".")
        part, rest = (words[1], words[2:]) if words[0] == "gaussian_models" else (BACKGROUND, words)
        if rest[:1] == ["gauss_params"] or rest[0] in (*PARAMETERS, "instance_quats", "instance_trans"):
            states.setdefault(part, {})[rest[-1]] = value
    if not states:
        raise ValueError("checkpoint: no gauss_params under 'pipeline': it is of another model")
    return {name: _part(name, state, {}) for name, state in states.items()}


def _worldengine_part(name: str, part: Mapping[str, Any]) -> _StoredPart:
    """Of WorldEngine's."""
    state, config = part["state_dict"], part["config"]
    if not isinstance(state, Mapping) or not isinstance(config, Mapping):
        raise ValueError(f"checkpoint: {name}: 'config' and 'state_dict' are no names and values")
    nested = state.get("gauss_params")
    flat = {key.removeprefix("gauss_params."): value for key, value in state.items() if key != "gauss_params"}
    return _part(name, flat | (dict(nested) if isinstance(nested, Mapping) else {}), config)


def _part(name: str, state: Mapping[str, Array], config: Mapping[str, Any]) -> _StoredPart:
    quats, places = state.get("instance_quats"), state.get("instance_trans")
    if quats is None or places is None:
        return _StoredPart(state, config)
    quats, places = np.asarray(quats, np.float64).reshape(-1, 4), np.asarray(places, np.float64).reshape(-1, 3)
    if len(quats) != len(places):
        raise ValueError(f"checkpoint: {name}: {len(quats)} instance_quats and {len(places)} instance_trans")
    return _StoredPart(state, config, (quats, places))


def _node(part: _StoredPart, name: str) -> Gaussians:
    """A vehicle in its box, mirrored where it is stored by one half."""
    found = _gaussians(part, name, None)
    if part.config.get("type") == MIRRORED:
        flipped = replace(
            found,
            means=found.means * np.array([1.0, -1.0, 1.0], np.float32),
            quats=found.quats * MIRROR_QUATS,
            sh_rest=found.sh_rest * MIRROR_SH[: found.sh_rest.shape[1], None],
        )
        found = concatenate([found, flipped])
    if part.poses is None or not found.sh_rest.shape[1]:
        return found
    quats, places = part.poses
    there = np.flatnonzero(places[:, 2] < OUT_OF_LOG_M)
    if not len(there):
        return found
    box_from_world = rotations_of(quats[there[len(there) // 2]][None].astype(np.float32))[0].T
    return replace(found, sh_rest=sh.rotate_coefficients(found.sh_rest, np.asarray(box_from_world, np.float64)))


def _gaussians(part: _StoredPart, name: str, traversal: int | None) -> Gaussians:
    """The part's Gaussians as they are stored; directions of light are the world's. Raises ValueError."""
    params = part.params
    means = np.asarray(_required_parameter(params, "means", name), np.float32)
    n = len(means)
    scales = np.asarray(_required_parameter(params, "scales", name), np.float32).reshape(n, -1)
    quats = np.asarray(params["quats"], np.float64) if "quats" in params else np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    constant, rest = _colours(part, name, traversal)
    found = Gaussians(
        means=means,
        quats=(quats / length).astype(np.float32),
        log_scales=np.repeat(scales, 3, axis=1) if scales.shape[1] == 1 else scales,
        opacities=np.clip(_sigmoid(_required_parameter(params, "opacities", name)).reshape(n), LEAST, MOST).astype(
            np.float32
        ),
        colours=(0.5 + sh.C0 * constant if rest.shape[1] else _sigmoid(constant)).astype(np.float32),
        sh_rest=rest,
    )
    for field_name in ("means", "quats", "log_scales", "opacities", "colours", "sh_rest"):
        if not np.isfinite(getattr(found, field_name)).all():
            raise ValueError(f"checkpoint: {name}: {field_name}: NaN or infinity")
    return found


def _colours(part: _StoredPart, name: str, traversal: int | None) -> tuple[Array, F32]:
    """Constant (N, 3) and other coefficients (N, K, 3), one value of what the part has several of."""
    constant = np.asarray(_required_parameter(part.params, "features_dc", name), np.float64)
    rest = np.asarray(_required_parameter(part.params, "features_rest", name), np.float32)
    if constant.ndim == 3:
        constant = np.einsum("nfc,f->nc", constant, _mean_wave(constant.shape[1], part.config))
    if "features_adapters" in part.params:
        adapters = np.asarray(part.params["features_adapters"], np.float64)  # (N, traversals, 3)
        _check_traversal(traversal, adapters.shape[1], name)
        constant = constant + (adapters.mean(axis=1) if traversal is None else adapters[:, traversal])
    if rest.ndim == 4:  # (N, traversals, K, 3)
        _check_traversal(traversal, rest.shape[1], name)
        rest = rest.mean(axis=1, dtype=np.float32) if traversal is None else rest[:, traversal]
    return constant, np.ascontiguousarray(rest)


def _mean_wave(n: int, config: Mapping[str, Any]) -> Array:
    """(n,) what each of n waves is in the mean over the log, or over all sides (gaussian_utils.py, IDFT)."""
    k = np.arange(n)
    frequency = np.where(k % 2 == 0, k, k + 1)
    if config.get("fourier_in_space", "temporal") == "spatial":
        return (k == 0).astype(np.float64)
    scale = float(config.get("fourier_features_scale") or 1.0)
    time = (np.arange(SAMPLES) + 0.5) / SAMPLES
    phase = time[:, None] * scale * frequency * 2.0 * np.pi / n
    return np.asarray(np.where(k % 2 == 0, np.cos(phase), np.sin(phase)).mean(axis=0))


def _check_traversal(traversal: int | None, n: int, name: str) -> None:
    if traversal is not None and not 0 <= traversal < n:
        raise ValueError(f"checkpoint: {name}: traversal {traversal} of {n}, counted from 0")


def _required_parameter(params: Params, parameter: str, name: str) -> Array:
    if parameter not in params:
        raise ValueError(f"checkpoint: {name}: {parameter} is absent")
    return np.asarray(params[parameter])


def _sigmoid(logits: Array) -> Array:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * logits.astype(np.float64)))


# Gaussians as the bytes of a compressed `.spz`, and back.
#
# The format of Niantic Labs (nianticlabs/spz 21715c3, README.md and src/cc/load-spz.cc), a tenth of a `.ply`:
# positions in fixed point of 24 bits, everything else in 8 bits, rotations as their three smallest components of 10.
# Written is version 3, one stream of gzip, which viewers read today; read are versions 2 to 4, the last with a stream
# of zstd for each attribute. Axes are x right, y up, z back there and x right, y down, z forward in a `.ply`: y and z
# change their signs, so that a scene stands the same way round in either file.

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
VERSION = 3
HEADER = np.dtype(
    [("magic", "S4"), ("version", "<u4"), ("count", "<u4"), ("degree", "u1"), ("bits", "u1"), ("flags", "u1")]
)  # the fields that both headers begin with
LEGACY_BYTES, ZSTD_BYTES = 16, 32  # of a header
MOST_BITS = 12  # behind the point of a position: quarters of a millimetre, up to 2 km
MOST_EXPANDED = 1024  # times what a file holds; honest ones stay far below
IS_ANTIALIASED, HAS_EXTENSIONS = 1, 2  # bits of the flags
COLOUR_SCALE = np.float32(0.15)  # of the constant coefficient, in which colours beyond 0 and 1 have room
SQRT_HALF = np.float32(np.sqrt(0.5))
MAGNITUDE = 511  # largest of a rotation's component: 9 bits, and one for the sign
SH_BUCKETS = (8, 16)  # what coefficients of degree 1, and of 2 and 3, are rounded to: 5 and 4 bits
TURN = np.array([1.0, -1.0, -1.0], np.float32)  # of the axes, and of a rotation's x, y, z
# Of the coefficients behind the constant one, by degree: what turning y and z round makes of them.
SH_TURN = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
Bytes = NDArray[np.uint8]
Inflate = Callable[[bytes, int], bytes]  # a stream of zstd and its size -> what it holds; raises OSError


def to_spz(gaussians: Gaussians, antialiased: bool) -> bytes:
    """The file's bytes; `antialiased`: whether they are to be drawn so.

    Raises ValueError for NaN, infinity and for means too far from the origin for 24 bits.
    """
    for name in ("means", "quats", "log_scales", "opacities", "colours", "sh_rest"):
        if not np.isfinite(getattr(gaussians, name)).all():
            raise ValueError(f"spz: {name}: NaN or infinity")
    degree = sh.COUNTS.index(gaussians.sh_rest.shape[1])
    reach = float(np.abs(gaussians.means).max(initial=0.0))
    bits = next((bits for bits in range(MOST_BITS, -1, -1) if reach * 2**bits < 2**23 - 1), None)
    if bits is None:
        raise ValueError(f"spz: means: {reach:.0f} m from the origin; 24 bits reach {2**23:,} m")
    header = np.zeros(1, HEADER)
    header[0] = (MAGIC, VERSION, len(gaussians), degree, bits, IS_ANTIALIASED if antialiased else 0)
    colours = (gaussians.colours - np.float32(0.5)) / np.float32(sh.C0)
    turned = gaussians.sh_rest * SH_TURN[: gaussians.sh_rest.shape[1], None]
    attributes = (
        _fixed_point(gaussians.means * TURN, bits),
        _byte(gaussians.opacities * np.float32(255.0)),
        _byte(colours * (COLOUR_SCALE * np.float32(255.0)) + np.float32(127.5)),
        _byte((gaussians.log_scales + np.float32(10.0)) * np.float32(16.0)),
        _smallest_three(gaussians.quats),
        _rounded_sh(turned),
    )
    head = header.tobytes().ljust(LEGACY_BYTES, b"\0")
    return gzip.compress(head + b"".join(part.tobytes() for part in attributes), mtime=0)


def from_spz(data: bytes, zstd: Inflate) -> tuple[Gaussians, bool]:
    """The Gaussians of a file, and whether they are to be drawn antialiased; `zstd` is asked for those of version 4.

    Raises ValueError that names the field where it is no spz, of another version, damaged, or holds extensions, which
    may change what the rest means.
    """
    packed = _packed(data, zstd)
    means, opacities, colours, scales, rotations, rest = packed.attributes
    n, version = packed.count, packed.version
    number = means.reshape(n, 3, 3).astype(np.int32)
    fixed = number[..., 0] | number[..., 1] << 8 | number[..., 2] << 16
    fixed -= (fixed & 0x800000) << 1
    coefficients = sh.COUNTS[packed.degree]
    quats = (_from_smallest_three if version >= 3 else _from_first_three)(rotations)
    constant = (colours.reshape(n, 3) / np.float32(255.0) - np.float32(0.5)) / COLOUR_SCALE
    turned = (rest.reshape(n, coefficients, 3).astype(np.float32) - 128.0) / np.float32(128.0)
    found = Gaussians(
        means=(fixed.astype(np.float32) * np.float32(2.0**-packed.bits) * TURN).astype(np.float32),
        quats=quats,
        log_scales=scales.reshape(n, 3).astype(np.float32) / np.float32(16.0) - np.float32(10.0),
        opacities=np.clip(opacities / np.float32(255.0), LEAST, MOST),
        colours=(0.5 + sh.C0 * constant).astype(np.float32),
        sh_rest=turned * SH_TURN[:coefficients, None],
    )
    return found, packed.antialiased


@dataclass(frozen=True)
class _Packed:
    version: int
    count: int
    degree: int
    bits: int
    antialiased: bool
    attributes: tuple[Bytes, ...]  # positions, opacities, colours, scales, rotations, coefficients


def _packed(data: bytes, zstd: Inflate) -> _Packed:
    is_zstd = data.startswith(MAGIC)
    if not is_zstd and not data.startswith(GZIP):
        raise ValueError("spz: magic: the file begins neither with NGSP nor as gzip does")
    plain = data if is_zstd else _unzipped(data)
    if len(plain) < (ZSTD_BYTES if is_zstd else LEGACY_BYTES):
        raise ValueError("spz: header: truncated")
    magic, version, count, degree, bits, flags = np.frombuffer(plain, HEADER, 1)[0].tolist()
    if magic != MAGIC or version not in ((4,) if is_zstd else (2, 3)):
        raise ValueError(f"spz: version: {version}, expected 2 or 3 in a gzip, 4 in a file that begins with NGSP")
    if flags & HAS_EXTENSIONS:
        raise ValueError("spz: flags: there are extensions, of which one may turn the axes; save it without")
    if degree >= len(sh.COUNTS):
        raise ValueError(f"spz: SH degree {degree}, expected 0 to {len(sh.COUNTS) - 1}")
    if not 0 < count * 9 <= len(data) * MOST_EXPANDED:
        raise ValueError(f"spz: count: {count:,} Gaussians in a file of {len(data):,} bytes")
    each = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * sh.COUNTS[degree])
    sizes = [count * width for width in each]
    if is_zstd:
        return _Packed(version, count, degree, bits, bool(flags & IS_ANTIALIASED), _streams(data, sizes, zstd))
    ends = LEGACY_BYTES + np.cumsum(sizes)
    if len(plain) != ends[-1]:
        raise ValueError(f"spz: {count:,} Gaussians take {ends[-1]:,} bytes, {len(plain):,} found")
    return _Packed(version, count, degree, bits, bool(flags & IS_ANTIALIASED), tuple(
        np.frombuffer(plain, np.uint8, size, int(end) - size) for size, end in zip(sizes, ends)
    ))  # fmt: skip


def _unzipped(data: bytes) -> bytes:
    """No more of it than an honest file expands to."""
    most = len(data) * MOST_EXPANDED
    try:
        stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
        plain = stream.decompress(data, most)
    except zlib.error as error:
        raise ValueError(f"spz: gzip: {error}") from error
    if not stream.eof:
        raise ValueError("spz: gzip: truncated, or it expands beyond what a scene can")
    return plain


def _streams(data: bytes, sizes: list[int], zstd: Inflate) -> tuple[Bytes, ...]:
    """The attributes of version 4; those of no bytes have no stream."""
    n_streams, at = data[15], int.from_bytes(data[16:20], "little")
    kept = [size for size in sizes if size]
    table = np.frombuffer(data[at : at + 16 * n_streams], "<u8").reshape(-1, 2)
    if at < ZSTD_BYTES or n_streams != len(kept) or len(table) != n_streams or table[:, 1].tolist() != kept:
        raise ValueError(f"spz: streams: expected {len(kept)} of {kept} bytes")
    ends = at + 16 * n_streams + np.cumsum(table[:, 0].astype(object))
    if ends[-1] != len(data):
        raise ValueError(f"spz: streams: they end at byte {ends[-1]:,} of {len(data):,}")
    pieces = [data[int(end) - int(length) : int(end)] for (length, _), end in zip(table, ends)]
    try:
        found = iter([np.frombuffer(zstd(piece, size), np.uint8) for piece, size in zip(pieces, kept)])
    except OSError as error:
        raise ValueError(f"spz: zstd: {error}") from error
    return tuple(next(found) if size else np.empty(0, np.uint8) for size in sizes)


def _round(values: F32) -> F32:
    """To the nearest whole number, halves away from zero."""
    return np.trunc(values + np.copysign(np.float32(0.5), values))


def _byte(values: F32) -> Bytes:
    return np.clip(_round(values), 0.0, 255.0).astype(np.uint8)


def _fixed_point(means: F32, bits: int) -> Bytes:
    """(N, 3, 3): three bytes, the lowest first."""
    fixed = _round(means * np.float32(2.0**bits)).astype("<i4")
    return np.ascontiguousarray(fixed.view(np.uint8).reshape(*fixed.shape, 4)[..., :3])


def _rounded_sh(coefficients: F32) -> Bytes:
    """(N, K, 3): 8 bits around 128, rounded to buckets of which one has 0 in its middle."""
    whole = (_round(coefficients * np.float32(128.0)) + 128.0).astype(np.int64)
    bucket = np.where(np.arange(coefficients.shape[1]) < 3, *SH_BUCKETS)[:, None]
    rounded = np.trunc((whole + bucket // 2) / bucket).astype(np.int64) * bucket
    return np.clip(rounded, 0, 255).astype(np.uint8)


def _smallest_three(quats: F32) -> NDArray[np.uint32]:
    """(N,): which component of x, y, z, w is the largest, and the others in order, made so that it is positive."""
    xyzw = (quats / np.linalg.norm(quats, axis=1, keepdims=True))[:, [1, 2, 3, 0]].astype(np.float32)
    xyzw[:, :3] *= TURN
    largest = np.abs(xyzw).argmax(axis=1)
    signs = (xyzw < 0) ^ np.take_along_axis(xyzw < 0, largest[:, None], 1)
    sizes = (MAGNITUDE * (np.abs(xyzw) / SQRT_HALF) + np.float32(0.5)).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for k in range(4):
        component = signs[:, k].astype(np.uint32) << 9 | sizes[:, k]
        packed = np.where(largest == k, packed, packed << 10 | component)
    return packed.astype("<u4")


def _from_smallest_three(rotations: Bytes) -> F32:
    """(N, 4), w first."""
    packed = rotations.view("<u4").copy()
    largest = packed >> 30
    xyzw = np.zeros((len(packed), 4), np.float32)
    for k in (3, 2, 1, 0):  # the last is lowest
        here = largest != k
        size = (packed & MAGNITUDE).astype(np.float32) * (SQRT_HALF / MAGNITUDE)
        xyzw[:, k] = np.where(here, np.where(packed >> 9 & 1, -size, size), 0.0)
        packed = np.where(here, packed >> 10, packed)
    rest = np.sqrt(np.maximum(1.0 - (xyzw**2).sum(axis=1), 0.0))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), rest[:, None], 1)
    return _w_first(xyzw)


def _from_first_three(rotations: Bytes) -> F32:
    """(N, 4), w first, of version 2's x, y, z."""
    xyz = rotations.reshape(-1, 3) / np.float32(127.5) - np.float32(1.0)
    w = np.sqrt(np.maximum(1.0 - (xyz**2).sum(axis=1), 0.0))
    return _w_first(np.column_stack([xyz, w]))


def _w_first(xyzw: F32) -> F32:
    """With the axes turned, of length 1."""
    turned = np.concatenate([xyzw[:, 3:], xyzw[:, :3] * TURN], axis=1)
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True), np.float32)
