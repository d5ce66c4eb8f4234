"""The study's runs and sweeps: settings that their programs take, in an order in which each finds what it reads."""

from dataclasses import replace
from pathlib import Path

import pytest

from factory.config.compose import compose, fill
from factory.config.run import load_config
from planners.command import Failed
from planners.study import recipe as module
from planners.study.recipe import Recipe, factory, make
from planners.study.scaling import ScalingSettings

NAMES = ("study_data", "study_logs")


def recipe(name: str, *words: str) -> Recipe:
    return fill(Recipe, compose(name, words), name)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """What would be run: words of the factory, or `scaling` and its settings."""
    found: list[tuple[str, ...]] = []
    monkeypatch.setattr(module, "factory", lambda *words: found.append(words))
    monkeypatch.setattr(module, "scale", lambda words: found.append(("scaling", *words)))
    return found


def made(name: str, tmp_path: Path, *words: str) -> None:
    (tmp_path / "data").mkdir(exist_ok=True)
    shared = [f"shared={tmp_path}"] if name == "study_logs" else []
    make(recipe(name, f"out={tmp_path / 'out'}", *shared, *words))


@pytest.mark.parametrize("name", NAMES)
def test_runs_and_sweeps_are_ones_that_their_programs_take(
    name: str, asked: list[tuple[str, ...]], tmp_path: Path
) -> None:
    made(name, tmp_path, "minutes=1")
    runs, sweeps = ([words for program, *words in asked if program == kind] for kind in ("run", "scaling"))
    assert (len(runs), len(sweeps)) == {"study_data": (5, 0), "study_logs": (6, 9)}[name]
    outs = [Path(load_config(words).out) for words in runs]
    for words in sweeps:
        settings = fill(ScalingSettings, compose("scaling", words), "scaling")
        assert {Path(settings.data.real[0]), Path(settings.benchmark)} <= set(outs)
        assert settings.minutes is not None and settings.seeds == 5


def test_a_fold_learns_from_other_logs_than_it_is_scored_on(asked: list[tuple[str, ...]], tmp_path: Path) -> None:
    made("study_logs", tmp_path)
    configs = {Path(load_config(words).out).relative_to(tmp_path / "out"): words for _, *words in asked[:6]}
    only = {str(name): next(w for w in words if w.startswith("clips.only")) for name, words in configs.items()}
    for fold in ("av2_7fab2350", "av2_adcf7d18", "nuscenes"):
        logs = [set(only[f"{fold}/{side}"].partition("=")[2].strip("[]").split(",")) for side in ("train", "hard")]
        assert not logs[0] & logs[1], fold


def test_some_of_it_can_be_asked_for(asked: list[tuple[str, ...]], tmp_path: Path) -> None:
    made("study_logs", tmp_path, "only=[nuscenes]")
    assert len(asked) == 5 and all("nuscenes" in " ".join(words) for words in asked)
    with pytest.raises(ValueError, match="only=nuscene_: none of av2_7fab2350/train"):
        made("study_logs", tmp_path, "only=[nuscene_]")
    with pytest.raises(ValueError, match="no logs at nowhere/data"):
        make(replace(recipe("study_logs"), shared="nowhere"))


def test_the_towns_render_from_the_same_blocks(asked: list[tuple[str, ...]], tmp_path: Path) -> None:
    made("study_data", tmp_path)
    assert asked[0][0] == "vocabulary"
    blocks = {(tmp_path / "out" / name / "cache").resolve() for name in ("train", "replay", "control")}
    assert blocks == {tmp_path / "out" / "blocks"}


@pytest.mark.slow
def test_a_run_that_fails_is_named_with_its_exit_code() -> None:
    with pytest.raises(Failed, match="python -m factory run ended with exit code 2"):
        factory("run", "no_such_key=1")
