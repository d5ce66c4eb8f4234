"""What may stand on a run's command line, for the shell's completion: no configuration library, no engine."""

import re
from collections.abc import Sequence

from factory.config.compose import conf_dir
from factory.config.plugins import choices
from factory.config.run import RecoverySources, RunConfig, reader_of
from factory.config.shapes import choices_of, dataclass_in, keys_of


def settings_of(given: Sequence[str]) -> dict[str, list[str]]:
    """Setting -> its choices where they are few: groups, the run's keys, those of the chosen reader and of recovery."""
    folder = conf_dir()
    chosen = dict(re.findall(r"^  - (\w+): (\w+)$", (folder / "run.yaml").read_text(), re.M))
    chosen.update({key: value for key, _, value in (word.partition("=") for word in given) if key in chosen})
    typed = dict(keys_of(RunConfig)) | dict(keys_of(RecoverySources, "expert.recovery."))
    reader = reader_of(chosen["clips"])
    typed |= {} if reader is None else dict(keys_of(reader, "clips."))
    found = {key: choices_of(hint) for key, hint in typed.items() if key != "expert" and dataclass_in(hint) is None}
    return found | {group: choices(group, [folder]) for group in chosen} | {"experts": choices("expert", [folder])}
