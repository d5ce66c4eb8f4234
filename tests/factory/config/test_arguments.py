"""Arguments of the commands that look at a run."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from factory.commands.table import COMMANDS, DOORS
from factory.config.arguments import (
    POSITIONAL,
    RUN_SETTINGS,
    Refused,
    parse,
    request_class_of,
    request_keys,
)
from factory.config.shapes import allowed_values
from factory.config.words import ConfigError
from tests.factory.text_keys import led_home, text_keys


@dataclass(frozen=True)
class Ask:
    """Keys of every kind."""

    out: str
    n: int = 3
    every: int | None = None
    name: str | None = None
    deep: bool = False

    def __post_init__(self) -> None:
        if self.deep and self.name is None:
            raise ValueError("deep=true is of name=")


def test_values_become_what_the_fields_are() -> None:
    assert parse(Ask, ["out=s3://b/x=y", "every=10", "deep=True", "name=7"]) == Ask("s3://b/x=y", 3, 10, "7", True)
    assert parse(Ask, ["out=x"]) == Ask("x")


ASKED = [
    *(f"factory {name}" for name in COMMANDS if name not in ("run", "plan")),
    *(f"planners {name}" for name in ("serve", "submit")),
]


@pytest.mark.parametrize("command", ASKED)
def test_a_home_folder_is_one_in_every_key_that_names_a_file(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    package, name = command.split()
    shape = request_class_of(DOORS[package][name].function())
    texts = [key for key in text_keys(shape) if key in request_keys(shape)]
    chosen = [f"{key}={allowed_values(hint)[0]}" for key, hint in request_keys(shape).items() if allowed_values(hint)]
    monkeypatch.setattr(shape, "__post_init__", lambda self: None, raising=False)  # what goes with what
    found = parse(shape, [*chosen, *(f"{key}=~/x" for key in texts)])
    paths = [key for key in texts if led_home(key, tmp_path) != "~/x"]
    for key in texts:
        assert getattr(found, key) in (home := led_home(key, tmp_path), (home,)), key
    for key in paths:
        with pytest.raises(ConfigError, match=f"^{key}=~nobody.here/x: there is no home folder ~nobody.here"):
            parse(shape, [f"{key}=~nobody.here/x"])


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "out=<folder or URL of a run> is missing"),
        (["out=x", "N=1"], "'N=1': expected one of out=..., n=..."),
        (["out=x", "n"], "'n': expected"),
        (["out=x", "n="], "'n=': expected"),
        (["out=x", "n=1", "n=1"], "n is given twice"),
        (["out=x", "n=-1"], "n=-1: must be a whole number"),
        (["out=x", "every=1.5"], "every=1.5: must be a whole number"),
        (["out=x", "deep=yes"], "deep=yes: must be true or false"),
        (["out=x", "deep=true"], "deep=true is of name="),
    ],
)
def test_what_cannot_be_meant_is_refused(argv: list[str], said: str) -> None:
    with pytest.raises(Refused) as refused:
        parse(Ask, argv)
    assert said in str(refused.value)


@dataclass(frozen=True)
class Told:
    """Words, a choice, a list and settings of a run."""

    how: Literal["fast", "slow"] = field(metadata=POSITIONAL)
    files: tuple[str, ...] = field(default=(), metadata=POSITIONAL)
    names: tuple[str, ...] = ()
    every_s: float | None = None


@dataclass(frozen=True)
class Passed:
    """A key of its own before settings of a run."""

    clip: str = "0"
    settings: tuple[str, ...] = field(default=(), metadata=RUN_SETTINGS)


def test_words_stand_without_keys_and_in_their_order() -> None:
    assert parse(Told, ["slow", "a.npz", "names=[x, y]", "b.npz", "every_s=1e-1"]) == Told(
        "slow", ("a.npz", "b.npz"), ("x", "y"), 0.1
    )
    assert parse(Told, ["how=fast"]) == Told("fast")
    for argv, said in (
        ([], "how=fast|slow is missing"),
        (["fsat"], "'fsat': must be one of fast, slow; did you mean fast?"),
        (["fast", "every_s=x"], "every_s=x: must be a number"),
        (["fast", "how=slow"], "how is given twice"),
        (["fast", "--file"], "'--file': expected one of"),
    ):
        with pytest.raises(Refused) as refused:
            parse(Told, argv)
        assert said in str(refused.value)


def test_what_is_no_key_goes_to_the_run_as_it_stands() -> None:
    given = ["rounds=2", "clip=7", "--config-dir", "mine", "+expert.mine.x=1", "settings=odd"]
    assert parse(Passed, given) == Passed("7", (*given[:1], *given[2:]))
