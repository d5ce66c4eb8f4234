"""Configuration: the dataclasses hold the defaults, conf/ what differs; what is unknown is an error."""

import dataclasses
import math
import pwd
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from factory.config.compose import ConfigError, build, conf_dir, fill
from factory.config.plugins import group_choices
from factory.config.run import PerturbSources, RewardSettings, RunConfig, compose_run, load_config, settings_classes
from factory.config.words import SettingsShown
from factory.setup.settings import (
    RunContext,
    assemble,
    build_expert,
    open_reader,
    refuse_missing_backend,
    simulates,
)
from tasks.render.settings import RenderMode, RenderSettings, SceneDtype
from tasks.rollout.simulate import TrafficSettings
from tests.factory.data_folders import add_companions
from tests.factory.text_keys import held, led_home, text_keys

DENSE = PerturbSources(max_longitudinal_m=8.0, step_longitudinal_m=1.0, interleaved=False, order="spread", at_most=32)
GROUPS = [
    ("perturb/paper", PerturbSources()),
    ("perturb/dense", DENSE),
    ("traffic/idm", TrafficSettings()),
    ("traffic/replay", TrafficSettings(mode="replay")),
    ("render/auto", RenderSettings()),
    ("render/map", RenderSettings(mode=RenderMode.MAP)),
    ("render/none", RenderSettings(mode=RenderMode.NONE)),
]


@pytest.mark.parametrize(("name", "expected"), GROUPS, ids=[name for name, _ in GROUPS])
def test_a_choice_is_its_dataclass_with_what_its_file_says(name: str, expected: Any) -> None:
    group, choice = name.split("/")
    assert getattr(load_config([f"{group}={choice}"]), group) == expected


def test_every_setting_has_a_default_and_a_meaning_and_is_shown_with_both() -> None:
    with pytest.raises(SettingsShown) as settings:
        compose_run(["--cfg", "preset=none"])
    shown = str(settings.value).splitlines()
    assert "  width: 320  # pixels" in shown and "  mode: auto  # auto | map | painter | none; " in "\n".join(shown)
    assert yaml.safe_load("\n".join(shown)) == compose_run(["preset=none"])
    silent = [line for line in shown if "  # " not in line and not re.search(r"_target_|name: |kind: |^  \w+:$", line)]
    assert [line for line in silent if not re.search(r"_(m|mps|s|mps2|deg)\b", line)] == []


def test_what_is_fixed_is_no_setting_and_stays_in_the_record() -> None:
    assert RenderSettings().scene_dtype is SceneDtype.FLOAT16 and "scene_dtype" in dataclasses.asdict(RenderSettings())
    for key in ("render.scene_dtype=float32", "render.asset.stereo_photos=2", "traffic.exponent=2"):
        with pytest.raises(ConfigError, match="there is no such setting"):
            load_config([key])
    with pytest.raises(ConfigError, match="there is no such setting"):
        fill(RenderSettings, {"rig": {"width": 640}}, "render")


def test_a_plain_run_shows_at_most_120_keys() -> None:
    with pytest.raises(SettingsShown) as settings:
        compose_run(["--cfg"])
    lines = str(settings.value).splitlines()
    assert 100 < sum(bool(re.match(r" *[\w.]+: [^ #]", line)) for line in lines) <= 120


def test_the_run_s_keys_are_those_of_its_dataclass() -> None:
    assert set(compose_run([])) == {field.name for field in dataclasses.fields(RunConfig)}
    config = load_config([])
    assert (config.rounds, config.executor, config.limit) == (1, "ray", None)
    assert config.perturb == PerturbSources()
    assert config.reward == RewardSettings()


