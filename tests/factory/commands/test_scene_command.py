"""`python -m factory scene`: a block as .ply files for other programs, and theirs as a block."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.stages.scene_file import read_scene, write_scene
from tasks.render.scene.engine import render
from tasks.render.splatting.formats import from_ply, to_ply
from tasks.render.splatting.gaussians import EMPTY, Gaussians
from tasks.render.splatting.project import ANTIALIASED, CLASSIC, FITTED
from tasks.world.clip import Pinhole
from tests.factory.stages.test_scene_file import scene

main = COMMANDS["scene"].load()


def proper(part: Gaussians) -> Gaussians:
    """With opacities and rotations that are some."""
    quats = part.quats / np.linalg.norm(part.quats, axis=1, keepdims=True)
    return replace(part, opacities=np.full(len(part), 0.5, np.float32), quats=quats)


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    made = scene()
    nodes = {name: proper(node) for name, node in made.nodes.items()}
    write_scene(tmp_path / "block.safetensors", replace(made, background=proper(made.background), nodes=nodes))
    return tmp_path / "block.safetensors"


def test_info_says_what_is_in_a_scene(stored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(stored)]) == 0
    said = capsys.readouterr().out
    for line in (
        read_scene(stored).digest,
        "file        float32, 0.0 MB",
        "block       av2 log, 10.0 to 30.0 s",
        "background  30 Gaussians, SH degree 1",
        "node        b/7 ü: 5 Gaussians, SH degree 3",
        "psnr        27.12 dB over 3 held-out photos",
        "camera      front: 28.50 dB, SSIM 0.910 over 1 held-out photos, "
        "3.5 m from the nearest photo used (road 30.50 dB)",
        "view        front at 0.50 s: 28.50 dB, SSIM 0.910, held out",
        "exposures   1",
    ):
        assert line in said


def test_a_block_goes_out_as_ply_and_comes_back_edited_with_its_vehicles_and_its_place(
    stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(stored), f"to={tmp_path / 'out'}"]) == 0
    names = {"background.ply", "node-b_7__.ply", "node-a.ply", "sky.png", "scene.json"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    whole = read_scene(stored)
    described = json.loads((tmp_path / "out" / "scene.json").read_text())
    assert described["origin"] == whole.origin.tolist() and described["digest"] == whole.digest
    sky = cv2.imread(str(tmp_path / "out" / "sky.png"))[..., ::-1]
    np.testing.assert_array_equal(sky, np.rint(np.clip(whole.sky.rgb, 0.0, 1.0) * 255.0))

    edited = from_ply((tmp_path / "out" / "background.ply").read_bytes()).take(np.arange(10))
    (tmp_path / "edited.ply").write_bytes(to_ply(edited))
    to = tmp_path / "new.safetensors"
    assert main(["import", str(tmp_path / "edited.ply"), f"to={to}", f"like={stored}"]) == 0
    assert "psnr        not measured" in capsys.readouterr().out
    back = read_scene(to)
    assert len(back.background) == 10 and list(back.nodes) == list(whole.nodes)
    assert back.origin.tolist() == whole.origin.tolist() and back.block is not None
    np.testing.assert_allclose(back.background.sh_rest, whole.background.sh_rest[:10])
    assert back.digest != whole.digest and np.isnan(back.psnr_db) and back.views == ()


def test_a_scene_is_drawn_as_it_was_made_to_be_where_that_is_known(
    stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path / "fitted", replace(read_scene(stored), screen=FITTED))
    drawn = "drawn       antialiased, 0.15 px2 wider"
    assert main(["info", str(tmp_path / "fitted")]) == 0 and drawn in capsys.readouterr().out
    for suffix, more, screen in (
        ("ply", [], CLASSIC),
        ("ply", ["antialiased=true"], ANTIALIASED),
        ("ply", [f"like={tmp_path / 'fitted'}"], FITTED),
        ("spz", [], ANTIALIASED),
        ("spz", ["antialiased=false", f"like={tmp_path / 'fitted'}"], CLASSIC),
    ):
        assert main(["export", str(tmp_path / "fitted"), f"to={tmp_path / 'out'}", f"format={suffix}"]) == 0
        to = tmp_path / "back"
        assert main(["import", str(tmp_path / "out" / f"background.{suffix}"), f"to={to}", *more]) == 0
        assert read_scene(to).screen == screen, (suffix, more)


def test_a_foreign_ply_is_a_scene_that_can_be_drawn_where_it_is_put(tmp_path: Path) -> None:
    one = Gaussians(
        np.array([[0.0, 0.0, 0.0]], np.float32), np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        np.full((1, 3), np.log(0.5), np.float32), np.array([0.9], np.float32), np.array([[0.9, 0.1, 0.1]], np.float32),
    )  # fmt: skip
    (tmp_path / "ball.ply").write_bytes(to_ply(one))
    to = tmp_path / "ball.safetensors"
    assert main(["import", str(tmp_path / "ball.ply"), f"to={to}", "origin=500,-20,3"]) == 0
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], (495.0, -20.0, 3.0)
    camera = Pinhole(np.array([[20.0, 0, 16], [0, 20.0, 16], [0, 0, 1]]), pose, 32, 32)
    view = render(read_scene(to), [camera])[0]
    assert view.depth[16, 16] == pytest.approx(5.0) and view.alpha[16, 16] > 0.8
    assert view.rgb[16, 16, 0] > 0.8 > 0.3 > view.rgb[16, 16, 1]


def test_what_cannot_be_done_is_an_error_that_says_why(
    stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.ply").write_bytes(to_ply(EMPTY).replace(b"opacity", b"opaque_"))
    (tmp_path / "empty.ply").write_bytes(to_ply(EMPTY))
    ball, to = str(tmp_path / "bad.ply"), f"to={tmp_path / 'x'}"
    for argv, said in (
        (["info", str(tmp_path / "none")], "none: cannot be read"),
        (["info", ball], "bad.ply: cannot be read"),
        (["export", str(stored)], "export takes to="),
        (["fly", str(stored)], "'fly': must be one of info, export, import, build, film"),
        (["info", str(stored), to], "info takes no to="),
        (["export", str(stored), to, "format=obj"], "format=obj"),
        (["import", str(stored), to], "expected a name that ends in .ply, .spz, .ckpt, .pt, .pth"),
        (["import", ball, to], "bad.ply: ply: property opacity: absent"),
        (["import", str(tmp_path / "empty.ply"), to], "no Gaussian in it"),
        (["import", str(tmp_path / "gone.ply"), to], "No such file"),
        (["import", ball], "import takes to="),
        (["import", ball, ball, to], "import takes one file"),
        (["import", ball, to, "traversal=1"], "traversal= is of a checkpoint of MTGS"),
    ):
        assert main(argv) == 2, argv
        assert said in capsys.readouterr().err, argv
    (tmp_path / "good.ply").write_bytes(to_ply(proper(scene().background)))
    for more, said in (
        ([f"like={stored}", "origin=1,2,3"], "give origin= or like="),
        (["origin=1,2"], "expected x,y,z"),
        (["origin=a,b,c"], "origin=a,b,c"),
    ):
        assert main(["import", str(tmp_path / "good.ply"), to, *more]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
