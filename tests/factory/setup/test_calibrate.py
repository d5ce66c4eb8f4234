"""What a run would take: by clips what its clips take, by blocks what their blocks take."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from ray.cluster_utils import Cluster

from factory.__main__ import main as factory
from factory.config.run import load_config
from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback
from factory.graph.steps import Spent
from factory.pipeline import FactoryWork
from factory.setup import calibrate
from factory.setup.calibrate import Calibration, Machines, _time_line, estimate_run_size
from factory.setup.settings import assemble
from tasks.render.fit import on_torch, reconstruct
from tasks.render.fit.on_torch import TorchBackend
from tasks.render.scene import on_device
from tasks.render.scene.on_device import Device
from tasks.render.settings import RenderSettings
from tasks.render.splatting import gsplat_backend
from tests.bench.by_kernels import by_kernels, rasterization
from tests.planners.navsim.test_chain import RENDERED, write_navsim

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


@pytest.mark.parametrize(
    ("on_gpu", "hours"), [(False, {"render": "1.00", "reward": "2.00"}), (True, {"render": "4.00", "reward": "2.00"})]
)
def test_a_busy_machine_makes_a_plan_no_dearer_but_a_gpu_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, on_gpu: bool, hours: dict[str, str]
) -> None:
    spent = {"render": Spent(wall_s=14400.0, cpu_s=3600.0), "reward": Spent(wall_s=14400.0, cpu_s=7200.0)}
    monkeypatch.setattr(calibrate, "measure", lambda run, refs: Calibration(clips=1, attempts=1, seconds=spent))
    monkeypatch.setattr(calibrate, "machines_of", lambda run: Machines("here", 2, 1, 64.0))
    work = SimpleNamespace(block=lambda ref: None, draws_on_gpu=on_gpu)
    config = SimpleNamespace(render=RenderSettings(), workers=None, gpu_share=0.1)
    said = estimate_run_size(SimpleNamespace(work=work, config=config), [None])  # type: ignore[arg-type, list-item]
    told = dict(re.findall(r"  (\w+) +[0-9.]+ a clip +([0-9.]+)\n", said))
    assert told == hours


def test_gpus_hold_a_run_up_where_the_cores_are_done_sooner() -> None:
    """Fits by two at a time, pictures by `gpu_share`."""
    run = SimpleNamespace(config=SimpleNamespace(workers=2000, gpu_share=0.1), work=SimpleNamespace(draws_on_gpu=True))
    hours = {"reconstruct": 600.0, "perturb": 40.0, "reward": 60.0, "render": 500.0}
    said = _time_line(run, hours, Machines("here", 4, 8, 64.0))  # type: ignore[arg-type]
    assert "0.60 h on 2000 cores; 350.00 GPU-hours, 43.75 h on 8 GPUs" in said and "the GPUs" in said
    run.config.workers = None
    said = _time_line(run, hours, Machines("here", 4, 8, 64.0))  # type: ignore[arg-type]
    assert "300.00 h on 4 cores" in said and "reconstruct, 50% of it" in said and "the GPUs" not in said


@pytest.mark.slow
def test_navsim_s_logs_are_billed_for_the_gpus_of_a_cluster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Measured on a device that computes as this package's kernels do; two nodes have 32 cores and four GPUs each, in
    name."""
    write_navsim(tmp_path)
    monkeypatch.setattr(on_device, "cuda", lambda packed: Device("cpu", rasterization, packed))
    monkeypatch.setattr(on_torch, "TorchBackend", lambda draw, device: TorchBackend(by_kernels, "cpu"))
    monkeypatch.setattr(reconstruct, "take_gpu", lambda: 0)
    monkeypatch.setattr(gsplat_backend, "require", lambda: (None, None))
    monkeypatch.setattr(FactoryWork, "warm", lambda self: None)  # which builds gsplat's extension
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 32, "num_gpus": 4, "include_dashboard": False})
    try:
        nodes.add_node(num_cpus=32, num_gpus=4)
        monkeypatch.setenv("RAY_ADDRESS", nodes.address)
        clips = [f"clips.root={tmp_path / 'navsim_logs/mini'}", f"clips.maps={tmp_path / 'maps'}"]
        clips += [f"clips.sensors={tmp_path / 'sensor_blobs/mini'}", f"clips.cache_dir={tmp_path / 'kept'}"]
        how = ["render.backend=gsplat", "render.frames=now", "executor=ray", "rounds=1", "vocabulary.k=16"]
        how += [*(key for key in RENDERED if "frames" not in key), "reward.labels=none", "experts=[pdm_closed]"]
        asked = ["clips=navsim", *clips, "+clips.stride_s=4.0", *how, f"out={tmp_path / 'out'}"]
        assert factory(["plan", *asked]) == 0
        assert not ray.is_initialized(), "who joined a cluster to look at it has left it"
    finally:
        nodes.shutdown()
    said = capsys.readouterr().out
    number = "([0-9.]+)"
    bill = f"{number} h on 64 cores; {number} GPU-hours, {number} h on 8 GPUs, most in .* GB on 2 nodes"
    assert re.search(bill, said), said
    assert re.search(f"  reconstruct +{number} a block", said) and re.search(f"  render +{number} a clip", said)
