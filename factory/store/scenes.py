"""The scenes of a benchmark beside its tables: one file a clip, from which planners are driven without the raw logs."""

from dataclasses import dataclass

from factory.store.cache import BadCacheFile, decode, encode
from factory.store.location import Location
from tasks.hard_scenes import BenchmarkClip


@dataclass(frozen=True)
class SceneFiles:
    """The folder `scenes` of a store; files are npz without pickle (factory.store.cache)."""

    location: Location

    def store(self, scenes: BenchmarkClip) -> None:
        """Whole or not at all; in place of an older one."""
        self.location.write(f"{scenes.clip.clip_id}.npz", encode(scenes))

    def load(self, clip_id: str) -> BenchmarkClip:
        """Raises FileNotFoundError where the clip has none, BadCacheFile for a damaged or foreign file."""
        data = self.location.read(f"{clip_id}.npz")
        if data is None:
            raise FileNotFoundError(f"{self.location.uri}/{clip_id}.npz: no scenes of this clip; run the factory again")
        scenes = decode(data)
        if not isinstance(scenes, BenchmarkClip):
            raise BadCacheFile(f"{self.location.uri}/{clip_id}.npz holds {type(scenes).__name__}, not a clip's scenes")
        return scenes

    def clip_ids(self) -> list[str]:
        """Of all clips that have scenes, sorted."""
        return [name.removesuffix(".npz") for name in self.location.names() if name.endswith(".npz")]
