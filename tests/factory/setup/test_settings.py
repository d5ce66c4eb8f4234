"""What a command line may not ask for, said before anything is written."""

from pathlib import Path

import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.config.run import SCENARIONET, load_config, refuse_relative_root
from factory.setup.settings import assemble
from factory.setup.vocabulary import save_recovery_table
from factory.store.identity import RunIdentity
from factory.store.illness import why_ill
from tasks.experts.recovery.expert import RecoveryTable
from tasks.rollout.learned.imitation import unfitted, weights_file
from tasks.world.kinematic_vocabulary import kinematic_trajectories

BLIND = ("clips.n_clips=1", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0")


def test_a_relative_root_in_a_submitted_job_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_relative_root({"root": "logs"})  # on one's own machine it is fine
    monkeypatch.setenv("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")
    refuse_relative_root({"root": "/data/logs"})
    refuse_relative_root({"n_clips": 3})
    with pytest.raises(ConfigError, match=r"clips\.root=logs is relative"):
        refuse_relative_root({"root": "logs"})
    photos = {"_target_": SCENARIONET, "root": "/data/logs", "cameras": "photos", "sensor_root": None}
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
    with pytest.raises(ConfigError, match="no train log"):
        assemble(load_config([*asked, "clips.split=test", "limit=1"]))


def test_a_policy_s_file_is_in_the_key_of_rows_by_what_is_in_it(tmp_path: Path) -> None:
    """The same file under two names gives the same rows; and no word of it stands in keys of other traffic."""
    given = unfitted().weights
    files = [tmp_path / name for name in ("a.npz", "b.npz", "c.npz")]
    for file, bias in zip(files, (0.0, 0.0, 1.0)):
        file.write_bytes(weights_file(given._replace(last_bias=given.last_bias + bias), "{}"))

    def identity(*words: str) -> RunIdentity:
        return assemble(load_config([*BLIND, "experts=[pdm_closed]", *words])).work.identity

    one, alike, other = (identity("traffic=learned", f"traffic.weights={file}") for file in files)
    assert one.settings_hash == alike.settings_hash != other.settings_hash
    assert one.prepare_digest == alike.prepare_digest != other.prepare_digest
    labelled = identity("reward.traffic=learned", f"traffic.weights={files[0]}")
    assert labelled.settings["traffic.weights"] == one.settings["traffic.weights"]
    assert not {"traffic.weights", "traffic.policy"} & identity().settings.keys()


@pytest.mark.slow
def test_a_policy_that_is_changed_under_a_run_makes_no_row_by_the_name_of_the_old_one(tmp_path: Path) -> None:
    """It is the machine's illness, not the clip's."""
    given, file = unfitted().weights, tmp_path / "policy.npz"
    file.write_bytes(weights_file(given, "{}"))
    words = [*BLIND, "experts=[pdm_closed]", "render=none", "vocabulary.k=64", "traffic=learned"]
    run = assemble(load_config([*words, f"traffic.weights={file}"]))
    (ref,) = run.refs
    run.work.prepare(ref)
    file.write_bytes(weights_file(given._replace(last_bias=given.last_bias + 1.0), "{}"))
    with pytest.raises(OSError, match="another file than when the run began") as refused:
        run.work.prepare(ref)
    assert why_ill(refused.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["traffic=learned"], "traffic weights is missing: mode=learned needs a file"),
        (["traffic=learned", "traffic.weights=/no/such.npz"], r"traffic\.weights: /no/such\.npz: No such file"),
        (["traffic.weights=some.npz"], r"traffic\.weights=some\.npz is for traffic=learned"),
        (["reward.traffic=learned"], "traffic weights is missing"),
        (["traffic=learned", "traffic.policy=nothing:At"], r"traffic\.policy=nothing:At: name one as"),
    ],
)
def test_traffic_without_its_policy_is_refused(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        assemble(load_config([*BLIND, "experts=[pdm_closed]", *words]))
