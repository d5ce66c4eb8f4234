"""`python -m factory scene build|film`: a scene of photos and their poses alone, and how it looks from aside."""

import json
import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factory.commands.table import COMMANDS
from factory.datasets.scenarionet.photos import read_photo_drive
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.stages.assets import load_or_build_scene
from factory.stages.scene_file import read_scene
from tasks.render.scene.asset import psnr
from tasks.render.settings import FitSettings, RenderSettings
from tasks.render.views import render_views
from tasks.world.clip import STEP_S, AgentKind, Block, Clip
from tests.bench import bench_alpasim

main = COMMANDS["scene"].load()
FIT = {"iterations": 150, "start_gaussians": 6000, "most_gaussians": 8000, "start_every": 2, "stereo_photos": 2}
SMALL = [f"render.fit.{name}={value}" for name, value in FIT.items()]
WIDTH, HEIGHT = 160, 90
Sidecar = dict[str, Any]


def sidecar_of(clip: Clip, block: Block) -> Sidecar:
    """What is said of the block's photos, and of who moves there."""
    cameras = {
        one.name: {"K": one.intrinsics.tolist(), "width": one.width, "height": one.height}
        | {"cam_to_ego": one.ego_from_camera.tolist()}
        for one in clip.cameras
    }
    folder = Path(block.images[0].uri).parents[1]
    frames = [
        {"camera": file.sensor, "t_s": file.time_s, "file": str(Path(file.uri).relative_to(folder))}
        | {"ego_to_world": file.world_from_ego.tolist()}
        for file in block.images
    ]
    agents = block.agents
    boxes = [
        {"id": name, "kind": agents.kinds[j], "t_s": STEP_S * k, "yaw": agents.boxes[k, j, 2]}
        | {"center": [*agents.boxes[k, j, :2], agents.center_z[k, j]]}
        | {"size": [*agents.boxes[k, j, 3:], agents.heights[j]]}
        for j, name in enumerate(agents.track_ids)
        for k in np.flatnonzero(agents.valid[:, j]).tolist()
    ]
    return {"cameras": cameras, "frames": frames, "boxes": boxes}


@dataclass(frozen=True)
class Drive:
    """A drive through the town, as a clip and as a sidecar."""

    clip: Clip
    content: Sidecar
    photos: Path  # what the sidecar's paths count from
    sidecar: Path


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    home = tmp_path_factory.mktemp("town")
    settings = TownSettings(cameras=("ring_front_center",), width=WIDTH, height=HEIGHT, lidar_beams=0)
    reader = SyntheticReader(home, 1, settings=replace(settings, steps_per_photo=1, photo_steps=36))
    clip = reader.read(reader.index().refs[0])
    assert clip.block is not None
    block = replace(clip.block, ground_m=None)  # which a sidecar does not say
    content = sidecar_of(clip, block)
    (home / "cameras.json").write_text(json.dumps(content))
    return Drive(replace(clip, block=block), content, Path(block.images[0].uri).parents[1], home / "cameras.json")


