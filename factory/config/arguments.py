"""What the commands of `factory` and `planners` do alike: arguments, help, and one line for what ends them.

A command is a function whose docstring, or its module's, says what it does. Its keys are a dataclass: that of its
argument `request`, read here from `key=value` and plain words, or, of a `command`, the settings that Hydra composes
from a file of conf/.
"""

import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from keyword import iskeyword
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin, get_type_hints

from factory.config.compose import conf_dir, config_groups
from factory.config.plugins import group_choices
from factory.config.shapes import allowed_values, defaults_of, key_of, required_keys, to_plain, yaml_lines
from factory.config.words import SEVERAL, SHOW, ConfigError, SettingsShown, did_you_mean, expand_home, split_off_cfg
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED, Failed, Stopped

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Metadata of a field.
POSITIONAL = {"argument": "positional"}  # may stand without its key, in order; a tuple takes all that is left
GIVEN_ALONE = {"shown": "given alone"}  # of RUN_SETTINGS: the others are recorded, or of no use here
RUN_SETTINGS = {"argument": "settings of a run"}  # it takes every argument that is no field: settings of the run
INPUT_ERRORS = (ValueError, OSError)  # what settings or files that do not fit raise, where no fault of a stage can
VERIFY = "python -m factory verify out=<its run> names all damage, repair=true mends what can be"
Request = TypeVar("Request", bound="DataclassInstance")
CommandFunction = Callable[[Sequence[str]], int | None]  # arguments -> exit code, none for 0


class Refused(ValueError):
    """The request cannot be answered; the message says why."""


@dataclass(frozen=True)
class ComposedCommand:
    """A command whose settings Hydra composes: arguments -> exit code."""

    does: CommandFunction
    conf: str  # the name of its file in conf/
    shape: type[Any]  # of its settings
    refused: tuple[type[Exception], ...] = INPUT_ERRORS
    resumes: bool = False  # what the machine ends, the same command goes on with

    def __call__(self, argv: Sequence[str]) -> int:
        """As `run_command`."""
        return run_command(argv, self.does, self.help_text, refused=self.refused, resumes=self.resumes)

    def help_text(self) -> str:
        """What its module says, the choices of its groups, plug-ins among them, its keys with their defaults."""
        text = (conf_dir() / f"{self.conf}.yaml").read_text(encoding="utf-8")
        groups = [*config_groups(self.conf), *(["expert"] if "expert@" in text else [])]
        listed = "\n".join(
            f"  {word}: {', '.join(group_choices(word.partition('@')[0], [conf_dir()]))}" for word in groups
        )
        told = f"\nchoices; the keys of each: --cfg\n{listed}\n" if groups else ""
        chosen = {word.rpartition("@")[2] for word in groups}
        values = {**_default_values(self.shape), **dict(re.findall(r"^(\w+): (\S+)", text, re.M))}
        keys = {key: value for key, value in values.items() if key not in chosen}
        return help_text_of(f"{help_intro(self.does)}{told}", keys, self.shape)


def command(
    conf: str, shape: type[Any], refused: tuple[type[Exception], ...] = INPUT_ERRORS, resumes: bool = False
) -> Callable[[CommandFunction], ComposedCommand]:
    """A function of a command line as a command; the arguments as of ComposedCommand."""
    return lambda does: ComposedCommand(does, conf, shape, refused, resumes)


def run_request_command(does: Callable[[Any], int | None], argv: Sequence[str]) -> int:
    """The exit code of a command that takes a request."""
    shape = request_class_of(does)
    keys = {name: value for name, value in _default_values(shape).items() if name in request_keys(shape)}
    return run_command(
        argv,
        lambda words: does(parse(shape, words)),
        lambda: help_text_of(help_intro(does), keys, shape),
        elsewhere=", or give to=<another place>" if "to" in keys else "",
    )


def request_class_of(does: Callable[[Any], int | None]) -> Any:
    """The dataclass of a command's request."""
    return get_type_hints(does)["request"]


