"""`python -m factory scene info|export|import ...`: the scene file of a block, looked into and exchanged.

info SCENE...                       what is in it: Gaussians, nodes, sky, range, quality, digest
export SCENE to=FOLDER              background.ply, one node-<track id>.ply a vehicle, sky.png, scene.json
export SCENE to=FOLDER format=spz   the same, a tenth the size; format=ckpt: checkpoints, of the background as of
                                    WorldEngine, of vehicles as of nerfstudio's splatfacto; with out=RUN the former has
                                    the vehicles too, where the log had them by the run's prepared clips
import FILE to=SCENE                a .ply, .spz or checkpoint (.ckpt, .pt, .pth: splatfacto, MTGS, WorldEngine) as a
                                    scene under a plain sky; origin=x,y,z puts it into the world [m]
import FILE to=SCENE like=OTHER     the same with the origin, nodes, sky and range of another scene

traversal=N takes the colours of an MTGS checkpoint's N-th traversal (default: their mean), transforms=FILE takes back
nerfstudio's dataparser_transforms.json. antialiased=true|false: how a file was made to be drawn (rasterize_mode of
gsplat), where it does not say so; .spz, MTGS and WorldEngine do, of others it is that of like=, or false.

The .ply files are standard 3D Gaussian splatting (gsplat, nerfstudio, SuperSplat). A background is in metres from the
scene's origin, a node in its box's frame. A block's scene lies in <out>/cache/block-*.safetensors; an edited one put
back under the same name is what the next run draws.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from factory.config.arguments import POSITIONAL, Refused
from factory.exits import calling_on_stop_signal


@dataclass(frozen=True)
class Request:
    """The command line."""

    action: Literal["info", "export", "import", "view"] = field(metadata=POSITIONAL)
    files: tuple[str, ...] = field(metadata=POSITIONAL)
    to: str | None = None
    like: str | None = None
    origin: str | None = None
    format: Literal["ply", "spz", "ckpt"] | None = None
    traversal: int | None = None
    transforms: str | None = None
    antialiased: bool | None = None
    out: str | None = None

    def __post_init__(self) -> None:
        if self.action != "info" and len(self.files) != 1:
            raise ValueError(f"scene {self.action} takes one file; see --help")
        if self.action in ("export", "import") and self.to is None:
            raise ValueError(f"scene {self.action} takes to=...; see --help")
        takes = {
            "info": (),
            "export": ("to", "format", "out"),
            "import": ("to", "like", "origin", "traversal", "transforms", "antialiased"),
        }[self.action]
        for name in ("to", "like", "origin", "format", "traversal", "transforms", "antialiased", "out"):
            if getattr(self, name) is not None and name not in takes:
                raise ValueError(f"scene {self.action} takes no {name}=; see --help")
        if self.action == "export" and self.out is not None and self.format != "ckpt":
            raise ValueError("out= brings vehicles' poses into a checkpoint: format=ckpt")
        if self.like is not None and self.origin is not None:
            raise ValueError("give origin= or like=: the other scene has an origin of its own")


def main(request: Request) -> None:
    """Do it. Raises Refused for what cannot be read or makes no sense."""
    from factory.stages.scene_file import read_scene, write_scene
    from factory.views.scene_files import export, imported, info_text, logged_vehicles, read_splats
    from factory.views.status import open_store
    from tasks.render.splatting.formats import LoggedVehicle

    file, to = Path(request.files[0]), Path(request.to or "")
    try:
        match request.action:
            case "info":
                print("\n\n".join(info_text(path, read_scene(path)) for path in map(Path, request.files)))
            case "export":
                asset, vehicles, unseen = read_scene(file), list[LoggedVehicle](), list[str]()
                if request.out is not None:
                    vehicles, unseen = logged_vehicles(open_store(request.out), asset)
                print("\n".join(map(str, export(asset, to, f".{request.format or 'ply'}", vehicles))))
                if unseen:
                    print(f"left out    {', '.join(unseen)}: no clip of the run shows them here")
            case "import":
                transforms = None if request.transforms is None else Path(request.transforms)
                found = read_splats(file, request.traversal, transforms)
                print(
                    info_text(to, write_scene(to, imported(found, request.like, request.origin, request.antialiased)))
                )
                if found.left_out:
                    print(f"left out    {', '.join(found.left_out)}: bodies that bend need their network")
    except (ValueError, OSError) as error:
        raise Refused(str(error)) from error
