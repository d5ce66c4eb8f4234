"""Times the stages on real logs, or on the synthetic town where there are none."""

import sys
from pathlib import Path

from factory.readers.av2.reader import AV2Reader
from factory.readers.base import ClipReader
from factory.readers.town.reader import SyntheticReader
from tasks.attempt import ExpertGate, attempt, perturbed_scene
from tasks.experts.pdm_closed.planner import PdmClosed, PdmSettings
from tasks.perturb import Perturbation, PerturbSettings, perturb
from tasks.reward.prepare import prepare_scene
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, simulate
from tasks.world.chance import stream
from tasks.world.clip import scene_of_clip
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vocabulary import Vocabulary
from tests.bench.timing import milliseconds


def main(root: Path) -> None:
    """Prints the table."""
    reader: ClipReader = AV2Reader(root) if root.is_dir() else SyntheticReader(n_clips=3)
    ref = reader.index().refs[0]
    clip = reader.read(ref)
    scene = scene_of_clip(clip)
    print(f"clip {ref.clip_id} of {reader.name}, {len(clip.agents)} tracks; one thread\n")

    settings, pdm = TrafficSettings(), PdmSettings()
    vocabulary = Vocabulary(kinematic_trajectories(1024, 0), source="kinematic")

    def perturbed() -> Perturbation:
        found = perturb(clip, vocabulary, PerturbSettings(), settings, pdm, stream(0, clip.clip_id, "perturb"))
        assert isinstance(found, Perturbation), found
        return found

    candidate = perturbed().candidates[0]
    second = perturbed_scene(clip, candidate.rollout)
    plan = candidate.rollout.ego_states[1:, :3]
    rng = stream(0, clip.clip_id, "bench")
    rows = {
        "read a further clip of the log": lambda: reader.read(ref),
        "perturb (K = 1,024)": perturbed,
        "prepare traffic": lambda: prepare_traffic(scene, settings),
        "reactive rollout": lambda: simulate(scene, plan, settings),
        "prepare the reward": lambda: prepare_scene(scene, candidate.rollout.agents),
        "PDM-Closed's plan": lambda: PdmClosed().plan(second, rng),
        "whole attempt (pdm_closed)": lambda: attempt(second, PdmClosed(), ExpertGate(), settings, pdm, rng),
    }
    print("| step | ms |\n|---|---|")
    for name, call in rows.items():
        print(f"| {name} | {milliseconds(call, 5):.1f} |")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data/av2/sensor/val"))