def help_intro(does: Callable[..., Any]) -> str:
    """What a command says of itself: its function, or the module where it is the module's only one, `main`."""
    return inspect.cleandoc((sys.modules[does.__module__] if does.__name__ == "main" else does).__doc__ or "") + "\n"


def run_command(
    argv: Sequence[str],
    does: CommandFunction,
    about: Callable[[], str],
    refused: tuple[type[Exception], ...] = (),
    resumes: bool = False,
    elsewhere: str = "",
) -> int:
    """The exit code of what a command line asks for; its help; one line for what it cannot have.

    refused: what else is the user's to mend; resumes: as of ComposedCommand; elsewhere: what helps where nothing can be
    written. A fault of the program is raised.
    """
    if {"-h", "--help"} & set(argv):
        print(about())
        return COMPLETE
    try:
        if several := [word for word in argv if word.partition("=")[0] in SEVERAL]:
            raise ConfigError(
                f"{several[0].partition('=')[0]}: a run fills one folder, so several runs are several commands: "
                "for n in 1 2; do python -m factory.run rounds=$n out=runs/rounds$n; done"
            )
        return does(argv) or COMPLETE
    except SettingsShown as settings:
        print(settings)
        return COMPLETE
    except Exception as error:
        code, line = _exit_of_error(error, refused, resumes, elsewhere)
        if code == COMPLETE:
            raise
        from factory.wording import printable

        print("\n".join(map(printable, line.split("\n"))), file=sys.stderr)
        return code


def _exit_of_error(
    error: Exception, refused: tuple[type[Exception], ...], resumes: bool, elsewhere: str
) -> tuple[int, str]:
    """The exit code and the line that an exception ends a command with; COMPLETE for a fault of the program."""
    from factory.files import DamagedFile, DiskFull, machine_fault_of, why_no_memory, why_not_written
    from factory.wording import one_line

    if isinstance(error, Stopped):
        return INTERRUPTED, str(error)
    if isinstance(error, DamagedFile):
        return BAD_CONFIG, f"error: {str(error).rstrip('.')}; {VERIFY}"
    if isinstance(error, Failed):
        return COMPLETE_WITH_FAILURES, f"error: {error}"
    why, helps = why_not_written(error)
    helps = f"; {helps}{elsewhere}" if helps and helps not in str(error) else ""
    if isinstance(error, (Refused, ConfigError, *refused)):
        return BAD_CONFIG, f"error: {error}{helps}"
    if refused_memory := why_no_memory(error):
        return BAD_CONFIG, f"error: {refused_memory}; give it more and run the same command again"
    if resumes and isinstance(error, DiskFull):
        return INTERRUPTED, f"error: {error}; free disk space and run the same command again"
    if resumes and machine_fault_of(error):
        return INTERRUPTED, f"error: {one_line(error)}; run the same command again to go on"
    if why and not resumes:
        return BAD_CONFIG, f"error: {why}{helps}"
    return COMPLETE, ""


def help_text_of(about: str, keys: Mapping[str, Any], shape: type[Any]) -> str:
    """What a command does, its keys with their defaults and meanings, and its exit codes."""
    ends = "Exit codes: 0 done, 2 refused in one line that says why; all: docs/configuration.md."
    told = [] if "exit codes" in about.lower() else [f"\n{ends}"]
    return "\n".join([about, "keys and defaults", *yaml_lines(keys, shape, {}), *told])


def _default_values(shape: type[Any]) -> dict[str, Any]:
    """Every key with its default, ??? where it has none, in their order."""
    known = {**required_keys(shape), **defaults_of(shape)}
    return {field.name: known[field.name] for field in fields(shape)}


