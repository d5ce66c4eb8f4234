"""LPIPS beside the public package: weights and pictures are drawn here, its distances were recorded.

They are those of `lpips` 0.1.4 (`LPIPS(net="alex", pnet_rand=True, pretrained=False)`, `normalize=True`) over
torchvision 0.29's AlexNet with the same weights.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.render.fit.losses import BadWeights, lpips_of

torch = pytest.importorskip("torch")
SHAPES = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
RECORDED = {(64, 64): 0.2588028907775879, (90, 160): 0.2538951635360718, (135, 240): 0.25464630126953125}
F32 = NDArray[np.float32]


def drawn() -> tuple[dict[str, F32], dict[str, F32]]:
    """AlexNet's convolutions and the heads."""
    rng = np.random.Generator(np.random.Philox(key=[0, 1]))
    network: dict[str, F32] = {}
    for at, shape in SHAPES.items():
        scale = np.sqrt(2.0 / np.prod(shape[1:]))
        network[f"features.{at}.weight"] = (scale * rng.standard_normal(shape)).astype(np.float32)
        network[f"features.{at}.bias"] = (0.1 * rng.standard_normal(shape[0])).astype(np.float32)
    heads = {
        f"lin{k}.model.1.weight": rng.uniform(0.0, 1.0, (1, shape[0], 1, 1)).astype(np.float32)
        for k, shape in enumerate(SHAPES.values())
    }
    return network, heads


def pictures(height: int, width: int) -> tuple[F32, F32]:
    rng = np.random.Generator(np.random.Philox(key=[0, 2]))
    one = rng.uniform(0.0, 1.0, (height, width, 3)).astype(np.float32)
    return one, np.clip(one + 0.2 * rng.standard_normal(one.shape), 0.0, 1.0).astype(np.float32)


def saved(path: Path, tensors: dict[str, F32]) -> Path:
    torch.save({name: torch.from_numpy(array) for name, array in tensors.items()}, path)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, (network, heads) = tmp_path_factory.mktemp("weights"), drawn()
    return [saved(folder / "alexnet.pth", network), saved(folder / "alex.pth", heads)]


def test_distances_are_the_public_package_s(files: list[Path]) -> None:
    distance = lpips_of(files)
    for size, recorded in RECORDED.items():
        assert distance(*pictures(*size)) == pytest.approx(recorded, rel=1e-5)
        a, b = pictures(*size)
        assert distance(b, a) == pytest.approx(recorded, rel=1e-5) and distance(a, a) == 0.0


def test_the_state_of_the_public_network_in_one_file_is_the_same(files: list[Path], tmp_path: Path) -> None:
    network, heads = drawn()
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    whole = {
        f"net.slice{slices[int(name.split('.')[1])]}.{name.split('.', 1)[1]}": array for name, array in network.items()
    }
    one = saved(tmp_path / "whole.pth", whole | heads)
    assert lpips_of([one])(*pictures(64, 64)) == lpips_of(files)(*pictures(64, 64))


def test_files_that_are_no_weights_are_named(files: list[Path], tmp_path: Path) -> None:
    (tmp_path / "note.pth").write_text("no weights")
    with pytest.raises(BadWeights, match=r"note\.pth: no weights"):
        lpips_of([tmp_path / "note.pth"])
    with pytest.raises(BadWeights, match=r"lin0\.model\.1\.weight is in none of the files: the heads"):
        lpips_of(files[:1])
    with pytest.raises(BadWeights, match=r"features\.0\.weight is in none of the files: AlexNet's"):
        lpips_of(files[1:])


def test_pictures_too_small_for_the_network_are_refused(files: list[Path]) -> None:
    with pytest.raises(ValueError, match="32 or more"):
        lpips_of(files)(*pictures(16, 64))
