"""`python -m factory scene info|export|import ...`: the scene file of a block, looked into and exchanged.

info SCENE...                       what is in it: Gaussians, nodes, sky, range, quality, digest
export SCENE to=FOLDER              background.ply, one node-<track id>.ply a vehicle, sky.png, scene.json
import FILE.ply to=SCENE            the .ply as a background under a plain sky; origin=x,y,z puts it into the world [m]
import FILE.ply to=SCENE like=OTHER the same with the origin, nodes, sky and range of another scene

The .ply files are standard 3D Gaussian splatting (gsplat, nerfstudio, SuperSplat). A background is in metres from the
scene's origin, a node in its box's frame. A block's scene lies in <out>/cache/block-*.safetensors; an edited one put
back under the same name is what the next run draws.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from factory.config.arguments import WORD, Refused


@dataclass(frozen=True)
class Request:
    """The command line."""

    action: Literal["info", "export", "import"] = field(metadata=WORD)
    files: tuple[str, ...] = field(metadata=WORD)
    to: str | None = None
    like: str | None = None
    origin: str | None = None

    def __post_init__(self) -> None:
        if self.action == "info" and (self.to, self.like, self.origin) != (None, None, None):
            raise ValueError("scene info takes files alone")
        if self.action != "info" and (self.to is None or len(self.files) != 1):
            raise ValueError(f"scene {self.action} takes one file and to=...; see --help")
        if self.action == "export" and (self.like, self.origin) != (None, None):
            raise ValueError("like= and origin= are of scene import")
        if self.like is not None and self.origin is not None:
            raise ValueError("give origin= or like=: the other scene has an origin of its own")


def main(request: Request) -> None:
    """Do it. Raises Refused for what cannot be read or makes no sense."""
    from factory.stages.scene_file import read_scene, write_scene
    from factory.views.scene_parts import export, imported, info_text

    file, to = Path(request.files[0]), Path(request.to or "")
    try:
        if request.action == "info":
            print("\n\n".join(info_text(path, read_scene(path)) for path in map(Path, request.files)))
        elif request.action == "export":
            print("\n".join(map(str, export(read_scene(file), to))))
        else:
            print(info_text(to, write_scene(to, imported(file, request.like, request.origin))))
    except (ValueError, OSError) as error:
        raise Refused(str(error)) from error
