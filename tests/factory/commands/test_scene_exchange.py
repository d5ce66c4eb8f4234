"""`python -m factory scene`: scenes of other programs, and ours as theirs, by way of files."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.stages.scene_file import read_scene, write_scene
from factory.views.scene_files import read_nerfstudio_transform, read_splats, undo_transform
from tasks.render.splatting.formats import gauss_params
from tasks.render.splatting.gaussians import Gaussians, moved
from tests.factory.stages.test_scene_file import scene
from tests.tasks.render.splatting.test_ply import some
from tests.tasks.render.splatting.test_spz import apart

torch = pytest.importorskip("torch", reason="checkpoints take PyTorch")
main = COMMANDS["scene"].load()


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """A block whose colours a file of 8 bits can hold."""
    path = tmp_path / "block.safetensors"
    write_scene(path, replace(scene(), background=some(30, 3), nodes={"a": some(5, 15, 1), "b": some(5, 0, 2)}))
    return path


@pytest.mark.parametrize("kind", ["spz", "ckpt"])
def test_a_block_goes_out_and_comes_back(stored: Path, tmp_path: Path, kind: str) -> None:
    out, back = tmp_path / "out", tmp_path / "back.safetensors"
    assert main(["export", str(stored), f"to={out}", f"format={kind}"]) == 0
    whole = read_scene(stored)
    assert {f"background.{kind}", f"node-a.{kind}"} < {path.name for path in out.iterdir()}
    assert main(["import", str(out / f"background.{kind}"), f"to={back}", f"like={stored}"]) == 0
    found = read_scene(back)
    assert max(apart(whole.background, found.background).values()) < (0.1 if kind == "spz" else 1e-5)
    assert found.origin.tolist() == whole.origin.tolist() and list(found.nodes) == list(whole.nodes)
    node = read_splats(out / f"node-a.{kind}").background
    assert max(apart(whole.nodes["a"], node).values()) < (0.1 if kind == "spz" else 1e-5)


@pytest.mark.parametrize(
    ("kind", "count", "most"), [("ply", 0, 9.0), ("spz", 0, 1.44), ("ckpt", 0, 1.0), ("ckpt", 3, 9.0)]
)
def test_colours_brighter_than_white_go_out_as_far_as_the_format_has_room(
    tmp_path: Path, kind: str, count: int, most: float
) -> None:
    bright = some(30, count)
    bright = replace(bright, colours=np.linspace(0.1, 3.0, 90, dtype=np.float32).reshape(30, 3))
    whole = write_scene(tmp_path / "block.safetensors", replace(scene(), background=bright, nodes={}))
    np.testing.assert_array_equal(read_scene(tmp_path / "block.safetensors").background.colours, bright.colours)
    assert main(["export", str(tmp_path / "block.safetensors"), f"to={tmp_path}", f"format={kind}"]) == 0
    found = read_splats(tmp_path / f"background.{kind}").background
    np.testing.assert_allclose(found.colours, np.minimum(whole.background.colours, most), atol=6e-3)


def test_a_checkpoint_says_itself_where_it_lies(
    stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It goes there alone, and with the sky and range of another scene, but not to a second place."""
    assert main(["export", str(stored), f"to={tmp_path}", "format=ckpt"]) == 0
    file, to = tmp_path / "background.ckpt", tmp_path / "new.safetensors"
    origin = read_scene(stored).origin.tolist()
    assert main(["import", str(file), f"to={to}"]) == 0 and read_scene(to).origin.tolist() == origin
    assert main(["import", str(file), f"to={to}", f"like={stored}"]) == 0 and read_scene(to).block is not None
    assert main(["import", str(file), f"to={to}", "origin=1,2,3"]) == 2
    assert "the file itself says where it lies" in capsys.readouterr().err


def checkpoint(path: Path, parts: dict[str, Gaussians]) -> Path:
    """As MTGS' trainer saves one, half of it in 16 bits."""
    named = ((part, *each) for part, gaussians in parts.items() for each in gauss_params(gaussians).items())
    names = {f"_model.gaussian_models.{part}.{name}": torch.from_numpy(np.array(value)) for part, name, value in named}
    names = {name: value.half() if name.endswith("features_rest") else value for name, value in names.items()}
    optimizers = {"means": {"state": {0: {"step": torch.tensor(3.0)}}, "param_groups": [{"lr": np.float64(1e-4)}]}}
    torch.save({"step": 9, "pipeline": names, "optimizers": optimizers, "scalers": {}}, path)
    return path


class Trap:
    """Runs something when it is read as a pickle may."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("trapped",)


def test_nothing_of_a_checkpoint_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"pipeline": {}, "more": Trap()}, "trap.ckpt")
    (tmp_path / "cut.ckpt").write_bytes((tmp_path / "trap.ckpt").read_bytes()[:200])
    for name in ("trap.ckpt", "cut.ckpt"):
        assert main(["import", name, "to=new.safetensors"]) == 2
        assert f"{name}: cannot be read as a checkpoint of tensors and plain values" in capsys.readouterr().err
    assert not (tmp_path / "trapped").exists() and not (tmp_path / "new.safetensors").exists()


def test_nerfstudio_s_frame_is_taken_back(tmp_path: Path) -> None:
    """A splat that nerfstudio turned, moved and made smaller stands where the photos were, in metres."""
    scene, scale = some(30, 8), 0.05
    turn = np.array([[0.0, -1.0, 0.0, 2.0], [1.0, 0.0, 0.0, -3.0], [0.0, 0.0, 1.0, 0.5]])
    (tmp_path / "t.json").write_text(json.dumps({"transform": turn.tolist(), "scale": scale}))
    there = moved(scene, np.vstack([turn, [0.0, 0.0, 0.0, 1.0]]))
    shrunk = Gaussians(
        there.means * np.float32(scale), there.quats, there.log_scales + np.float32(np.log(scale)),
        there.opacities, there.colours, there.sh_rest,
    )  # fmt: skip
    found = apart(scene, undo_transform(shrunk, *read_nerfstudio_transform(tmp_path / "t.json")))
    assert found["means"] < 1e-4 and max(found.values()) < 1e-4


@pytest.mark.parametrize(
    "text", ["", "{}", '{"transform": [[1, 0], [0, 1]], "scale": 1}', '{"transform": 3, "scale": 0}']
)
def test_a_transform_that_is_none_is_named(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "t.json").write_text(text)
    file = checkpoint(tmp_path / "step.ckpt", {"background": some(3, 0)})
    assert main(["import", str(file), f"to={tmp_path / 'x'}", f"transforms={tmp_path / 't.json'}"]) == 2
    assert "t.json: " in capsys.readouterr().err


@pytest.mark.slow
def test_without_torch_a_checkpoint_is_refused_and_the_rest_works(stored: Path, tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from factory.commands.table import COMMANDS\n"
        "main = COMMANDS['scene'].load()\n"
        f"sys.exit(main(['export', {str(stored)!r}, 'to={tmp_path / 'spz'}', 'format=spz']) * 10\n"
        f"    + main(['export', {str(stored)!r}, 'to={tmp_path / 'ckpt'}', 'format=ckpt']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "PyTorch is needed for checkpoints: pip install" in done.stderr