@pytest.mark.parametrize(
    ("choice", "n_least"),
    [
        *((name, 12) for name in ("synthetic", "synthetic_towns")),
        *((f"{name} clips.root=x", 13) for name in ("av2", "scenarionet", "py123d")),
        ("navsim clips.root=x clips.maps=x", 16),
    ],
)
def test_a_home_folder_is_one_in_every_key_that_names_a_file(
    choice: str, n_least: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    words = f"clips={choice}".split()
    found = compose_run(words)
    keys = text_keys(RunConfig) + [
        f"{at}.{key}" for at, shape in settings_classes(found).items() for key in text_keys(shape)
    ]
    assert {"out", "vocabulary.file", "reward.label_vocabulary", "expert.recovery.table"} < set(keys)
    assert len(keys) >= n_least
    alone, listed = (compose_run([*words, *(f"{key}={given}" for key in keys)]) for given in ("~/x", "[~/x,y]"))
    for key in keys:
        home = led_home(key, tmp_path)
        assert (held(alone, key), held(listed, key)) == (home, [home, "y"]), key


def test_companions_of_files_of_configuration_are_no_choices(tmp_path: Path) -> None:
    (tmp_path / "render").mkdir()
    (tmp_path / "render" / "mine.yaml").write_text("mode: map\n")
    add_companions(tmp_path)
    assert group_choices("render", [tmp_path]) == ["mine"]
    assert load_config([f"--config-dir={tmp_path}", "render=mine"]).render.mode is RenderMode.MAP


def test_a_plug_in_s_key_is_led_home_too_and_a_stranger_s_home_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    own = ["clips=custom", "clips._target_=my.Reader"]
    assert compose_run([*own, "clips.logs={a: ~/a}"])["clips"]["logs"] == {"a": f"{tmp_path}/a"}
    assert compose_run([*own, "clips.logs=~root/a"])["clips"]["logs"] == f"{pwd.getpwnam('root').pw_dir}/a"
    others = compose_run([*own, "clips.logs=a~/b", "clips.token=~a/b"])["clips"]
    assert (others["logs"], others["token"]) == ("a~/b", "~a/b")
    with pytest.raises(ConfigError, match=r"^clips\.root=~nobody\.here/a: there is no home folder ~nobody\.here;"):
        compose_run([*own, "clips.root=~nobody.here/a"])


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("width", (0, 15, -320)),
        ("height", (0, 15)),
        ("jpeg_quality", (0, 101)),
        ("psnr_min", (-1.0, math.nan, math.inf)),
    ],
)
def test_render_settings_out_of_range_are_refused(name: str, values: tuple[float, ...]) -> None:
    for value in values:
        with pytest.raises(ConfigError, match=f"render {name} must be"):
            fill(RenderSettings, {name: value}, "render")


PDM = "+expert.mine._target_=tasks.experts.pdm_closed.PdmClosed"
RECOVERY = "+expert.mine._target_=factory.setup.settings.recovery_expert"


def built(*overrides: str) -> object:
    config = load_config([*overrides, "experts=[mine]"])
    no_clips: Any = None
    return build_expert(RunContext(config, "mine", no_clips))


def test_an_expert_is_added_by_its_target_with_all_its_arguments() -> None:
    expert = built("+expert.mine._target_=tasks.experts.protocol.Human", "+expert.mine.name=me")
    assert (type(expert).__name__, expert.name) == ("Human", "me")  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+expert.mine._target_=tasks.experts.protocol.Nobody"], r"expert\.mine: .*Nobody"),
        (["+expert.mine._target_=tasks.experts.protocol.Human", "+expert.mine.speed=3"], r"(?s)expert\.mine: .*speed"),
        (["+expert.mine._target_=collections.Counter"], r"Counter is not an expert .* no name, digest, plan"),
        ([PDM, "+expert.mine.speed=3"], r"(?s)expert\.mine: .*speed"),
        ([RECOVERY, "+expert.mine.speed=3"], r"expert\.mine\.speed: there is no such setting"),
        ([RECOVERY, "+expert.mine.table=[1]"], r"expert\.mine\.table"),
        ([RECOVERY, "+expert.mine.table=nowhere.npz"], r"expert\.mine\.table=nowhere.npz: there is no such file"),
        ([RECOVERY, "+expert.mine.mach=log"], r"expert\.mine\.mach: .*; did you mean expert\.mine\.match="),
    ],
)
def test_an_expert_that_cannot_be_made_is_an_error_that_names_what(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        built(*overrides)


def test_experts_that_are_tried_once_say_so_themselves() -> None:
    mine = "+expert.mine._target_=tasks.experts.protocol."
    for target, experts, simulated in (
        ("Human", "[mine,human]", False),
        ("Logged", "[mine,human]", True),
        ("Human", "[mine,pdm_closed]", True),
        ("Human", "[mine,human_before]", True),  # a benchmark's clips are listed
    ):
        assert simulates(load_config([mine + target, f"experts={experts}"])) == simulated


def test_something_that_is_no_reader_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"Counter is not a reader .* no name, index, read"):
        open_reader({"name": "custom", "_target_": "collections.Counter"})
    with pytest.raises(ConfigError, match=r"clips\._target_ is missing"):
        build({"name": "custom"}, "clips")


def test_an_installation_without_configuration_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factory.config.compose.__file__", str(tmp_path / "factory" / "config.py"))
    with pytest.raises(ConfigError, match=r"no conf/run\.yaml .* install it again"):
        conf_dir()


def test_a_backend_this_machine_lacks_is_refused_before_anything_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(ConfigError, match=r"render\.backend=gsplat needs torch and gsplat"):
        assemble(load_config(["render.backend=gsplat", "clips=av2", "clips.root=/nowhere"]))
    refuse_missing_backend(load_config(["render=none", "render.backend=gsplat"]))  # nothing is drawn with it
    with pytest.raises(ConfigError, match=r"render\.backend"):
        load_config(["render.backend=gpu"])