@pytest.mark.slow
def test_a_sidecar_alone_gives_the_scene_that_a_run_makes_and_a_film_of_it(
    drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same Gaussians, vehicles in nodes of their own, and photos held out that it shows."""
    to, root = tmp_path / "town.scene", f"root={drive.photos}"
    assert main(["build", str(drive.sidecar), root, f"to={to}", *SMALL]) == 0
    said = capsys.readouterr()
    assert "36 photos of 1 cameras, 0 sweeps, in " in said.out and "fit 100/150, " in said.err
    assert [path.name for path in tmp_path.iterdir()] == ["town.scene"]
    assert main(["info", str(to)]) == 0 and capsys.readouterr().out.strip() in said.out
    built = read_scene(to)
    assert drive.clip.block is not None
    assert built.n_held_out == 4 and built.psnr_db > 26.0  # 26.7; their mean colour alone: 13
    of_run = load_or_build_scene(
        drive.clip, RenderSettings(width=WIDTH, height=HEIGHT, fit=FitSettings(**FIT)), tmp_path / "cache"
    )
    assert of_run is not None and "lead" in built.nodes and list(of_run.nodes) == list(built.nodes)
    for one, other in zip((built.background, *built.nodes.values()), (of_run.background, *of_run.nodes.values())):
        np.testing.assert_array_equal(one.means, other.means)
        np.testing.assert_array_equal(one.colours, other.colours)

    films = {}
    for aside_m, turn_deg in ((0.0, 0.0), (1.0, 8.0)):
        film = tmp_path / f"{aside_m:g}.mp4"
        more = [root, f"to={film}", f"aside={aside_m}", f"turn={turn_deg}"]
        assert main(["film", str(to), str(drive.sidecar), *more]) == 0
        with av.open(str(film)) as container:
            assert container.streams.video[0].average_rate == 10
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        films[aside_m] = [[half[4 : 4 + HEIGHT, 4:-4] for half in np.split(frame, 2, axis=1)] for frame in frames]
    assert len(films[0.0]) == len(films[1.0]) == 36
    assert all(psnr(photo, same) > 22.0 for photo, same in films[0.0])
    files, settled = built.photos_of(drive.clip.block.images), built.settled(drive.clip.block.agents, 0.0)
    for k in (0, 20, 35):
        there = files[k].world_from_ego.copy()
        there[:3, 3] += there[:3, 1]  # y is left
        there[:3, :3] = there[:3, :3] @ Rotation.from_euler("z", 8.0, degrees=True).as_matrix()
        rig = built.as_corrected(drive.clip.cameras)
        drawn = np.stack([*render_views(built, rig, there[None], settled, [files[k].time_s / STEP_S], WIDTH, HEIGHT)])[
            0, 0
        ]
        assert psnr(films[1.0][k][1], drawn) > 30.0
    (tmp_path / "elsewhere").mkdir()
    other = tmp_path / "elsewhere" / "cameras.json"
    other.write_text(drive.sidecar.read_text())
    assert main(["film", str(to), str(other), root, f"to={tmp_path / 'x.mp4'}"]) == 2
    assert "is no scene that was built of" in capsys.readouterr().err

    monkeypatch.setattr(sys, "argv", ["bench_alpasim", str(to), str(drive.sidecar), root, "width=32", "instants=1"])
    bench_alpasim.main()
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert len(rows) == 11 and "1 views of 32x18, lenses" in rows[3], rows


def without(key: str) -> Callable[[Sidecar], object]:
    return lambda content: [frame.pop(key) for frame in content["frames"]]


def box(**changed: object) -> Callable[[Sidecar], object]:
    return lambda content: content["boxes"][3].update(changed)


def standing(content: Sidecar) -> None:
    for frame in content["frames"]:
        frame["ego_to_world"] = content["frames"][0]["ego_to_world"]


WRONG: list[tuple[Callable[[Sidecar], object], str]] = [
    (lambda c: c.update(frames=[]), "frames: is empty: no photo"),
    (lambda c: c.update(frames=c["frames"][:1]), "90% of the photos need another .*, 0% of 1 have one"),
    (standing, "need another of their camera 0.3 to 6 m away, 0% of 36 have one: the car stands"),
    (without("ego_to_world"), r"frames\[0\].ego_to_world: missing, and there is no drive at 0 s to take it from"),
    (lambda c: c["frames"][2]["ego_to_world"][0].__setitem__(3, math.nan), r"frames\[2\].ego_to_world: holds NaN"),
    (lambda c: c["frames"][2].update(file="gone.jpg"), "1 of 36 files are not there, such as .*/gone.jpg: do paths"),
    (
        lambda c: c["frames"][-1].update(t_s=700.0),
        "frames.t_s: 700 s from the first to the last: a scene is of some 20",
    ),
    (box(id=None), r"boxes\[3\].id: None: expected text"),
    (box(kind="TREE"), r"boxes\[3\].kind: 'TREE' is none of BICYCLE, PEDESTRIAN, VEHICLE"),
    (box(t_s="now"), r"boxes\[3\].t_s: 'now': expected seconds"),
    (box(yaw=None), r"boxes\[3\].yaw: holds NaN"),
    (box(size=[4.0, 2.0, 0.0]), r"boxes\[3\].size: expected length, width and height above 0"),
    (lambda c: c["boxes"].append(c["boxes"][3]), r"boxes\[\d+\].t_s: .* has two boxes at"),
]


@pytest.mark.parametrize(("spoil", "says"), WRONG, ids=range(len(WRONG)))
def test_a_sidecar_that_no_scene_can_be_made_of_is_refused_in_a_line(
    drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Sidecar], object], says: str
) -> None:
    content = json.loads(json.dumps(drive.content))
    spoil(content)
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    assert main(["build", str(tmp_path / "cameras.json"), f"root={drive.photos}", f"to={tmp_path / 's'}"]) == 2
    said = capsys.readouterr().err
    assert re.search(rf"^error: .*cameras\.json: {says}", said) or re.search(says, said), said
    assert said.count("\n") == 1 and [path.name for path in tmp_path.iterdir()] == ["cameras.json"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("build none.json to=s", "none.json: file: cannot be read"),
        ("build cameras.json", "scene build takes to=..."),
        ("build cameras.json to=.", "to=.: is a folder"),
        ("build cameras.json to=s aside=1", "scene build takes no aside="),
        ("build cameras.json to=s render.width=99", "scene build takes no render.width="),
        ("build cameras.json to=s rounds=2", "scene build takes no rounds="),
        ("build cameras.json to=s width=4", "width=4: must be 16 pixels or more"),
        ("build cameras.json to=s render.fit.iteration=9", "did you mean render.fit.iterations=?"),
        ("build cameras.json to=s masks=nowhere", "nowhere holds no <camera>.png"),
        ("build cameras.json to=s render.cameras=[nope]", "no camera nope; this rig has ring_front_center"),
        ("info s render.fit.iterations=9", "scene info takes no render.fit.iterations="),
        ("serve nowhere", "nowhere: give the out= of a run"),
        ("serve a b c", "scene serve takes a run's out, or a scene and its cameras.json"),
        ("serve out port=65536", "port=65536: must be from 0"),
        ("serve out render.width=99", "scene serve takes no render.width="),
        ("serve out traffic.nope=1", "traffic.nope"),
        ("film s to=f.mp4", "scene film takes a scene and its cameras.json"),
        ("film s cameras.json to=f.gif", "to=f.gif: must end in .mp4"),
        ("film s cameras.json to=f.mp4 aside=nan", "aside=nan: must be a number from -180 to 180"),
    ],
)
def test_words_that_do_not_fit_are_refused_in_a_line(
    drive: Drive, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: str, says: str
) -> None:
    monkeypatch.chdir(drive.sidecar.parent)
    more = [f"root={drive.photos}"] if words.startswith("build cameras.json to=s") else []
    assert main([*words.split(), *more]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1


def test_a_box_is_known_between_two_and_no_further_than_half_a_second_from_one(drive: Drive, tmp_path: Path) -> None:
    """A thing that goes at 10 m/s along x and turns; seen at 0, 1 and 3 s."""
    given = [(0.0, math.pi - 0.1), (1.0, -math.pi + 0.1), (3.0, -math.pi + 0.1)]
    boxes = [
        {"id": 7, "t_s": t, "center": [2000.0 + 10.0 * t, 5.0, 1.0 + t], "size": [4.0, 2.0, 1.5], "yaw": yaw}
        for t, yaw in given
    ]
    (tmp_path / "cameras.json").write_text(json.dumps(drive.content | {"boxes": boxes}))
    agents = read_photo_drive(tmp_path / "cameras.json", drive.photos).block.agents
    assert agents.track_ids == ("7",) and agents.kinds == (AgentKind.VEHICLE,)
    steps = np.arange(agents.n_steps)
    there = (steps <= 15) | ((steps >= 25) & (steps <= 30))
    assert agents.valid[:, 0].tolist() == there.tolist()
    np.testing.assert_allclose(agents.boxes[there, 0, 0], 2000.0 + steps[there])
    np.testing.assert_allclose(agents.center_z[there, 0], 1.0 + 0.1 * steps[there])
    assert abs(agents.boxes[5, 0, 2]) == pytest.approx(math.pi) and agents.boxes[5, 0, 3:].tolist() == [4.0, 2.0]
    assert np.isnan(agents.boxes[~there]).all()
