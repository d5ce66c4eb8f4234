"""`python -m factory completion bash|zsh`: completion for the shell; commands, keys, config groups and their choices.

    source <(python -m factory completion bash)             for this shell; into ~/.bashrc for all
    source <(python -m factory completion zsh)              after compinit

Completes `factory ...` and `python -m factory ...`. Exit codes: 0 printed, 2 another shell.
"""

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from importlib import import_module
from typing import get_args, get_type_hints

from factory.commands.table import COMMANDS
from factory.config.arguments import BAD_ARGUMENTS
from factory.config.known import SWITCH, settings_of

WORDS = {"export": ("mcap", "mp4", "rerun"), "scene": ("info", "export", "import"), "completion": ("bash", "zsh")}

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


def main(argv: Sequence[str]) -> int:
    """Print the script of a shell; the exit code."""
    scripts = {"bash": BASH, "zsh": ZSH}
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    if len(argv) != 1 or argv[0] not in scripts:
        print(f"error: name a shell: {' or '.join(scripts)}; see --help", file=sys.stderr)
        return BAD_ARGUMENTS
    print(scripts[argv[0]].replace("PYTHON", sys.executable), end="")
    return 0


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
    if name in WORDS and not given:
        return WORDS[name]
    command = COMMANDS[name]
    known = settings_of(given) if command.takes == "run" else {}
    if command.takes == "request" or name in ("explain", "retry"):
        known = {**known, **(settings_of([]) if name == "retry" else {}), **request_of(command.module)}
    key, equals, _ = last.partition("=")
    if equals:
        return [f"{key}={value}" for value in known.get(key, ())]
    taken = {word.partition("=")[0] for word in given}
    return [f"{key}=" for key in known if key not in taken]


def request_of(module: str) -> Mapping[str, list[str]]:
    """The keys of a command's own dataclass; true and false where it is a switch."""
    shape = getattr(import_module(module), "ExplainSettings" if module == "factory.commands.explain" else "Request")
    hints = get_type_hints(shape)
    return {
        field.name: sorted(SWITCH) if bool in {hints[field.name], *get_args(hints[field.name])} else []
        for field in fields(shape)
    }
