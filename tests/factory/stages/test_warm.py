"""Warming compiles what a run needs: with the files that it lists and no others, no task compiles anything."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from factory.config.run import load_config, photos_alone
from factory.graph.steps import NotReady
from factory.stages import warm
from factory.stages.warm import NOT_HERE, compile_kernels, kernel_parts, part_marker
from tasks.caches import without_checksum
from tasks.kernels.compiled import cache_dir
from tasks.render.scene import on_device
from tasks.render.settings import Adjust, Backend, RenderMode, RenderSettings, RigSettings
from tests.bench.by_kernels import rasterization

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).resolve().parents[3]
TOWN = ("clips=synthetic", "clips.n_clips=1", "vocabulary.k=64")
BLIND = ("clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "render=none")


@pytest.fixture(scope="module")
def towns(tmp_path_factory: pytest.TempPathFactory) -> str:
    return f"clips.cache_dir={tmp_path_factory.mktemp('towns')}"


def kept(cache: Path) -> set[str]:
    """Compiled functions; less those that paint the town, which is no part of a run on logs."""
    return {path.relative_to(cache).as_posix() for path in cache.glob("tasks/**/*.kernel")}


def run_with_these(parts: list[str], tmp_path: Path, *arguments: str) -> tuple[set[str], set[str]]:
    """A run whose cache holds what the parts list alone: the files before it and after it."""
    return done_with_these(parts, tmp_path, "-m", "factory.run", *arguments, f"out={tmp_path / 'out'}")


def done_with_these(parts: list[str], tmp_path: Path, *command: str) -> tuple[set[str], set[str]]:
    """The same of any words for Python."""
    compile_kernels(parts)
    cache = tmp_path / "cache" / cache_dir().name
    for part in parts:
        listing = part_marker(part)
        for name in (listing.name, *without_checksum(listing.read_bytes(), listing.name).decode().splitlines()):
            (cache / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(cache_dir() / name, cache / name)
    if (cache_dir() / "factory").is_dir():  # what paints the town
        shutil.copytree(cache_dir() / "factory", cache / "factory")
    before = kept(cache)
    done = subprocess.run(
        [sys.executable, *command],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache.parent)},
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "compiling" not in done.stderr
    return before, kept(cache)


def test_a_run_on_a_town_with_cameras_compiles_nothing(tmp_path: Path, towns: str) -> None:
    seen = ("clips.settings.cameras=[ring_front_center]", "clips.settings.photo_steps=36")
    small = ("clips.settings.width=64", "clips.settings.height=36", "clips.settings.lidar_azimuths=90")
    fitted = ("render.fit.iterations=20", "render.fit.start_gaussians=2000", "render.psnr_min=0")
    drawn = (*TOWN, *seen, *small, *fitted, "experts=[recovery]")
    before, after = run_with_these(["judge", "plan", "drive", "fit"], tmp_path, *drawn, towns, "executor=local")
    assert after == before
    assert any(name.startswith("tasks/render/") for name in after)


CORRECTED = """
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, {tests!r})
from printed_street import CAMERAS, photographed

from factory.stages.assets import load_or_build_scene
from factory.stages.entries import tiny_clip
from tasks.render.settings import FitSettings
from tasks.render.settings import RenderSettings

folder = Path({folder!r})
clip = replace(tiny_clip(), block=photographed(folder), cameras=CAMERAS)
fit = FitSettings(iterations=4, start_gaussians=500, most_gaussians=600, refine_every=2, refine_from=2, pose_from=0)
scene = load_or_build_scene(clip, RenderSettings(width=100, height=56, fit=fit), folder)
assert scene is not None and scene.rig, "the rig is corrected"
"""


def test_a_block_whose_rig_is_corrected_compiles_nothing(tmp_path: Path) -> None:
    told = CORRECTED.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    before, after = done_with_these(["fit", "rig"], tmp_path, "-c", told)
    assert after == before
    assert any(name.startswith("tasks/render/rig/") for name in after)


def test_kernels_of_the_rig_s_correction_are_compiled_where_it_may_be_corrected() -> None:
    def asked(photos_alone: bool, **how: object) -> bool:
        render = RenderSettings(**how)  # type: ignore[arg-type]
        return "rig" in kernel_parts(True, "idm", render, photos_alone)

    assert asked(photos_alone=True) and not asked(photos_alone=False)
    assert asked(photos_alone=False, rig=RigSettings(adjust=Adjust.ON))
    assert not asked(photos_alone=True, rig=RigSettings(adjust=Adjust.OFF))
    assert not asked(photos_alone=True, mode=RenderMode.MAP)


@pytest.mark.parametrize(
    ("words", "alone"),
    [
        (["clips=synthetic"], False),
        (["clips=synthetic", "clips.settings.lidar_beams=0"], True),
        (["clips=av2", "clips.root=."], False),
        (["clips=scenarionet", "clips.root=."], False),
        (["clips=scenarionet", "clips.root=.", "clips.cameras=."], True),
        (["clips=navsim", "clips.root=.", "clips.maps=.", "clips.sensors=."], True),
        (["clips=custom", "clips._target_=my_package.MyReader"], True),
    ],
)
def test_a_reader_s_settings_tell_whether_photos_may_come_without_lidar(words: list[str], alone: bool) -> None:
    assert photos_alone(load_config([*words, "out=somewhere"])) is alone


def test_the_public_traffic_needs_kernels_of_its_own_and_no_idm(tmp_path: Path, towns: str) -> None:
    navsim = ("traffic=navsim", "reward.labels=none")
    before, after = run_with_these(
        ["judge", "plan", "navsim"], tmp_path, *TOWN, *BLIND, *navsim, towns, "executor=local"
    )
    assert after == before
    assert not any(name.startswith("tasks/rollout/simulate") for name in after)


BLINDLY = """
import sys
from factory.run import main

