"""What a planner plans from NAVSIM's input is what it plans from a row of the same content."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from factory.config.compose import ConfigError
from planners.data.batch import COMMANDS, ImageLayout
from planners.evaluation.planning import batch_samples, plan_samples, without_future
from planners.models.planner import Planner
from planners.navsim.agent import agent_input_arrays
from planners.navsim.serve import FRONT, AgentPlanner, agent_cameras, observation_of
from tests.planners.navsim.agent_inputs import DISTORTION, agent_input, row
from tests.planners.navsim.trained import FAMILIES, made, saved


def asked(pilot: AgentPlanner, given: Any, n_poses: int = 8) -> Any:
    return pilot.plan(observation_of(agent_input_arrays(given, pilot.cameras), pilot.cameras), n_poses)


@pytest.fixture(scope="module", params=FAMILIES)
def family(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Planner, AgentPlanner]:
    planner = made(request.param)
    return planner, AgentPlanner(saved(planner, tmp_path_factory.mktemp(request.param)))


@pytest.mark.parametrize("command", COMMANDS)
def test_the_plan_is_that_of_the_row_to_the_last_bit(family: tuple[Planner, AgentPlanner], command: str) -> None:
    planner, pilot = family
    fine = plan_samples(planner, [row(FRONT, command)])[0]
    np.testing.assert_array_equal(asked(pilot, agent_input(FRONT, command), 40), fine.astype(np.float32))
    coarse = asked(pilot, agent_input(FRONT, command))
    np.testing.assert_allclose(coarse, fine[4::5], atol=1e-6)
    assert coarse.dtype == np.float32 and coarse.shape == (8, 3)


def test_the_plan_depends_on_all_that_is_shown(family: tuple[Planner, AgentPlanner]) -> None:
    planner, pilot = family
    if pilot.cameras:
        pictures = agent_input(FRONT)
        before = asked(pilot, pictures, 40)
        for name in pilot.cameras:
            camera = getattr(pictures.cameras[-1], name)
            assert camera.image is not None
            camera.image = 255 - camera.image
        if planner.name != "gtrs_dense":  # which chooses among 64
            assert not np.array_equal(asked(pilot, pictures, 40), before)
    seen = observation_of(agent_input_arrays(agent_input(FRONT), pilot.cameras), pilot.cameras)
    turned = replace(seen, status=np.float32([0, 0, 1, 0, 1, 0, 0, 0]))
    assert not torch.equal(pilot.batch_of(seen).status, pilot.batch_of(turned).status)


@pytest.mark.slow
def test_the_rig_s_own_pictures_differ_as_little_as_a_jpeg_decoded_smaller(tmp_path: Path) -> None:
    planner, size = made("ltf_small"), (1920, 1080)
    pilot = AgentPlanner(saved(planner, tmp_path))
    theirs = pilot.batch_of(observation_of(agent_input_arrays(agent_input(FRONT, size=size), FRONT), FRONT))
    ours = batch_samples([without_future(row(FRONT, size=size))], planner.needs_to_plan)
    assert theirs.image is not None and ours.image is not None
    assert (theirs.image.float() - ours.image.float()).abs().mean() < 0.5
    np.testing.assert_allclose(planner.plan(theirs), planner.plan(ours), atol=0.02)


def test_the_batch_holds_what_the_row_s_does(tmp_path: Path) -> None:
    planner = made("diffusiondrive_small")
    pilot = AgentPlanner(saved(planner, tmp_path))
    theirs = pilot.batch_of(observation_of(agent_input_arrays(agent_input(FRONT), FRONT), FRONT))
    ours = batch_samples([without_future(row(FRONT))], planner.needs)
    for name in ("status", "history", "image"):
        assert torch.equal(getattr(theirs, name), getattr(ours, name)), name
    assert theirs.bev is None and ours.bev is not None, "it is looked at in training alone"


def test_pinhole_pictures_bend_straight_what_the_lens_bent(tmp_path: Path) -> None:
    folder = saved(made("ltf_small"), tmp_path)
    as_it_is, straight = AgentPlanner(folder), AgentPlanner(folder, undistort=True)
    bent = observation_of(agent_input_arrays(agent_input(FRONT), FRONT), FRONT)
    ideal = agent_input(FRONT)
    for name in FRONT:
        getattr(ideal.cameras[-1], name).distortion = 0 * DISTORTION
    flat = observation_of(agent_input_arrays(ideal, FRONT), FRONT)
    images = [pilot.batch_of(seen).image for pilot in (as_it_is, straight) for seen in (bent, flat)]
    assert torch.equal(images[0], images[1]) and torch.equal(images[0], images[3])  # type: ignore[arg-type]
    assert not torch.equal(images[0], images[2])  # type: ignore[arg-type]


def test_cameras_are_found_by_name_else_by_direction() -> None:
    assert agent_cameras(None) == ()
    assert agent_cameras(ImageLayout()) == FRONT
    assert agent_cameras(ImageLayout(cameras=("CAM_L2", "CAM_B0", "CAM_R2"))) == ("cam_l2", "cam_b0", "cam_r2")
    av2 = ImageLayout(cameras=("ring_front_left", "ring_front_center", "ring_front_right"))
    assert agent_cameras(av2, FRONT) == FRONT
    assert agent_cameras(ImageLayout(), ["cam_f0"]) == ("cam_f0",)
    with pytest.raises(ConfigError, match=r"no camera ring_front_left.*give cameras="):
        agent_cameras(av2)
    with pytest.raises(ConfigError, match="no camera front; it has cam_f0"):
        agent_cameras(ImageLayout(), ["front"])
    with pytest.raises(ConfigError, match="1, in the places of 3"):
        agent_cameras(av2, ["cam_f0"])
    with pytest.raises(ConfigError, match="no picture"):
        agent_cameras(None, ["cam_f0"])


def test_cameras_by_direction_must_look_there(tmp_path: Path) -> None:
    pilot = AgentPlanner(saved(made("ltf_small"), tmp_path))
    crossed = agent_input(FRONT)
    now = crossed.cameras[-1]
    now.cam_l0, now.cam_r0 = now.cam_r0, now.cam_l0
    with pytest.raises(ValueError, match="do not look left, ahead and right"):
        asked(pilot, crossed)
    asked(AgentPlanner(str(tmp_path), cameras=FRONT), crossed)


def test_who_wants_more_than_navsim_shows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"looks at a raster of map and agents"):
        AgentPlanner(saved(made("ego_mlp_bev_small"), tmp_path))
    with pytest.raises(ConfigError, match="plans from the log itself"):
        AgentPlanner("pdm_closed")
    with pytest.raises(ConfigError, match="takes samples"):
        AgentPlanner("tests.planners.navsim.test_pilot:OfSamples")
    assert asked(AgentPlanner("constant_velocity"), agent_input(()))[-1] == pytest.approx(
        [4 * np.hypot(6.2, 0.1), 0.0, 0.0]
    )


class OfSamples:
    def plan(self, sample: Any) -> Any:
        return np.zeros((8, 3))


def test_an_input_that_planners_were_not_trained_on_is_refused() -> None:
    pilot = AgentPlanner("constant_velocity")
    for spoil, message in (
        (lambda given: given.ego_statuses.pop(0), "a history of 3 frames"),
        (lambda given: setattr(given.ego_statuses[-1], "in_global_frame", True), "global frame"),
        (lambda given: setattr(given.ego_statuses[-1], "driving_command", np.zeros(4)), "driving_command"),
        (lambda given: setattr(given.ego_statuses[-1], "driving_command", np.array([0, 1, 0])), "status must be"),
        (lambda given: setattr(given.ego_statuses[0], "ego_pose", np.full(3, np.nan)), "history must be"),
    ):
        given = agent_input(())
        spoil(given)
        with pytest.raises(ValueError, match=message):
            asked(pilot, given)


def test_a_picture_that_is_missing_or_none_is_named(tmp_path: Path) -> None:
    pilot = AgentPlanner(saved(made("ltf_small"), tmp_path))
    with pytest.raises(ValueError, match="no picture of cam_r0 at now"):
        asked(pilot, agent_input(("cam_f0", "cam_l0")))
    given = agent_input(FRONT)
    given.cameras[-1].cam_f0.image = np.zeros((90, 160), np.uint8)
    with pytest.raises(ValueError, match="cam_f0"):
        asked(pilot, given)
    given.cameras[-1].cam_f0.image = np.zeros((90, 160, 3), np.float32)
    with pytest.raises(ValueError, match="uint8"):
        asked(pilot, given)
