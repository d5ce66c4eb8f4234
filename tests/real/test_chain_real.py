"""Perturb and attempt on one Argoverse 2 clip: the lazy walk equals its slow twin, and both experts are heard."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from tasks.attempt import ExpertGate, Judged, attempt, perturbed_scene
from tasks.experts.pdm_closed import PdmClosed, PdmSettings, plan_for
from tasks.experts.protocol import Expert
from tasks.experts.recovery import RecoveryExpert, RecoveryTable
from tasks.perturb import Perturbation, PerturbSettings, gate_failures, grid_cells, perturb
from tasks.reward.epdms import prepare_scene, score
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings, simulate
from tasks.stages import Rejected
from tasks.subscores import SUBSCORES
from tasks.world.clip import HORIZON_STEPS, NOW, Clip, random_stream, scene_of_clip
from tasks.world.frames import to_local, to_world
from tasks.world.vocabulary import Vocabulary

LOG, START_MS = "adcf7d18-0510-35b0-a2fa-b4cea13a6d76", 6000
K = 600  # of the 8,192 human trajectories
SETTINGS, TRAFFIC, PDM, GATE = PerturbSettings(), TrafficSettings(), PdmSettings(), ExpertGate()


@pytest.fixture(scope="module")
def human(shared_root: Path) -> NDArray[np.float64]:
    return np.load(shared_root / "data" / "vocabulary" / "human_8192x40x3.npy")


@pytest.fixture(scope="module")
def clip(shared_root: Path) -> Clip:
    reader = AV2Reader(shared_root / "data" / "av2" / "sensor" / "val" / LOG)
    return reader.read(next(ref for ref in reader.index().refs if ref.start_ms == START_MS))


@pytest.fixture(scope="module")
def experts(human: NDArray[np.float64]) -> tuple[Expert, ...]:
    return PdmClosed(PDM), RecoveryExpert(RecoveryTable(human))


def listed(clip: Clip, human: NDArray[np.float64]) -> Perturbation:
    found = perturb(clip, Vocabulary(human[:K]), SETTINGS, TRAFFIC, PDM, random_stream(0, clip.clip_id, "perturb"))
    assert isinstance(found, Perturbation)
    return found


@pytest.fixture(scope="module")
def found(clip: Clip, human: NDArray[np.float64]) -> Perturbation:
    return listed(clip, human)


def test_the_lazy_walk_equals_scoring_everything_first(
    clip: Clip, human: NDArray[np.float64], found: Perturbation
) -> None:
    """The slow twin: drive and score all K, filter by gates, colour and score, pick the first per cell, then react."""
    scene = scene_of_clip(clip)
    start, target = scene.ego_state, clip.ego_states[NOW + HORIZON_STEPS, :3]
    poses = to_world(start[:3], human[:K].astype(np.float64))
    raw = to_local(target, poses[:, -1])
    states = track(start, poses)
    ends = to_local(target, states[:, -1, :3])
    inside = np.ones(K, bool)
    for pose in (raw, ends):
        for fails in gate_failures(pose, SETTINGS).values():
            inside &= ~fails
    cells = grid_cells(ends, SETTINGS)
    inside &= cells.sum(axis=1) % 2 == 0
    pdm = plan_for(scene, PDM).driven[None]
    candidates = np.flatnonzero(inside)
    replay = prepare_scene(scene, scene.agents.window(NOW, NOW + HORIZON_STEPS + 1))
    scores = np.full(K, np.nan)
    scores[candidates] = score(replay, np.concatenate([pdm, states[candidates]]), normalise="pairs").pdm_score[1:]

    first: dict[tuple[int, int], int | None] = {}
    for index in random_stream(0, clip.clip_id, "perturb").permutation(K).tolist():
        if inside[index]:
            cell = (int(cells[index, 0]), int(cells[index, 1]))
            if first.setdefault(cell, None) is None and scores[index] >= SETTINGS.epdms_min:
                first[cell] = index
    expected = []
    for index in (index for index in first.values() if index is not None):
        rollout = simulate(scene, poses[index], TRAFFIC)
        rows = np.concatenate([pdm, rollout.ego_states[None]])
        reactive = score(prepare_scene(scene, rollout.agents), rows, normalise="pairs").pdm_score[1]
        if reactive >= SETTINGS.epdms_min:
            expected.append((index, scores[index], reactive))

    assert [c.vocabulary_index for c in found.candidates] == [index for index, _, _ in expected]
    np.testing.assert_allclose([c.score for c in found.candidates], [s for _, s, _ in expected], atol=1e-12)
    np.testing.assert_allclose([c.reactive_score for c in found.candidates], [r for _, _, r in expected], atol=1e-12)
    asked = int(np.isfinite(found.considered.score).sum())
    assert asked < len(candidates), f"lazy: {asked} scores instead of {len(candidates)}"


def outcomes(clip: Clip, found: Perturbation, expert: Expert, n: int) -> list[tuple[str, float, bytes]]:
    """Reason (empty: accepted), score and driven states of the first n attempts."""
    out = []
    for index, candidate in enumerate(found.candidates[:n]):
        rng = random_stream(0, clip.clip_id, f"expert.{expert.name}", index)
        result = attempt(perturbed_scene(clip, candidate.rollout), expert, GATE, TRAFFIC, PDM, rng)
        if isinstance(result, Rejected):
            out.append((result.reason, np.nan, b""))
            continue
        judged, rejected = result
        out.append((_checked(judged, rejected), float(judged.scores.pdm_score[1]), judged.rollout.ego_states.tobytes()))
    return out


def _checked(judged: Judged, rejected: Rejected | None) -> str:
    passes = all(getattr(judged.scores, name)[1] == 1.0 for name in GATE.full) and judged.scores.ep[1] > 0.5
    assert passes == (rejected is None)
    return "" if rejected is None else rejected.reason


def test_both_experts_are_accepted_on_some_candidates_and_rejected_for_listed_reasons_on_others(
    clip: Clip, experts: tuple[Expert, ...], found: Perturbation
) -> None:
    for expert in experts:
        reasons = Counter(reason for reason, _, _ in outcomes(clip, found, expert, len(found.candidates)))
        assert reasons[""] >= 1, f"{expert.name}: {dict(reasons)}"
        assert sum(reasons.values()) > reasons[""], f"{expert.name} passes everywhere: is anything judged?"
        assert set(reasons) <= {"", *SUBSCORES, "no_plan"}
