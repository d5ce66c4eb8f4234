"""`python -m factory completion bash|zsh`: completion for the shell; commands, keys, config groups and their choices.

    source <(python -m factory completion bash)             for this shell; into ~/.bashrc for all
    source <(python -m factory completion zsh)              after compinit

Completes `factory ...` and `python -m factory ...`.
"""

import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from factory.commands.table import COMMANDS
from factory.config.arguments import RUN, WORD, given_as, keys_of
from factory.config.compose import conf_dir
from factory.config.plugins import choices
from factory.config.run import EXPERTS, RunConfig, built_in_classes, reader_of
from factory.config.shapes import choices_of, dataclass_in
from factory.config.shapes import keys_of as settings_in

BASH = r"""_factory_complete() {
  local line="${COMP_LINE:0:COMP_POINT}" word found
  word="${line##*[[:space:]]}"
  mapfile -t found < <(command PYTHON -m factory complete "$line" 2>/dev/null)
  [[ $word == *=* ]] && found=("${found[@]#*=}")
  COMPREPLY=("${found[@]}")
  [[ ${#found[@]} -gt 0 && ${found[0]} == *= ]] && compopt -o nospace
}
_factory_python() {
  [[ "$COMP_LINE" =~ ^[^[:space:]]+[[:space:]]+-m[[:space:]]+factory[[:space:]] ]] && _factory_complete
}
complete -o default -F _factory_complete factory
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
  if [[ $words[2] == -m && $words[3] == factory ]]; then
    _factory_complete
  elif (( $+functions[_python] )); then
    _python
  else
    _default
  fi
}
compdef _factory_complete factory
compdef _factory_python python python3
"""


@dataclass(frozen=True)
class Request:
    """The command line."""

    shell: Literal["bash", "zsh"] = field(metadata=WORD)


def main(request: Request) -> None:
    """Print the script of a shell."""
    print({"bash": BASH, "zsh": ZSH}[request.shell].replace("PYTHON", sys.executable), end="")


def complete(argv: Sequence[str]) -> int:
    """What may stand at the end of a command line, one a line."""
    line = argv[0] if argv else ""
    words = re.sub(r"^\s*\S*python\S*\s+-m\s+factory\b|^\s*\S+", "", line, count=1).split()
    last = words.pop() if words and not line[-1:].isspace() else ""
    print("\n".join(sorted(found for found in candidates(words, last) if found.startswith(last))))
    return 0


def candidates(words: Sequence[str], last: str) -> Iterable[str]:
    """Whole words that may follow `words`, the last of them begun as `last`."""
    if not words:
        return COMMANDS
    name, *given = words
    if name not in COMMANDS:
        return ()
    shape = getattr(COMMANDS[name].imported(), "Request", None)  # run and plan have none: settings alone
    known: dict[str, list[str]] = {}
    if shape is None or given_as(shape, RUN):
        known |= settings_of(given)
    if shape is not None:
        known |= {key: choices_of(kind) for key, kind in keys_of(shape).items()}
        if (words := given_as(shape, WORD)) and not given and known[words[0]]:
            return known[words[0]]
    key, equals, _ = last.partition("=")
    if equals:
        return [f"{key}={value}" for value in known.get(key, ())]
    taken = {word.partition("=")[0] for word in given}
    return [f"{key}=" for key in known if key not in taken]


def settings_of(given: Sequence[str]) -> dict[str, list[str]]:
    """Setting -> its choices where they are few: groups, the run's keys, the chosen reader's, the experts'."""
    folder = conf_dir()
    chosen = dict(re.findall(r"^  - (\w+): (\w+)$", (folder / "run.yaml").read_text(encoding="utf-8"), re.M))
    chosen.update({key: value for key, _, value in (word.partition("=") for word in given) if key in chosen})
    typed = dict(settings_in(RunConfig))
    for name, target in built_in_classes("expert").items():
        typed |= dict(settings_in(EXPERTS[target], f"expert.{name}.")) if target in EXPERTS else {}
    reader = reader_of(chosen["clips"])
    typed |= {} if reader is None else dict(settings_in(reader, "clips."))
    found = {key: choices_of(hint) for key, hint in typed.items() if key != "expert" and dataclass_in(hint) is None}
    return found | {group: choices(group, [folder]) for group in chosen} | {"experts": choices("expert", [folder])}
