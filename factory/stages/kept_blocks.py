"""Whether what a run keeps of blocks under `out/cache` is whole: scenes, corrected rigs, half-done fits."""

from pathlib import Path

from factory.stages.fitting import BEGUN
from factory.stages.rig import SAID, told_of
from factory.stages.scene_file import SUFFIX, BadScene, read_scene
from factory.store.location import Location
from tasks.sealed import Damaged, check


def damaged_blocks(out: Location) -> dict[str, str]:
    """File, relative to `out`, -> what is wrong with it; blocks of a URL lie elsewhere."""
    folder = Path(out.uri, "cache")
    found = {}
    for path in sorted(folder.glob("block-*")) if out.is_local else ():
        try:
            _check(path)
        except (Damaged, BadScene) as error:
            problem = str(error).removeprefix(f"{path}: ")
            found[f"cache/{path.name}"] = f"{problem}; the next run makes it again"
    return found


def _check(path: Path) -> None:
    if path.name.endswith(SUFFIX):
        read_scene(path, path.stem)
    elif path.name.endswith(BEGUN):
        check(path, path.name)
    elif path.name.endswith(SAID):
        told_of(path)
