"""A compiled CPU rasteriser beside ours: OpenSplat's, built from a checkout that PEER names.

Its two functions, projection and rasterisation, are compiled as its own CMake file does (-O3) against the PyTorch at
hand, which takes a minute and a C++ compiler the first time. Nothing of it is part of this project.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.render.splatting.gaussians import Gaussians

Draw = Callable[..., Any]  # tensors and the camera's numbers -> a picture (height, width, 3)

SOURCE = "rasterizer/gsplat-cpu/gsplat_cpu.cpp"
NEAR_M, FAR_M = 0.001, 1000.0  # of its projection matrix
CALL = """
#include "{source}"

torch::Tensor draw(torch::Tensor means, torch::Tensor scales, torch::Tensor quats, torch::Tensor colors,
                   torch::Tensor opacities, torch::Tensor background, torch::Tensor view, torch::Tensor projection,
                   double fx, double fy, double cx, double cy, int64_t height, int64_t width) {{
    auto p = project_gaussians_forward_tensor_cpu(
        means.size(0), means, scales, 1.0f, quats, view, projection, fx, fy, cx, cy, height, width, 0.01f);
    auto image = rasterize_forward_tensor_cpu(
        width, height, std::get<0>(p), std::get<2>(p), colors, opacities, background, std::get<3>(p),
        std::get<4>(p).contiguous());  // a view of every third number: its sort reads them side by side
    delete[] std::get<2>(image);
    return std::get<0>(image);
}}
"""


def peer_checkout() -> Path | None:
    """The checkout that PEER names. Raises SystemExit with one line where the rasteriser is not in it."""
    named = os.environ.get("PEER", "")
    if named and not (Path(named) / SOURCE).is_file():
        raise SystemExit(f"PEER={named} holds no {SOURCE}: give a checkout of pierotofy/OpenSplat")
    return Path(named).resolve() if named else None


def compiled(checkout: Path) -> Draw:
    """Its rasteriser as a function of tensors."""
    from torch.utils.cpp_extension import load_inline

    source = CALL.format(source=checkout / SOURCE)
    module = load_inline("opensplat_peer", source, functions=["draw"], extra_cflags=["-O3"])
    draw: Draw = module.draw
    return draw


def drawing(
    draw: Draw,
    scene: Gaussians,
    intrinsics: NDArray[np.float64],
    camera: NDArray[np.float64],
    width: int,
    height: int,
) -> Callable[[], NDArray[np.float32]]:
    """A call that draws the scene on black (height, width, 3); camera: to the world, OpenCV axes."""
    import torch  # only where there is a peer

    torch.set_num_threads(1)  # CPU time: more threads would wait for each other in it
    view = np.linalg.inv(camera)
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    projection = np.array(
        [
            [2.0 * fx / width, 0.0, 2.0 * cx / width - 1.0, 0.0],
            [0.0, 2.0 * fy / height, 2.0 * cy / height - 1.0, 0.0],
            [0.0, 0.0, (FAR_M + NEAR_M) / (FAR_M - NEAR_M), -FAR_M * NEAR_M / (FAR_M - NEAR_M)],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )
    ahead = (scene.means @ view[2, :3] + view[2, 3]) > 0.1  # it draws what lies behind the camera too
    seen = scene.take(np.flatnonzero(ahead))
    arrays = (seen.means, np.exp(seen.log_scales), seen.quats, seen.colours, seen.opacities[:, None], np.zeros(3))
    tensors = [
        torch.tensor(np.ascontiguousarray(array), dtype=torch.float32) for array in (*arrays, view, projection @ view)
    ]
    return lambda: draw(*tensors, fx, fy, cx, cy, height, width).numpy()
