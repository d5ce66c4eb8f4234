"""Where each file of an export lies below its folder."""

from dataclasses import dataclass

from factory.exports.navsim.names import N_HISTORY, SplitNames
from factory.exports.navsim.settings import Layout

CONFIG = "devkit/navsim/planning/script/config"  # below NAVSIM_DEVKIT_ROOT, once devkit/ is copied over it
REWARDS = "traj_pdm_v2"  # what NAVSIM_TRAJPDM_ROOT names


@dataclass(frozen=True)
class Places:
    """The paths of one split, relative to the export's folder."""

    names: SplitNames
    layout: Layout

    def log(self, name: str) -> str:
        """A log's pickle."""
        folder = f"navsim_logs/{self.names.folder}" if self.layout == "moved" else f"{self._unpacked}/meta_datas"
        return f"{folder}/{name}.pkl"

    def picture(self, data_path: str, frame: int) -> str:
        """A picture of a frame; the released archives keep those of the future apart."""
        if self.layout == "moved":
            return f"sensor_blobs/{self.names.folder}/{data_path}"
        return f"{self._unpacked}/sensor_blobs_{'hist' if frame < N_HISTORY else 'fut'}/{data_path}"

    @property
    def scene_filter(self) -> str:
        return f"{CONFIG}/common/train_test_split/scene_filter/{self.names.yaml}.yaml"

    @property
    def split(self) -> str:
        return f"{CONFIG}/common/train_test_split/{self.names.yaml}.yaml"

    @property
    def log_split(self) -> str:
        return f"{CONFIG}/training/{self.names.log_split}.yaml"

    @property
    def rewards(self) -> str:
        return f"{REWARDS}/{self.names.rewards}"

    @property
    def _unpacked(self) -> str:
        return f"SimScale/{self.names.folder}"


def vocabulary(k: int) -> str:
    """Where the released configuration looks for its trajectories (gtrs_dense_vov.yaml:23)."""
    return f"devkit/traj_final/{k}.npy"