assert main({words!r}) == 0
others = ("tasks.render.scene", "tasks.render.rig", "tasks.render.fit", "factory.stages.imaging", "numba.np.arrayobj")
assert not (loaded := [name for name in sys.modules if name.startswith(others)]), loaded
"""


def test_replayed_traffic_needs_no_idm_and_a_run_without_pictures_loads_nothing_that_draws(
    tmp_path: Path, towns: str
) -> None:
    replay = ("traffic=replay", "reward.labels=none", "executor=local", f"out={tmp_path / 'out'}")
    told = BLINDLY.format(words=[*TOWN, *BLIND, *replay, towns])
    before, after = done_with_these(["judge", "plan"], tmp_path, "-c", told)
    assert after == before
    assert not any(name.startswith("tasks/rollout/simulate") for name in after)


@pytest.mark.ray
def test_a_run_without_images_needs_no_renderer_and_arrays_out_of_ray_s_store_no_forms_of_their_own(
    tmp_path: Path, towns: str
) -> None:
    """They cannot be written, which is another type to numba."""
    before, after = run_with_these(["judge", "plan", "drive"], tmp_path, *TOWN, *BLIND, towns, "workers=1")
    assert after == before
    assert not any(name.startswith("tasks/render/") for name in after)


def test_warming_that_finds_all_compiled_imports_none_of_what_enters_it() -> None:
    """The command's second time is some 0.6 s: the marker files tell, and the files that they list are there."""
    compile_kernels(["judge", "plan", "town"])
    assert "factory/datasets/town/raster/rasterise" in part_marker("town").read_text(errors="replace")
    told = "from factory.__main__ import main; assert main({!r}) == 0; import sys; print(*sys.modules)"
    command = [sys.executable, "-c", told.format(["warm", "judge", "plan", "town"])]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert not {"shapely", "cv2", "factory.stages.entries"} & set(done.stdout.split())


def test_gsplat_is_built_before_any_task_where_a_run_draws_with_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """On a GPU that is this CPU: its part draws once, by both settings that ask for it, and is marked as done."""
    for backend, wanted in ((Backend.CPU, False), (Backend.GSPLAT, True), (Backend.GSPLAT_DENSE, True)):
        assert ("gpu" in kernel_parts(True, "idm", RenderSettings(backend=backend), False)) is wanted
    drawn: list[int] = []

    def draws(**given: object) -> object:
        drawn.append(len(given["means"]))  # type: ignore[arg-type]
        return rasterization(**given)  # type: ignore[arg-type]

    monkeypatch.setattr(warm, "version", lambda name: "1")
    monkeypatch.setattr(on_device, "cuda", lambda packed: on_device.Device("cpu", draws, packed))
    monkeypatch.setattr(warm, "cache_dir", lambda: tmp_path)
    monkeypatch.setattr(warm, "USED", set())
    monkeypatch.setattr(warm, "ignore_terminal_signals", lambda: None)
    monkeypatch.setattr(warm.gc, "disable", lambda: None)
    assert warm._compile_and_mark("gpu") == 0 and drawn == [1]
    assert warm._is_compiled("gpu")
    monkeypatch.setattr(warm, "version", lambda name: "2")
    assert not warm._is_compiled("gpu"), "another torch or gsplat is built anew"


def test_a_gsplat_that_cannot_be_built_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(**given: object) -> object:
        raise RuntimeError("Error building extension 'gsplat_cuda': nvcc: not found")

    monkeypatch.setattr(on_device, "cuda", lambda packed: on_device.Device("cpu", fails, packed))
    monkeypatch.setattr(warm, "ignore_terminal_signals", lambda: None)
    monkeypatch.setattr(warm.gc, "disable", lambda: None)
    assert warm._compile_and_mark("gpu") == NOT_HERE
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "nvcc: not found" in said and "render.backend=cpu" in said
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(NotReady, match="needs torch and gsplat"):
        compile_kernels(["gpu"])
