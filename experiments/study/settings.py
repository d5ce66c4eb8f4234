"""Settings of an experiment: its own file of YAML beside it, and the words of a command line."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from factory.config.compose import ConfigError, fill
from factory.config.shapes import defaults_of, described, merged
from factory.config.words import SettingsShown, asked_of

T = TypeVar("T")


def settings_of(shape: type[T], file: Path, argv: Sequence[str]) -> T:
    """The dataclass filled from `file` and `key=value`. Raises SettingsShown for --cfg, and ConfigError."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    asked = asked_of(argv)
    try:
        found = OmegaConf.merge(OmegaConf.load(file), OmegaConf.from_dotlist(list(asked.overrides)))
        values = OmegaConf.to_container(found, resolve=True, throw_on_missing=not asked.shows)
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    assert isinstance(values, dict)
    values = merged(defaults_of(shape), {str(key): value for key, value in values.items()})
    if asked.shows:
        raise SettingsShown("\n".join(described(values, shape, {})))
    return fill(shape, values, "")
