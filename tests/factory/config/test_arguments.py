"""Arguments of the commands that look at a run."""

from dataclasses import dataclass

import pytest

from factory.config.arguments import Refused, parse


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
