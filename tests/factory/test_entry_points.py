"""What an installed package offers by name: a distribution made here, found as any other that pip installed."""

import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hydra.core.config_store import ConfigStore

from examples.csv_logs import write_log
from factory.commands.completion import completions
from factory.config.compose import ConfigError, compose
from factory.config.plugins import plugin_named, plugins_by_name
from factory.config.run import compose_run, load_config
from factory.run import main as run_main
from factory.store.reader import SampleTable
from planners.evaluation.planner_names import find_planner
from planners.models.planner import planner_class
from planners.training.train import main as train_main
from tasks.kernels.compiled import cache_dir

ROOT = Path(__file__).resolve().parents[2]
MODULE = """
from examples.csv_logs import CsvReader as Reader
from examples.keep_lane import KeepLane as Expert
from examples.linear_planner import LinearPlanner as Planner
"""
KINDS = {"readers": "Reader", "experts": "Expert", "planners": "Planner"}


def install(site: Path, package: str, name: str = "mine", kinds: tuple[str, ...] = tuple(KINDS)) -> None:
    """What pip would leave in a site folder: a module and its metadata."""
    (site / package).mkdir(parents=True)
    (site / package / "__init__.py").write_text(MODULE)
    metadata = site / f"{package}-1.2.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    groups = (f"[driving_data_factory.{kind}]\n{name} = {package}:{KINDS[kind]}\n" for kind in kinds)
    (metadata / "entry_points.txt").write_text("\n".join(groups))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path for as long as the test lasts; what it offers is no choice of Hydra's afterwards."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    importlib.invalidate_caches()
    before = {group: set(ConfigStore.instance().repo.get(group, {})) for group in ("clips", "planner")}
    yield folder
    for group, known in before.items():
        choices = ConfigStore.instance().repo.get(group, {})
        for name in set(choices) - known:
            del choices[name]
    for name in [name for name in sys.modules if name in ("somebody", "somebody_else")]:
        del sys.modules[name]


def run_arguments(home: Path) -> list[str]:
    write_log(home / "logs" / "street")
    small = "clips=mine experts=[mine,human] render=none reward.labels=none vocabulary.k=256 limit=1"
    return [*small.split(), f"clips.root={home / 'logs'}", f"out={home / 'out'}"]


