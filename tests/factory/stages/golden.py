"""What each stage gave at its version, of tests/factory/stages/test_stage_versions.py's small inputs."""

from collections.abc import Mapping
from dataclasses import dataclass

Sums = tuple[float, float]


@dataclass(frozen=True)
class Golden:
    """What a stage gave when it had this version."""

    version: int
    sums: Mapping[str, Sums]
    tolerance: float = 1e-6


GOLDEN: dict[str, Golden] = {
    "clip": Golden(
        5,
        {
            "av2 ego": (4608.74131, -0.406116227),
            "av2 boxes": (9813.0011, -0.413924597),
            "av2 velocities": (53.1836388, 0.0914337301),
            "av2 lanes": (20210.675, 45.3735891),
            "av2 rings": (3609.34453, 188.613004),
            "av2 route": (20210.675, 45.3735891),
            "nuscenes ego": (189.807079, -0.501655347),
            "nuscenes boxes": (825.141528, -1.407639),
            "nuscenes velocities": (31.7078466, -0.0746650518),
            "nuscenes lanes": (3383.77301, -4.39364063),
            "nuscenes rings": (2578.08352, 0.740293166),
            "nuscenes route": (1892.07311, -3.42528001),
        },
    ),
    "perturb": Golden(
        3,
        {
            "indices": (260.846972, 26.2035031),
            "ends": (2.99269569, -0.856986137),
            "scores": (4.86919957, 0.245775941),
            "counts": (37.3333333, 24.0813232),
        },
    ),
    "rollout": Golden(
        4,
        {
            "first idm ego": (31.1562574, 0.259936504),
            "first idm boxes": (179.467451, 1.28283393),
            "first idm velocities": (43.3612347, 2.1024209),
            "first yields ego": (31.1562574, 0.259936504),
            "first yields boxes": (176.615561, 1.23582649),
            "first yields velocities": (40.2964639, 1.98258503),
            "first replay ego": (31.1562574, 0.259936504),
            "first replay boxes": (176.615561, 1.23582649),
            "first replay velocities": (40.2964639, 1.98258503),
            "second idm ego": (63.6963826, 1.36275349),
            "second idm boxes": (334.633911, 2.36329868),
            "second idm velocities": (46.249876, 2.24469206),
            "second yields ego": (63.6963826, 1.36275349),
            "second yields boxes": (328.751075, 2.27805524),
            "second yields velocities": (40.97223, 2.11620966),
            "second replay ego": (63.6963826, 1.36275349),
            "second replay boxes": (319.763633, 2.24001935),
            "second replay velocities": (40.4219, 2.07236517),
        },
    ),
    "expert": Golden(
        3,
        {
            "pdm_closed": (65.5331885, 1.87555805),
            "recovery": (60.4749086, 1.65434785),
            "human": (59.884333, 1.64346064),
        },
    ),
    "reward": Golden(
        2,
        {
            "nc": (5.7449253, -0.106017229),
            "dac": (6.19677335, -0.139455048),
            "ddc": (6.45497224, -0.237014777),
            "tlc": (7.74596669, -0.0717041948),
            "ep": (4.40662184, 0.0733525005),
            "ttc": (5.55127613, -0.133556478),
            "lk": (5.16397779, -0.749919236),
            "hc": (7.74596669, -0.0717041948),
            "ep_raw_m": (299.355166, 4.83148909),
            "multiplier": (4.26028168, -0.16172876),
            "pdm_score": (3.169052, -0.139773396),
            "collision_index": (5747.37819, -117.849186),
            "dac_index": (6243.12005, -139.932235),
            "ddc_index": (6494.21847, -233.265339),
            "tlc_index": (7745.96669, -71.7041948),
            "ttc_index": (5602.65771, -132.931314),
            "lk_index": (5247.11784, -729.387655),
            "hc_index": (7745.96669, -71.7041948),
            "comfort": (18.973666, 0.050716014),
            "way on": (3496.78756, -406.624998),
            "hit": (7100.90841, -127.986939),
            "hit braking": (7487.92272, -295.910856),
        },
    ),
    "render": Golden(
        16,
        {
            "rendered": (714.36471, 34.856669),
            "drawn": (1001.11158, 15.1497572),
            "gate": (0.198662924, -0.00442795896),
            "likeness": (0.934323072, 0.934323072),
        },
        tolerance=1e-3,
    ),
    "write": Golden(
        6,
        {
            "simulated": (492.8868, 15.6325),
            "simulated text": (3059.41967, -31.4213067),
            "human": (652.576569, -14.5853737),
            "human text": (2554.0555, -2.12202577),
            "label_subscores": (549.77183, 63.7185064),
            "label_progress": (478.196993, -18.9944372),
            "labels text": (947.357383, -11.9462762),
            "schema": (5647.78648, -17.9900049),
        },
    ),
}
