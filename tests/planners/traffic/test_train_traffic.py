"""A traffic policy fitted to the town: the same file again, the same answers as in torch, and a car that brakes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from factory.exits import BAD_CONFIG, COMPLETE
from planners.traffic.fit import Network, NetworkSettings, fit, held_out_error, loss_of, there_are
from planners.traffic.lessons import Lessons, joined
from planners.traffic.train_traffic import main
from tasks.rollout.learned.imitation import forward
from tasks.rollout.learned.look import NEAR, NEIGHBOURS, OWN, PURSUIT
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_on, roll_out
from tasks.world.clip import HORIZON_STEPS, Scene
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track

TOWN = (
    "clips=synthetic", "clips.n_clips=2", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0",
)  # fmt: skip
BRIEF = ("clips.n_clips=1", "network.epochs=1", "rounds=2")


def lessons_by_chance(n: int, seed: int = 0) -> Lessons:
    rng = np.random.default_rng(seed)
    own, near = rng.normal(0.0, 1.0, (n, OWN)), rng.normal(0.0, 1.0, (n, NEIGHBOURS, NEAR))
    own[:, 0], own[:, PURSUIT] = rng.uniform(0.0, 1.5, n), rng.normal(0.0, 0.02, n)
    wants = np.stack([2.0 * own[:, 3], own[:, PURSUIT] + 0.01 * np.tanh(own[:, 5])], axis=1)
    return Lessons(
        own.astype(np.float32), near.astype(np.float32), rng.integers(0, NEIGHBOURS + 1, n),
        wants.astype(np.float32), np.ones((n, 2), np.float32),
    )  # fmt: skip


def test_the_compiled_network_is_torch_s() -> None:
    torch.manual_seed(1)
    network, seen = Network(NetworkSettings(neighbour_width=7, width=12)), lessons_by_chance(50)
    with torch.no_grad():
        expected = network(
            torch.from_numpy(seen.own), torch.from_numpy(seen.near), there_are(torch.from_numpy(seen.count))
        )
    found = forward(network.weights, seen.own.astype(float), seen.near.astype(float), seen.count)
    assert found == pytest.approx(expected.numpy(), abs=1e-5) and np.ptp(found, axis=0).min() > 0.05


def test_what_is_not_known_teaches_nothing() -> None:
    seen = lessons_by_chance(40)
    known = seen.known.copy()
    known[20:] = 0.0
    network = Network(NetworkSettings())
    arrays = [torch.from_numpy(array) for array in vars(seen).values()]
    half = [array[:20] for array in arrays]
    blind = [*arrays[:4], torch.from_numpy(known)]
    with torch.no_grad():
        losses = [float(loss_of(network(*of[:2], there_are(of[2])), of)) for of in (blind, half)]
    assert losses[0] == pytest.approx(losses[1])


def test_a_fit_finds_what_lessons_say_and_is_the_same_again() -> None:
    """Accelerations and curvatures that are linear in what is seen; held-out errors fall."""
    settings, lessons, unseen = NetworkSettings(epochs=10), lessons_by_chance(4000), lessons_by_chance(1000, 1)
    networks = []
    for _ in range(2):
        torch.manual_seed(0)
        network = Network(settings)
        before = held_out_error(network, unseen)
        fit(network, joined([lessons, lessons]), settings, seed=0)
        after = held_out_error(network, unseen)
        assert after[0] < 0.4 * before[0] and after[1] < 0.6 * before[1]
        networks.append(network.weights)
    for one, other in zip(*networks):
        assert one.tobytes() == other.tobytes()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """To two clips of one town, in some seconds."""
    folder = tmp_path_factory.mktemp("traffic")
    out = folder / "traffic.npz"
    assert main([*TOWN, f"clips.cache_dir={folder / 'towns'}", f"out={out}", "network.epochs=16"]) == COMPLETE
    return out


def behind(speed: float, gap: float, lead: float = 0.0) -> Scene:
    """A car on a straight road, bumpers `gap` behind the ego, whose body reaches 1.127 m behind its rear axle."""
    ego = (2.3 + gap + 1.127, 0.0, 0.0)
    return worlds.scene(worlds.straight_road(), Track(0.0, speed=speed), ego=ego, ego_speed=lead)


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "gap"), [(8.0, 25.0), (5.0, 15.0), (10.0, 35.0)])
def test_a_fitted_policy_brakes_for_an_ego_that_stands_ahead_of_it(fitted: Path, speed: float, gap: float) -> None:
    """Without the ego it does not: the lessons held cars that were slower than it, and none on an empty road."""
    settings = TrafficSettings(mode="learned", weights=str(fitted))
    scene = behind(speed, gap)
    standing = np.repeat(scene.ego_state[None], HORIZON_STEPS + 1, axis=0)
    away = standing + np.array([0.0, 500.0, *[0.0] * 9])
    traffic = prepare_traffic(scene, settings)
    braked, free = (roll_out(traffic, ego).agents for ego in (standing, away))
    assert braked.velocities[-1, 0, 0] < 0.6 * speed < 0.7 * free.velocities[-1, 0, 0]
    assert np.abs(free.boxes[:, 0, 1]).max() < 0.5
    stopped = roll_on(traffic, np.repeat(scene.ego_state[None], 101, axis=0))
    assert stopped.velocities[-1, 0, 0] == 0.0 and 0.3 < gap - stopped.boxes[-1, 0, 0] < 3.0


@pytest.mark.slow
def test_the_same_command_writes_the_same_file_that_names_its_logs(fitted: Path, tmp_path: Path) -> None:
    words = [*TOWN, *BRIEF, f"clips.cache_dir={fitted.parent / 'towns'}"]
    files = [tmp_path / name for name in ("a.npz", "b.npz")]
    for file in files:
        assert main([*words, f"out={file}"]) == COMPLETE
    assert files[0].read_bytes() == files[1].read_bytes()
    with np.load(files[0], allow_pickle=False) as file:
        record = json.loads(str(file["record"]))
    assert record["rounds"] == 2 and record["epochs"] == 1 and len(record["logs"]) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("rounds=0",), "rounds=0: at least one is needed"),
        (("network.width=0",), "width=0: must be positive"),
        (("network.widht=2",), "widht"),
        (("clips=av2", "clips.root=/nowhere/at/all"), "/nowhere/at/all: no such folder"),
    ],
)
def test_what_cannot_be_fitted_is_told_in_one_line(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(list(words)) == BAD_CONFIG
    shown = capsys.readouterr().err
    assert said in shown and shown.count("\n") == 1
