"""What a command line gets wrong about real logs is told before any of them is read."""

import subprocess
import sys
from pathlib import Path

READ_WITH = ("factory.datasets.av2.reader", "numba", "scipy", "shapely", "ray", "deltalake")


def test_a_camera_that_no_rig_has_is_told_from_the_calibration_alone(shared_root: Path, tmp_path: Path) -> None:
    argv = ["run", "clips=av2", f"clips.root={shared_root / 'data/av2/sensor'}", "render.cameras=[ring_front]"]
    code = (
        f"import sys; from factory.__main__ import main; code = main({[*argv, f'out={tmp_path}/here']!r})\n"
        f"print(code, [name for name in {READ_WITH} if name in sys.modules])"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=120)
    assert done.stdout == "2 []\n", done.stderr
    assert done.stderr.startswith("error: render.cameras: no camera ring_front; this rig has ring_front_center, ring_")
    assert "stereo_front_right" in done.stderr and done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
