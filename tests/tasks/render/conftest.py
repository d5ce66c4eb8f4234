"""One small scene for the tests of this folder."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import street

from tasks.render.scene.build import AssetSettings, RenderAsset, build_asset


@pytest.fixture(scope="session")
def street_asset() -> RenderAsset:
    """Built from ten photos and twenty sweeps of the closed-form street."""
    photos, sweeps = street.drive(10)
    return build_asset(photos, sweeps, street.tracks(), AssetSettings(hold_out_every=0))
