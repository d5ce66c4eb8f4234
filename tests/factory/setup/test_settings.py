"""What a command line may not ask for, said before anything is written."""

from pathlib import Path

import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.config.run import built_in_classes, load_config, refuse_relative_root
from factory.files import machine_fault_of
from factory.setup.settings import assemble
from factory.setup.vocabulary import save_recovery_table
from factory.store.schema import RunIdentity
from tasks.experts.recovery import RecoveryTable
from tasks.rollout.simulate import SeenTraffic
from tasks.world.arrays import Array
from tasks.world.vocabulary import kinematic_trajectories

BLIND = ("clips.n_clips=1", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0")


def test_a_relative_root_in_a_submitted_job_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_relative_root({"root": "logs"})  # on one's own machine it is fine
    monkeypatch.setenv("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")
    refuse_relative_root({"root": "/data/logs"})
    refuse_relative_root({"n_clips": 3})
    with pytest.raises(ConfigError, match=r"clips\.root=logs is relative"):
        refuse_relative_root({"root": "logs"})
    photos = {"root": "/data/logs", "cameras": "photos", "sensor_root": None}
    photos["_target_"] = built_in_classes("clips")["scenarionet"]
    with pytest.raises(ConfigError, match=r"clips\.cameras=photos is relative"):
        refuse_relative_root(photos)
    refuse_relative_root(photos | {"_target_": "my.Reader"})  # whose cameras may be names


@pytest.mark.parametrize(
    ("job", "named", "default"),
    [
        (False, None, "runs/synthetic"),
        (True, None, "/home/someone/driving-data-factory/runs/synthetic"),
        (False, "/data/runs", "/data/runs/synthetic"),
        (True, "s3://bucket/runs", "s3://bucket/runs/synthetic"),
    ],
)
def test_results_lie_below_one_root_that_a_submitted_job_can_keep(
    monkeypatch: pytest.MonkeyPatch, job: bool, named: str | None, default: str
) -> None:
    monkeypatch.setenv("HOME", "/home/someone")
    for variable, value in {"RAY_JOB_CONFIG_JSON_ENV_VAR": "{}" if job else None, "FACTORY_RUNS": named}.items():
        monkeypatch.delenv(variable, raising=False)
        if value is not None:
            monkeypatch.setenv(variable, value)
    assert load_config([]).out == default
    assert load_config(["out=elsewhere"]).out == "elsewhere"


def test_a_finished_table_takes_no_vocabularies(shared_root: Path, tmp_path: Path) -> None:
    table = tmp_path / "table.npz"
    save_recovery_table(table, RecoveryTable(kinematic_trajectories(5, 0)), {})
    asked = [f"clips.root={shared_root / 'data/av2/sensor/val'}", "clips=av2", f"expert.recovery.table={table}"]
    run = assemble(load_config([*asked, f"out={tmp_path / 'out'}", "experts=[recovery]"]))
    assert len(run.work.experts["recovery"].table) == 5  # type: ignore[attr-defined]
    assert not (tmp_path / "out").exists()
    np.save(tmp_path / "more.npy", kinematic_trajectories(5, 1))
    with pytest.raises(ConfigError, match="table or vocabularies"):
        assemble(load_config([*asked, f"expert.recovery.vocabularies=[{tmp_path / 'more.npy'}]", "experts=[recovery]"]))


@pytest.mark.slow
def test_a_recovery_table_kept_of_train_logs_is_not_given_where_they_are_test(
    shared_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    asked = ["clips=av2", f"clips.root={shared_root / 'data/av2/sensor/val'}", f"out={tmp_path}", "experts=[recovery]"]
    run = assemble(load_config([*asked, "clips.split=train", "limit=1"]))
    assert len(run.work.experts["recovery"].table)  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"no train log, the clips are 14 test: clips\.split=train takes them"):
        assemble(load_config([*asked, "clips.split=test", "limit=1"]))


class Standing:
    """A traffic policy whose digest can be set."""

    version = "1"

    def digest(self) -> str:
        return self.version

    def next_states(self, seen: SeenTraffic) -> Array:
        return np.pad(seen.boxes[-1, :-1, :3], ((0, 0), (0, 1)))


POLICY = ("traffic=custom", f"traffic.policy={__name__}:Standing")


def test_a_policy_is_in_the_key_of_rows_by_its_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    """And no word of it stands in keys of other traffic."""

    def identity(*words: str) -> RunIdentity:
        return assemble(load_config([*BLIND, "experts=[pdm_closed]", *words])).work.identity

    one, alike = identity(*POLICY), identity(*POLICY)
    monkeypatch.setattr(Standing, "version", "2")
    other = identity(*POLICY)
    assert one.settings_hash == alike.settings_hash != other.settings_hash
    assert one.prepare_digest == alike.prepare_digest != other.prepare_digest
    assert "traffic.policy" not in identity().settings


@pytest.mark.slow
def test_a_policy_that_is_changed_under_a_run_makes_no_row_by_the_name_of_the_old_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is the machine's illness, not the clip's."""
    run = assemble(load_config([*BLIND, "experts=[pdm_closed]", "render=none", "vocabulary.k=64", *POLICY]))
    (ref,) = run.refs
    run.work.prepare(ref)
    monkeypatch.setattr(Standing, "version", "2")
    with pytest.raises(OSError, match="another digest than when the run began") as refused:
        run.work.prepare(ref)
    assert machine_fault_of(refused.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["traffic=custom"], r"traffic\.policy is missing"),
        (["traffic.policy=my:Policy"], r"traffic\.policy=my:Policy with traffic=idm: traffic=custom takes one"),
        (["traffic=custom", "traffic.policy=nothing:At"], r"traffic\.policy=nothing:At: name one as"),
    ],
)
def test_traffic_without_its_policy_is_refused(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        assemble(load_config([*BLIND, "experts=[pdm_closed]", *words]))