@pytest.mark.slow
def test_a_reader_an_expert_and_a_planner_work_by_name(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install(site, "somebody")
    assert run_main([*run_arguments(tmp_path), "executor=local"]) == 0, capsys.readouterr().err
    assert experts_of(tmp_path) == {"mine", "human"}
    small = "planner=mine planner.settings.history=true planner.training.batch_size=2 steps=1 workers=1 device=cpu"
    data = [f"data.real=[{tmp_path / 'out'}]", f"data.sim=[{tmp_path / 'out'}]", f"out={tmp_path / 'linear'}"]
    assert train_main([*small.split(), *data]) == 0, capsys.readouterr().err
    loaded = find_planner(str(tmp_path / "linear")).load
    assert loaded is not None and type(loaded()) is planner_class("mine")
    assert find_planner("mine").label == "mine"


def experts_of(home: Path) -> set[str]:
    table = SampleTable(home / "out")
    assert len(table)
    return {table[i]["expert"] for i in range(len(table))}


@pytest.mark.ray
@pytest.mark.slow
def test_workers_of_ray_import_them_too(site: Path, tmp_path: Path) -> None:
    install(site, "somebody")
    env = os.environ | {"PYTHONPATH": f"{site}{os.pathsep}{ROOT}", "NUMBA_CACHE_DIR": str(cache_dir().parent)}
    command = [sys.executable, "-m", "factory.run", *run_arguments(tmp_path), "executor=ray", "workers=1"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    assert experts_of(tmp_path) == {"mine", "human"}


def test_settings_of_an_expert_need_no_target_and_a_target_of_one_s_own_comes_first(site: Path) -> None:
    install(site, "somebody")
    spec = load_config(["+expert.mine.settle_m=20", "experts=[mine]"]).expert["mine"]
    assert spec == {"_target_": "somebody.Expert", "settle_m": 20}
    own = load_config(["+expert.mine._target_=my.Own", "experts=[mine]"]).expert["mine"]
    assert own == {"_target_": "my.Own"}


def test_an_unknown_name_lists_what_is_installed_and_which_is_meant(site: Path) -> None:
    install(site, "somebody")
    with pytest.raises(ConfigError, match=r"experts: .*mein.*'mine'.*did you mean mine\?"):
        load_config(["experts=[mein]"])
    with pytest.raises(ConfigError, match=r"clips=mein: there is .*mine.*did you mean clips=mine\?"):
        load_config(["clips=mein"])
    with pytest.raises(ConfigError, match=r"planner=mein: there is .*mine.*did you mean planner=mine\?"):
        compose("train", ["planner=mein"])
    with pytest.raises(ConfigError, match=r"planner.name=mein: none of .*, mine; did you mean mine\?; or name a class"):
        planner_class("mein")
    with pytest.raises(
        ConfigError, match=r"planner=mein: neither a folder nor one of .*, mine; did you mean mine\?; or"
    ):
        find_planner("mein")


def test_help_and_completion_list_what_is_installed_and_import_none_of_it(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def listed(group: str) -> set[str]:
        assert (train_main if group == "planner" else run_main)(["--help"]) == 0
        (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith(f"  {group}: "))
        return set(line.partition(": ")[2].split(", "))

    groups = ("clips", "expert", "planner")
    without, experts = {group: listed(group) for group in groups}, set(completions(["run"], "experts="))
    assert "experts=recovery" in experts and "experts=mine" not in experts
    install(site, "somebody")
    assert {group: listed(group) for group in groups} == {group: without[group] | {"mine"} for group in groups}
    assert set(completions(["run"], "clips=")) == {f"clips={name}" for name in without["clips"] | {"mine"}}
    assert set(completions(["run"], "experts=")) == experts | {"experts=mine"}
    assert "somebody" not in sys.modules


@pytest.mark.parametrize(
    "ask",
    [
        lambda: load_config(["clips=mine"]),
        lambda: load_config(["experts=[mine]"]),
        lambda: compose("train", ["planner=mine"]),
        lambda: find_planner("mine"),
    ],
    ids=("reader", "expert", "planner to train", "planner to evaluate"),
)
def test_a_name_that_two_packages_offer_is_refused_with_both(site: Path, ask: object) -> None:
    install(site, "somebody")
    install(site, "somebody_else")
    load_config([])  # nobody asked for it
    with pytest.raises(ConfigError, match=r"mine is offered by somebody 1\.2 and somebody_else 1\.2: uninstall all"):
        ask()  # type: ignore[operator]


@pytest.mark.parametrize(
    ("kind", "name", "words", "asked"),
    [
        ("readers", "av2", ["clips=av2", "clips.root=/logs"], compose_run),
        ("experts", "human", ["experts=[human]"], compose_run),
        ("planners", "ltf", ["planner=ltf"], partial(compose, "train")),
    ],
)
def test_a_name_that_is_built_in_is_refused_with_who_offers_it_too(
    site: Path, kind: str, name: str, words: list[str], asked: Any
) -> None:
    asked(words)
    install(site, "somebody", name, (kind,))
    importlib.invalidate_caches()
    with pytest.raises(ConfigError, match=rf"{kind[:-1]} {name} is built in, and somebody 1\.2 offers another"):
        asked(words)


def test_a_folder_of_the_same_name_is_told_apart(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(site, "somebody")
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"a folder here and a planner of somebody 1\.2: planner=\./mine"):
        find_planner("mine")


def test_without_plug_ins_nothing_is_offered_and_nothing_is_imported(site: Path) -> None:
    assert plugins_by_name("expert") == {} and plugin_named("expert", "mine", ()) is None
    install(site, "somebody")
    assert [plugin.target for plugin in plugins_by_name("expert")["mine"]] == ["somebody.Expert"]
    load_config([])
    assert "somebody" not in sys.modules
