"""Settings of an experiment: its own file of YAML beside it, and the words of a command line."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from factory.config.compose import ConfigError, fill
from factory.config.shapes import deep_merge, defaults_of, yaml_lines
from factory.config.words import SettingsShown, parse_command_line

T = TypeVar("T")


def settings_of(shape: type[T], file: Path, argv: Sequence[str]) -> T:
    """The dataclass filled from `file` and `key=value`. Raises SettingsShown for --cfg, and ConfigError."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    asked = parse_command_line(argv)
    try:
        found = OmegaConf.merge(OmegaConf.load(file), OmegaConf.from_dotlist(list(asked.overrides)))
        values = OmegaConf.to_container(found, resolve=True, throw_on_missing=not asked.shows)
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    assert isinstance(values, dict)
    values = deep_merge(defaults_of(shape), {str(key): value for key, value in values.items()})
    if asked.shows:
        raise SettingsShown("\n".join(yaml_lines(values, shape, {})))
    return fill(shape, values, "")
