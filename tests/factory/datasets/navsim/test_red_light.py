"""Plans that pass a light or wait before it, scored as NAVSIM's own code scores them, sub-score by sub-score.

PUBLIC was printed by autonomousvision/navsim @ 0a380a9 (its loader, metric cache, log replay and `pdm_score` without
the human filter, Python 3.11, numpy 1.26) for the logs, city and plans that red_light.py writes.
"""

import numpy as np
import pytest

from factory.datasets.navsim.reader import NavsimReader
from tasks.trajectories import score_trajectories
from tests.factory.datasets.navsim.red_light import RED, plans, write
from tests.factory.datasets.navsim.small import reader_of, write_city

pytestmark = pytest.mark.slow
NAMES = ("nc", "dac", "ddc", "tlc", "ep", "ttc", "lk", "hc", "pdm_score")
PUBLIC = {  # log -> steady, braking, fast, late: NAMES
    "2021.06.14.18.00.00_veh-51_00000_00100": [
        (1.0, 1.0, 1.0, 1.0, 0.9530882250884886, 1.0, 1.0, 1.0, 0.9832457946744603),
        (1.0, 1.0, 1.0, 1.0, 0.46698109890947537, 1.0, 1.0, 1.0, 0.809636106753384),
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (1.0, 1.0, 1.0, 1.0, 0.8234853403419864, 1.0, 1.0, 1.0, 0.936959050122138),
    ],
    "2021.06.14.18.00.00_veh-51_00200_00300": [
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
        (1.0, 1.0, 1.0, 1.0, 0.7156379116595801, 1.0, 1.0, 1.0, 0.8984421113069929),
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
    ],
    "2021.06.14.18.00.00_veh-51_00400_00500": [
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (1.0, 1.0, 1.0, 1.0, 0.7156379116595801, 1.0, 1.0, 1.0, 0.8984421113069929),
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    ],
    "2021.06.14.18.00.00_veh-51_00600_00700": [
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
    ],
    "2021.06.14.18.00.00_veh-51_00800_00900": [
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
        (1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0),
    ],
}


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> NavsimReader:
    root = tmp_path_factory.mktemp("lights")
    write(root)
    write_city(root)
    return reader_of(root, sensors=None)


@pytest.mark.parametrize("log", RED)
def test_every_sub_score_is_the_public_code_s(reader: NavsimReader, log: str) -> None:
    (ref,) = (ref for ref in reader.index().refs if ref.log_id == log)
    scores = score_trajectories(reader.read(ref), plans())
    ours = np.stack([getattr(scores, name) for name in NAMES], axis=1)
    np.testing.assert_allclose(ours, PUBLIC[log], rtol=0.0, atol=1e-9, err_msg=str(NAMES))
