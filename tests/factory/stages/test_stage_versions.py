"""Golden outputs: a stage whose output changes gets a new version in tasks/stages.py, so that old rows are told apart.

Each stage works on a small hand-made input, which no other stage made; two sums over each of its arrays are kept in
golden.py with the stage's version. They are compared to 1e-6 (colours: 1e-3), far above what another processor or libm
changes.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import astuple, fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.stages.rows import label_columns, sample_row
from factory.store.schema import SCHEMA
from tasks.attempt import BRAKING_MPS2, Judged, hit_after_s, perturbed_scene, route_ahead_m
from tasks.experts.pdm_closed import PdmClosed
from tasks.experts.protocol import Human, Plan
from tasks.experts.recovery import RecoveryExpert, RecoveryTable
from tasks.perturb import Candidate, Perturbation, PerturbSettings, perturb
from tasks.render.gate import likeness_to_photo, measure_rendered_views
from tasks.render.scene.asset import Instant, Reach
from tasks.render.scene.build import AssetSettings, build_asset
from tasks.render.scene.engine import SCENE_S_OWN, render_instants
from tasks.render.scene.movers import NOBODY
from tasks.render.views import draw_map_views, pinhole, render_views
from tasks.reward.epdms import Scores, prepare_scene, score
from tasks.reward.label_bytes import VocabularyLabels
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, simulate
from tasks.stages import STAGES, stage_versions
from tasks.world.clip import HORIZON_STEPS, NOW, Camera, Clip, Pinhole, Rollout, Scene, random_stream, scene_of_clip
from tasks.world.frames import EGO_STATE_SIZE, VX, Y, to_world
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories
from tests.factory.datasets.av2.test_av2 import write_log
from tests.factory.datasets.scenarionet.scenarionet_scenarios import nuscenes, save
from tests.factory.stages.golden import GOLDEN, Golden, Sums
from tests.tasks.render import street
from tests.tasks.streets import street_clip

RNG = np.random.default_rng(0)  # no stage here draws from it but perturb, which has its own stream


def sums_of(array: object) -> Sums:
    """A plain and an alternating sum over sqrt(n), absent values as 0: any change of one value moves at least one."""
    flat = np.nan_to_num(np.asarray(array, dtype=np.float64).ravel(), posinf=1e3, neginf=-1e3)
    root = np.sqrt(max(len(flat), 1))
    return float(flat.sum() / root), float((flat * np.cos(0.7 * np.arange(len(flat)))).sum() / root)


def clip_arrays(name: str, clip: Clip) -> dict[str, object]:
    lanes = clip.road_map.lanes.values()
    return {
        f"{name} ego": clip.ego_states,
        f"{name} boxes": clip.agents.boxes,
        f"{name} velocities": clip.agents.velocities,
        f"{name} lanes": np.concatenate([lane.centerline for lane in lanes]),
        f"{name} rings": np.concatenate([lane.ring for lane in lanes]),
        f"{name} route": clip.centerline,
    }


def read_clips(folder: Path) -> dict[str, object]:
    """The stage `clip`: an Argoverse 2 log and a ScenarioNet scenario."""
    av2 = AV2Reader(write_log(folder / "av2" / "log"))
    (folder / "nuscenes").mkdir()
    save(nuscenes(), folder / "nuscenes")
    scenarionet = ScenarioNetReader(folder / "nuscenes")
    out: dict[str, object] = {}
    for name, reader in (("av2", av2), ("nuscenes", scenarionet)):
        out |= clip_arrays(name, reader.read(reader.index().refs[0]))
    return out


def perturbed_street() -> dict[str, object]:
    """The stage `perturb`."""
    clip = street_clip()
    rng = random_stream(0, clip.clip_id, "perturb")
    vocabulary = Vocabulary(kinematic_trajectories(120, 0))
    found = perturb(clip, vocabulary, PerturbSettings(), TrafficSettings(), rng)
    assert isinstance(found, Perturbation)
    listed = found.candidates
    return {
        "indices": [candidate.vocabulary_index for candidate in listed],
        "ends": [candidate.end_pose for candidate in listed],
        "scores": [(candidate.score, candidate.reactive_score) for candidate in listed],
        "counts": list(found.gate_counts.values()),
    }


def scene_aside() -> Scene:
    """At T, the ego 0.6 m to the left of where the log has it."""
    scene = scene_of_clip(street_clip())
    history = scene.ego_history.copy()
    history[:, Y] += 0.6
    return replace(scene, ego_history=history)


def straight_states(scene: Scene, poses: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """(K, 41, 11) states through poses (K, 40, 3), by default straight on at 4 m/s; no tracker drives them."""
    poses = slow_plan(scene)[None] if poses is None else poses
    states = np.zeros((len(poses), HORIZON_STEPS + 1, EGO_STATE_SIZE))
    states[:, 0] = scene.ego_state
    states[:, 1:, :3] = poses
    states[:, 1:, VX] = np.hypot(*np.moveaxis(np.diff(states[..., :2], axis=1), -1, 0)) / 0.1
    return states


def slow_plan(scene: Scene, speed_mps: float = 4.0) -> NDArray[np.float64]:
    """Straight on, slower than the traffic behind."""
    way = speed_mps * 0.1 * np.arange(1, 41)
    return to_world(scene.ego_state[:3], np.column_stack([way, np.zeros((40, 2))]))


def rollouts() -> dict[str, object]:
    """The stage `rollout`: both stages, reactive, without giving way (as in version 2) and with, and replayed."""
    out: dict[str, object] = {}
    traffic = {
        "idm": TrafficSettings(yields=False),
        "yields": TrafficSettings(),
        "replay": TrafficSettings(mode="replay"),
    }
    first = scene_aside()
    second = perturbed_scene(street_clip(), simulate(first, slow_plan(first), traffic["idm"]))
    for name, scene in (("first", first), ("second", second)):
        for of, settings in traffic.items():
            rollout: Rollout = simulate(scene, slow_plan(scene), settings)
            out[f"{name} {of} ego"] = rollout.ego_states
            out[f"{name} {of} boxes"] = rollout.agents.boxes
            out[f"{name} {of} velocities"] = rollout.agents.velocities
    return out


def plans() -> dict[str, object]:
    """The stage `expert`."""
    scene, table = scene_aside(), RecoveryTable(kinematic_trajectories(300, 1))
    out: dict[str, object] = {}
    for expert in (PdmClosed(), RecoveryExpert(table), Human()):
        plan = expert.plan(scene, RNG)
        assert isinstance(plan, Plan), expert.name
        out[expert.name] = plan.poses
    return out


def rewards() -> dict[str, object]:
    """The stage `reward`: every sub-score of sixty drives from T, and what their ends lead to."""
    scene = scene_of_clip(street_clip())
    states = straight_states(scene, to_world(scene.ego_state[:3], kinematic_trajectories(60, 2)))
    prepared = prepare_scene(scene, scene.agents.window(NOW, NOW + 41))
    scores, clip = score(prepared, states), scene.clip
    traffic = prepare_traffic(scene, TrafficSettings(yields=False))
    onward = replace(clip.route, roadblock_ids=(*clip.route.roadblock_ids, "rb_elsewhere"))
    ways = [route_ahead_m(clip.road_map, onward, one[-1, :3] + [240.0, 0.0, 0.0]) for one in states]
    ends = {
        "way on": [-1.0 if metres is None else metres for metres in ways],
        "hit": [hit_after_s(traffic, prepared, one) for one in states],
        "hit braking": [hit_after_s(traffic, prepared, one, BRAKING_MPS2) for one in states],
    }
    return {field.name: getattr(scores, field.name) for field in fields(Scores)} | ends


def blocks(images: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Mean colour of 4 x 4 blocks of each image (..., H, W, 3)."""
    *front, height, width, _ = images.shape
    rows = images[..., : height // 4 * 4, : width // 4 * 4, :].reshape(*front, 4, height // 4, 4, width // 4, 3)
    return rows.mean(axis=(-4, -2))


def pictures() -> dict[str, object]:
    """The stage `render`: a scene made of four photos seen from beside them, and the map drawn."""
    photos, sweeps = street.drive(4)
    asset = build_asset(photos, sweeps, street.tracks(), AssetSettings(hold_out_every=0))
    front = Camera("front", street.WIDTH, street.HEIGHT, street.INTRINSICS, np.zeros(5), street.EGO_FROM_CAMERA)
    aside = np.stack([street.ego_pose(1.5, 0.6)])
    seen = np.stack([*render_views(asset, [front], aside, street.tracks(), [4], street.WIDTH, street.HEIGHT)])
    clip = street_clip()
    pose = clip.world_from_ego[NOW : NOW + 1] * 1.0
    pose[:, 2, 3] = 0.0
    drawn = draw_map_views(clip.road_map, [pinhole("front", 0.0, 70.0)], pose, clip.agents, [NOW], 128, 72)
    eye = Pinhole(front.intrinsics, aside[0] @ front.ego_from_camera, street.WIDTH, street.HEIGHT)
    near = Instant([eye], NOBODY, [SCENE_S_OWN], Reach(aside[0, :3, 3], 30.0))
    (found,) = measure_rendered_views(asset, near, next(render_instants(asset, [near])), aside[0])
    alike = likeness_to_photo(asset, photos[2], street.tracks(), ["car"])
    return {"rendered": blocks(seen), "drawn": blocks(drawn), "gate": astuple(found), "likeness": [alike["car"]]}


def rows() -> dict[str, object]:
    """The stage `write`: what a simulated and a human row hold, and under which names."""
    clip = street_clip()
    near = scene_aside()
    rollout = Rollout(
        NOW, straight_states(near)[0], clip.agents.window(NOW, NOW + 41), np.array([True, False, False, True])
    )
    far = perturbed_scene(clip, rollout)
    columns = {field.name: np.linspace(0.1, 0.9, 2) for field in fields(Scores)}
    scores = Scores(**columns)  # type: ignore[arg-type]
    candidate = Candidate(17, np.array([0.5, 0.25, 0.1]), (0, 0), 0.9, 0.85, scores, rollout)
    onward = Rollout(far.step, straight_states(far)[0], clip.agents.window(far.step, far.step + 41), rollout.simulated)
    out: dict[str, object] = {}
    for kind, row in (
        ("simulated", sample_row(clip, candidate, judged(far, onward, scores))),
        ("human", sample_row(clip, None, judged(near, rollout, scores))),
    ):
        numbers = [np.zeros(0)]
        for name in sorted(row):
            value = row[name]
            many = value if isinstance(value, list) else [value]
            numbers += [np.ravel(part) for part in many if isinstance(part, np.ndarray | float)]
        out[kind] = np.concatenate(numbers)
        out[f"{kind} text"] = text_of(sorted(name for name, value in row.items() if value is not None))
    halves, whole = np.arange(20) % 3 / 2.0, np.arange(20) % 2 * 1.0
    metres = np.linspace(0.0, 70.0, 20)
    labels = label_columns(
        VocabularyLabels("digest", 20.0, halves, whole, halves[::-1], whole, whole[::-1], whole, whole, metres)
    )
    out |= {name: np.frombuffer(value, np.uint8) for name, value in labels.items() if isinstance(value, bytes)}
    out["labels text"] = text_of(labels)
    return out | {"schema": text_of(f"{field.name} {field.type}" for field in SCHEMA)}


def judged(scene: Scene, rollout: Rollout, scores: Scores) -> Judged:
    """A drive straight on as if it had been scored so."""
    prepared = prepare_scene(scene, rollout.agents)
    return Judged(scene, Plan(slow_plan(scene)), rollout, scores, prepared, rollout.ego_states)


def text_of(lines: Iterable[str]) -> NDArray[np.uint8]:
    return np.frombuffer("\n".join(lines).encode(), np.uint8)


MAKERS: dict[str, Callable[[], dict[str, object]]] = {
    "perturb": perturbed_street,
    "rollout": rollouts,
    "expert": plans,
    "reward": rewards,
    "render": pictures,
    "write": rows,
}


def outputs(stage: str, folder: Path) -> dict[str, Sums]:
    made = read_clips(folder) if stage == "clip" else MAKERS[stage]()
    return {name: sums_of(array) for name, array in made.items()}


def entry(stage: str, found: Mapping[str, Sums]) -> str:
    """The entry to record."""
    lines = [f'            "{name}": ({a:.9g}, {b:.9g}),' for name, (a, b) in found.items()]
    return "\n".join(
        [f'    "{stage}": Golden(', f"        {stage_versions()[stage]},", "        {", *lines, "        },"]
    )


def changes(stage: str, golden: Golden, found: Mapping[str, Sums]) -> list[str]:
    out = [f"{name}: {'new' if name in found else 'gone'}" for name in sorted(set(found) ^ set(golden.sums))]
    for name in golden.sums.keys() & found.keys():
        old, new = np.array(golden.sums[name]), np.array(found[name])
        if (np.abs(old - new) > golden.tolerance * np.maximum(1.0, np.abs(old))).any():
            out.append(f"{name}: was {old.tolist()}, is {new.tolist()}")
    return out


@pytest.mark.parametrize("stage", [stage.name for stage in STAGES])
def test_a_stage_s_output_changes_only_with_its_version(stage: str, tmp_path: Path) -> None:
    golden, found = GOLDEN[stage], outputs(stage, tmp_path)
    version = stage_versions()[stage]
    changed = changes(stage, golden, found)
    if version == golden.version:
        assert not changed, (
            f"stage {stage!r} gives other output under the same version {version}: {'; '.join(changed)}.\n"
            f"If that is meant, raise its version in tasks/stages.py and record in golden.py:\n{entry(stage, found)}"
        )
    else:
        pytest.fail(
            f"stage {stage!r} is version {version} now; record in golden.py what it gives:\n{entry(stage, found)}"
        )


def test_a_change_of_one_value_is_seen_and_one_of_the_last_digits_is_not() -> None:
    values = np.random.default_rng(1).normal(size=(41, 20, 5)) * 50.0
    golden = Golden(1, {"boxes": sums_of(values)})
    assert not changes("rollout", golden, {"boxes": sums_of(values * (1.0 + 1e-12))})
    values[7, 3, 1] += 0.01
    assert changes("rollout", golden, {"boxes": sums_of(values)})
    assert changes("rollout", golden, {}) == ["boxes: gone"]
