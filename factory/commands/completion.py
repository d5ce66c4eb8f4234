"""Completion for bash and zsh."""

import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from factory.commands.table import COMMANDS, DOORS
from factory.config.arguments import (
    POSITIONAL,
    RUN_SETTINGS,
    ComposedCommand,
    fields_with,
    request_class_of,
    request_keys,
)
from factory.config.compose import conf_dir, config_groups
from factory.config.plugins import group_choices
from factory.config.run import EXPERTS, built_in_classes, reader_settings_class
from factory.config.shapes import allowed_values, dataclass_in, setting_keys
from factory.run import main as run

MODULES = ("factory", "factory.run", "planners", "planners.drive")  # what `python -m` starts
BASH = r"""_factory_complete() {
  local line="${COMP_LINE:0:COMP_POINT}" word found
  word="${line##*[[:space:]]}"
  mapfile -t found < <(command PYTHON -m factory complete "$line" 2>/dev/null)
  [[ $word == *=* ]] && found=("${found[@]#*=}")
  COMPREPLY=("${found[@]}")
  [[ ${#found[@]} -gt 0 && ${found[0]} == *= ]] && compopt -o nospace
}
_factory_python() {
  [[ "$COMP_LINE" =~ ^[^[:space:]]+[[:space:]]+-m[[:space:]]+(MODULES)[[:space:]] ]] && _factory_complete
}
complete -o default -F _factory_complete factory planners
for _name in python python3; do
  complete -p "$_name" >/dev/null 2>&1 || complete -o default -F _factory_python "$_name"
done
unset _name
"""
ZSH = r"""_factory_complete() {
  local -a found
  found=("${(@f)$(command PYTHON -m factory complete "${BUFFER[1,CURSOR]}" 2>/dev/null)}")
  if [[ -z $found ]]; then
    _files -P "${PREFIX%%=*}="
  elif [[ $found[1] == *= ]]; then
    compadd -S '' -a found
  else
    compadd -a found
  fi
}
_factory_python() {
  if [[ $words[2] == -m && $words[3] == (MODULES) ]]; then
    _factory_complete
  elif (( $+functions[_python] )); then
    _python
  else
    _default
  fi
}
compdef _factory_complete factory planners
compdef _factory_python python python3
"""


@dataclass(frozen=True)
class CompletionRequest:
    """The command line."""

    shell: Literal["bash", "zsh"] = field(metadata=POSITIONAL)


def completion(request: CompletionRequest) -> None:
    """`python -m factory completion bash|zsh`: completion for the shell: commands, keys, groups, their choices.

        source <(python -m factory completion bash)             for this shell; into ~/.bashrc for all
        source <(python -m factory completion zsh)              after compinit

    Completes `factory ...` and `planners ...`, `python -m` of both, and of factory.run and planners.drive.
    """
    script = {"bash": BASH, "zsh": ZSH}[request.shell]
    print(script.replace("PYTHON", sys.executable).replace("MODULES", "|".join(MODULES)), end="")


def complete(argv: Sequence[str]) -> int:
    """What may stand at the end of a command line, one a line."""
    line = argv[0] if argv else ""
    program, *words = re.sub(r"^\s*\S*python\S*\s+-m\s+|^\s*(\S*/)?", "", line, count=1).split() or [""]
    last = words.pop() if words and not line[-1:].isspace() else ""
    door, *first = program.split(".")
    if first:  # python -m factory.run
        words = ["run" if door == "factory" else "drive", *words]
    print("\n".join(sorted(found for found in completions(words, last, door) if found.startswith(last))))
    return 0


def completions(words: Sequence[str], last: str, door: str = "factory") -> Iterable[str]:
    """Whole words that may follow `words`, the last of them begun as `last`."""
    commands = DOORS.get(door, COMMANDS)
    if not words:
        return commands
    name, *given = words
    if name not in commands:
        return ()
    function = commands[name].function()
    if isinstance(function, ComposedCommand):
        known = setting_choices(given, function)
    else:
        shape = request_class_of(function)
        known = setting_choices(given) if fields_with(shape, RUN_SETTINGS) else {}
        known |= {key: allowed_values(kind) for key, kind in request_keys(shape).items()}
        if (words := fields_with(shape, POSITIONAL)) and not given and known[words[0]]:
            return known[words[0]]
    key, equals, _ = last.partition("=")
    if equals:
        return [f"{key}={value}" for value in known.get(key, ())]
    taken = {word.partition("=")[0] for word in given}
    return [f"{key}=" for key in known if key not in taken]


def setting_choices(given: Sequence[str], command: ComposedCommand = run) -> dict[str, list[str]]:
    """Setting -> its choices where they are few: groups, the command's keys, the chosen reader's, the experts'."""
    folder, groups = conf_dir(), config_groups(command.conf)
    chosen = groups | {key: value for key, _, value in (word.partition("=") for word in given) if key in groups}
    typed = dict(setting_keys(command.shape))
    for name, target in built_in_classes("expert").items() if "expert" in typed else ():
        typed |= dict(setting_keys(EXPERTS[target], f"expert.{name}.")) if target in EXPERTS else {}
    reader = reader_settings_class(chosen.get("clips", ""))
    typed |= {} if reader is None else dict(setting_keys(reader, "clips."))
    found = {key: allowed_values(hint) for key, hint in typed.items() if key != "expert" and dataclass_in(hint) is None}
    found |= {word: group_choices(word.partition("@")[0], [folder]) for word in groups}
    return found | ({"experts": group_choices("expert", [folder])} if "experts" in typed else {})
