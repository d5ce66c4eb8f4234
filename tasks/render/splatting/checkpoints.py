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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians, concatenate, quats_of, rotations_of
from tasks.render.splatting.ply import LEAST, MOST
from tasks.render.splatting.project import ANTIALIASED, ScreenFilter
from tasks.world.arrays import F32, Array

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
    return SplatCheckpoint(
        concatenate(street),
        nodes,
        None if origin is None else np.asarray(origin, np.float64).reshape(-1)[:3],
        left_out,
        None if _is_splatfacto(content) else ANTIALIASED,  # rasterize_mode of mtgs.yaml and of MTGS.py; eps2d as it is
    )


def _is_splatfacto(content: Any) -> bool:
    """No scene of several parts, whose classes are MTGS's."""
    return "pipeline" in content and not any("gaussian_models." in name for name in content["pipeline"])


def splatfacto(gaussians: Gaussians) -> dict[str, Any]:
    """What nerfstudio's splatfacto would have saved of them."""
    return {"step": 0, "pipeline": {f"_model.gauss_params.{name}": a for name, a in parameters_of(gaussians).items()}}


def worldengine(background: Gaussians, origin: Array, vehicles: Sequence[LoggedVehicle] = ()) -> dict[str, Any]:
    """A street as WorldEngine reads it, `origin` (3,) [m] in the world, with its vehicles.

    Raises ValueError for a vehicle that is nowhere in the log.
    """
    config = _config("VanillaGaussianSplattingModel", background)
    config["recon2world_translation"] = [float(value) for value in origin]
    street = {BACKGROUND: {"config": config, "state_dict": gauss_params(background)}}
    return street | {f"{RIGID}{vehicle.token}": _logged(vehicle) for vehicle in vehicles}


def _config(kind: str, gaussians: Gaussians) -> dict[str, Any]:
    return {"type": kind, "sh_degree": sh.COUNTS.index(gaussians.sh_rest.shape[1]), "scale_dim": 3}


def _logged(vehicle: LoggedVehicle) -> dict[str, Any]:
    """A vehicle's part, as `_node` takes it back; stamps are microseconds (rigid_object.py)."""
    rotations, places = vehicle.scene_from_box[:, :3, :3], vehicle.scene_from_box[:, :3, 3]
    there = np.flatnonzero(np.isfinite(places).all(axis=1))
    if not len(there) or len(places) < 2:  # of one pose WorldEngine takes it for a thing that never moves
        raise ValueError(f"{vehicle.token}: it takes two instants, and a place at one of them, to write a vehicle")
    middle = rotations[there[len(there) // 2]]
    gaussians = replace(vehicle.gaussians, sh_rest=sh.turned(vehicle.gaussians.sh_rest, middle))
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
        return _trained(content["pipeline"])
    if content and all(
        isinstance(part, Mapping) and {"config", "state_dict"} <= set(part) for part in content.values()
    ):
        return {name: _portable(name, part) for name, part in content.items()}
    raise ValueError(
        "checkpoint: neither 'pipeline', as nerfstudio and MTGS have it, nor parts of 'config' and 'state_dict', as "
        "WorldEngine has them"
    )


def _trained(pipeline: Mapping[str, Any]) -> dict[str, _StoredPart]:
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


def _portable(name: str, part: Mapping[str, Any]) -> _StoredPart:
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
    return replace(found, sh_rest=sh.turned(found.sh_rest, np.asarray(box_from_world, np.float64)))


def _gaussians(part: _StoredPart, name: str, traversal: int | None) -> Gaussians:
    """The part's Gaussians as they are stored; directions of light are the world's. Raises ValueError."""
    params = part.params
    means = np.asarray(_taken(params, "means", name), np.float32)
    n = len(means)
    scales = np.asarray(_taken(params, "scales", name), np.float32).reshape(n, -1)
    quats = np.asarray(params["quats"], np.float64) if "quats" in params else np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    constant, rest = _colours(part, name, traversal)
    found = Gaussians(
        means=means,
        quats=(quats / length).astype(np.float32),
        log_scales=np.repeat(scales, 3, axis=1) if scales.shape[1] == 1 else scales,
        opacities=np.clip(_sigmoid(_taken(params, "opacities", name)).reshape(n), LEAST, MOST).astype(np.float32),
        colours=(0.5 + sh.C0 * constant if rest.shape[1] else _sigmoid(constant)).astype(np.float32),
        sh_rest=rest,
    )
    for field_name in ("means", "quats", "log_scales", "opacities", "colours", "sh_rest"):
        if not np.isfinite(getattr(found, field_name)).all():
            raise ValueError(f"checkpoint: {name}: {field_name}: NaN or infinity")
    return found


def _colours(part: _StoredPart, name: str, traversal: int | None) -> tuple[Array, F32]:
    """Constant (N, 3) and other coefficients (N, K, 3), one value of what the part has several of."""
    constant = np.asarray(_taken(part.params, "features_dc", name), np.float64)
    rest = np.asarray(_taken(part.params, "features_rest", name), np.float32)
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


def _taken(params: Params, parameter: str, name: str) -> Array:
    if parameter not in params:
        raise ValueError(f"checkpoint: {name}: {parameter} is absent")
    return np.asarray(params[parameter])


def _sigmoid(logits: Array) -> Array:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * logits.astype(np.float64)))
