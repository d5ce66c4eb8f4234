"""What seed 0 looked like at this version: whoever changes the town raises reader.TOWN_VERSION and these numbers."""

import pytest

from factory.datasets.town.draw import TownRenderer, build_rig, paint, world_from_ego
from factory.datasets.town.reader import TOWN_VERSION
from factory.datasets.town.town import plan_log

# version: number of tracks of log 1, its ego at step 60 (x, y [m], heading [rad]), mean colour of its front picture
GOLDEN = {3: (97, (2294.456, 1603.013, 7.144), (124.02, 127.04, 130.67))}


def test_a_changed_town_has_a_raised_version() -> None:
    town, drive = plan_log(0, 1)
    renderer = TownRenderer(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)
    picture = paint(renderer.scene_at(60), build_rig(("ring_front_center",), 160, 90)[0], world_from_ego(drive.ego[60]))
    n_tracks, ego, colour = GOLDEN[TOWN_VERSION]
    assert len(drive.tracks) == n_tracks
    assert drive.ego[60] == pytest.approx(ego, abs=0.01)
    assert picture.mean(axis=(0, 1)) == pytest.approx(colour, abs=0.1)
