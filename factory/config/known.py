"""The settings that conf/ holds with the choices in its comments, read as text: no configuration library, no engine."""

import re
from collections.abc import Sequence

from factory.config.compose import conf_dir
from factory.config.plugins import choices

CHOICES = re.compile(r"#\s*([\w-]+(?:\s*\|\s*[\w-]+)+)")  # `ray | local` in the comment behind a setting
SWITCH = {"true", "false"}


def settings_of(given: Sequence[str]) -> dict[str, list[str]]:
    """Setting -> its choices where they are few: groups, keys of conf/run.yaml, keys of the chosen groups."""
    folder = conf_dir()
    text = (folder / "run.yaml").read_text()
    chosen = dict(re.findall(r"^  - (\w+): (\w+)$", text, re.M))
    chosen.update({key: value for key, _, value in (word.partition("=") for word in given) if key in chosen})
    found = {group: choices(group, [folder]) for group in chosen}
    found |= _keys(text.split("\n\n", 1)[1], "") | {"experts": choices("expert", [folder])}
    for group, choice in chosen.items():
        path = folder / group / f"{choice}.yaml"
        if path.is_file() and group != "preset":
            found |= _keys(path.read_text(), f"{group}.")
    for expert, file in re.findall(r"^  - expert@expert\.(\w+): (\w+)$", text, re.M):
        found |= _keys((folder / "expert" / f"{file}.yaml").read_text(), f"expert.{expert}.")
    return found


def _keys(text: str, prefix: str) -> dict[str, list[str]]:
    """Of a YAML file of ours, nested keys with dots."""
    found: dict[str, list[str]] = {}
    above: list[tuple[int, str]] = []
    for indent, key, rest in re.findall(r"^( *)(\w+):(.*)$", text, re.M):
        while above and above[-1][0] >= len(indent):
            above.pop()
        name = prefix + ".".join([*(parent for _, parent in above), key])
        value, _, comment = rest.partition("#")
        if not value.strip():
            above.append((len(indent), key))
            continue
        choices = CHOICES.search(f"#{comment}")
        if value.strip() in SWITCH:
            found[name] = sorted(SWITCH)
        else:
            words = re.split(r"\s*\|\s*", choices[1]) if choices else []
            found[name] = [word for word in words if len(word) > 1]  # `n` stands for a number
    return found