def parse(shape: type[Request], argv: Sequence[str]) -> Request:
    """A request out of arguments; its fields are the keys: text, a number, a switch, a Literal, a list of texts.

    Raises Refused for an unknown key, a value missing or of another kind, a key given twice, and a field without a
    default that is not given; with --cfg SettingsShown instead, whatever is not given yet.
    """
    argv, shows = split_off_cfg(argv)
    kinds, words, rest = request_keys(shape), fields_with(shape, POSITIONAL), fields_with(shape, RUN_SETTINGS)
    given: dict[str, Any] = dict.fromkeys(rest, ())
    for argument in argv:
        word, equals, value = argument.partition("=")
        key = f"{word}_" if iskeyword(word) else word
        if key in kinds and value:
            if key in given:
                raise Refused(f"{word} is given twice")
            given[key] = expand_home(_value(word, value, kinds[key]), word)
        elif words and not equals and not argument.startswith("-"):
            name = words[0]
            if get_origin(kinds[name]) is tuple:
                given[name] = (*given.get(name, ()), expand_home(argument, name))
                continue
            if name in given:
                raise Refused(f"{name} is given twice")
            given[name] = expand_home(_value("", argument, kinds[words.pop(0)]), name)
        elif rest:
            given[rest[0]] += (argument,)
        else:
            known = [f"{key_of(name)}=" for name in kinds]
            near = "" if key in kinds else did_you_mean(key, known)
            raise Refused(f"{argument!r}: expected one of {'..., '.join(known)}...; see --help{near}")
    if shows:
        raise SettingsShown("\n".join(_settings_as_yaml(shape, given)))
    for field in fields(shape):
        if field.default is MISSING and field.name not in given:
            choices = "|".join(map(str, get_args(kinds[field.name])))
            what = "<folder or URL of a run>" if field.name == "out" else choices or "..."
            raise Refused(f"{field.name}={what} is missing; see --help")
    try:
        return shape(**given)
    except ValueError as error:
        raise Refused(str(error)) from error


def request_keys(shape: type["DataclassInstance"]) -> dict[str, Any]:
    """Key -> type of a request's fields, less the one that takes the settings of the run."""
    hints, rest = get_type_hints(shape), fields_with(shape, RUN_SETTINGS)
    return {field.name: hints[field.name] for field in fields(shape) if field.name not in rest}


def fields_with(shape: type["DataclassInstance"], how: Mapping[str, str]) -> list[str]:
    """The fields that are given as words, or that take the settings of the run."""
    return [field.name for field in fields(shape) if how.items() <= field.metadata.items()]


def _settings_as_yaml(shape: type["DataclassInstance"], given: Mapping[str, Any]) -> Iterator[str]:
    """The keys of a request as YAML, and behind them the settings of the run that it takes."""
    from factory.config.run import compose_run

    own = request_keys(shape)
    values = {**_default_values(shape), **{name: to_plain(value) for name, value in given.items()}}
    yield from yaml_lines({name: values[name] for name in own}, shape, {})
    for name in fields_with(shape, RUN_SETTINGS):
        groups = {re.split("[=.@]", word.lstrip("+"))[0] for word in given[name]}
        keeps = True
        try:
            compose_run([SHOW[0], *given[name]])
        except SettingsShown as settings:
            for line in str(settings).splitlines():
                if name in fields_with(shape, GIVEN_ALONE) and not line.startswith(" "):
                    keeps = line.partition(":")[0] in groups
                if keeps:
                    yield line


def _value(key: str, text: str, kind: Any) -> Any:
    allowed, said = {kind, *get_args(kind)}, f"{key}={text}" if key else repr(text)
    choices = allowed_values(kind)
    if choices and (text.lower() if bool in allowed else text) not in choices:
        listed = "true or false" if bool in allowed else f"one of {', '.join(choices)}"
        raise Refused(f"{said}: must be {listed}{did_you_mean(text, choices)}")
    if bool in allowed:
        return text.lower() == "true"
    if int in allowed and not (text.isascii() and text.isdecimal()):
        raise Refused(f"{said}: must be a whole number, 0 or more")
    if get_origin(kind) is tuple:
        return tuple(part.strip() for part in text.strip("[]").split(","))
    try:
        return int(text) if int in allowed else float(text) if float in allowed else text
    except ValueError as error:
        raise Refused(f"{said}: must be a number") from error
