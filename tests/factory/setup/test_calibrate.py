"""What a run would take: by clips what its clips take, by blocks what their blocks take."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from factory.config.run import load_config
from factory.setup import calibrate
from factory.setup.calibrate import estimate_run_size
from factory.setup.settings import assemble

SMALL = (
    "clips=synthetic", "clips.n_clips=4", "vocabulary.k=16", "experts=[pdm_closed,human]", "rounds=1",
    "reward.labels=none", "clips.settings.cameras=[ring_front_center]", "clips.settings.photo_steps=36",
    "clips.settings.width=64", "clips.settings.height=36", "clips.settings.lidar_azimuths=90",
    "render.fit.iterations=20", "render.fit.start_gaussians=2000", "render.psnr_min=0", "render.camera_psnr_min=0",
    "render.gate.enabled=false",
)  # fmt: skip


@pytest.mark.slow
def test_a_fit_is_counted_for_each_block_and_not_again_once_it_is_there(tmp_path: Path) -> None:
    """Four clips of two logs, each a block: three are walked, of both; a run on them would fit two."""
    config = load_config([*SMALL, f"clips.cache_dir={tmp_path / 'towns'}", f"out={tmp_path / 'out'}"])
    run = assemble(config)
    said = estimate_run_size(run, run.refs)
    each, hours = re.search(r"  reconstruct +([0-9.]+) a block +([0-9.]+)\n", said).groups()  # type: ignore[union-attr]
    assert float(hours) == pytest.approx(2 * float(each) / 3600.0, abs=0.0051)
    assert "expected for 4 clips of 2 blocks: " in said and " GB of cache, " in said
    assert "6 of 6 attempts accepted" in said, "by the planner and by the log, whose photos are not drawn"
    assert "for a GPU: 16 pictures of 320x180 and 2 fits of 20 iterations" in said
    again = estimate_run_size(run, run.refs)
    assert "a block" not in again and "blocks take is not counted" in again
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").glob("**/*.parquet"))


def test_eight_gpus_have_a_bill_of_their_own_and_hold_the_run_up_where_they_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits by two at a time, pictures by `gpu_share`; on so many cores the rest is done sooner."""
    monkeypatch.setattr(calibrate, "_gpus", lambda: 8)
    run = SimpleNamespace(config=SimpleNamespace(workers=2000, gpu_share=0.1), work=SimpleNamespace(draws_on_gpu=True))
    hours = {"reconstruct": 600.0, "perturb": 40.0, "reward": 60.0, "render": 500.0}
    said = calibrate._time_line(run, hours)  # type: ignore[arg-type]
    assert "0.60 h on 2000 cores; 350.00 GPU-hours, 43.75 h on 8 GPUs" in said and "the GPUs" in said
    run.config.workers = 4
    said = calibrate._time_line(run, hours)  # type: ignore[arg-type]
    assert "300.00 h on 4 cores" in said and "reconstruct, 50% of it" in said and "the GPUs" not in said
