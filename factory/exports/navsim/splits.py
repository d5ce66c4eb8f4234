"""The YAML files that name a split's logs and tokens to the public code."""

from collections.abc import Iterable, Sequence

from factory.exports.navsim.manifest import Written
from factory.exports.navsim.names import N_FUTURE, N_HISTORY, SplitNames

LISTS = {"test": "test_logs", "train": "train_logs", "val": "val_logs"}  # by a sample's split


def scene_filter(logs: Sequence[Written]) -> str:
    """Of navsim.common.dataclasses.SceneFilter; unknown keys would be refused (NS dataclasses.py:733-778)."""
    return "".join(
        (
            "_convert_: all\n_target_: navsim.common.dataclasses.SceneFilter\nframe_interval: 1\nhas_route: true\n",
            _list("log_names", (log.log for log in logs)),
            f"max_scenes: null\nnum_future_frames: {N_FUTURE}\nnum_history_frames: {N_HISTORY}\n",
            _list("tokens", (log.token for log in logs)),
        )
    )


def split(names: SplitNames) -> str:
    """What run_dataset_caching takes as train_test_split; data_split is the folder that the logs really lie in."""
    return f"data_split: {names.folder}\ndefaults:\n- scene_filter: {names.yaml}\n"


def log_split(logs: Sequence[Written]) -> str:
    """Which logs a training takes, and which it validates on (SS training/dataset.py:129-146)."""
    return "".join(_list(key, (log.log for log in logs if log.data_split == name)) for name, key in LISTS.items())


def _list(key: str, values: Iterable[str]) -> str:
    """In double quotes: a token of digits alone, or one with an e among them, would be read as a number."""
    listed = list(values)
    return f"{key}:\n" + "".join(f'- "{value}"\n' for value in listed) if listed else f"{key}: []\n"
