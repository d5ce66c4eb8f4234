"""MCAP episodes that a run writes: one per chosen sample, whole, of the present row, whatever was killed on the way."""

import io
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from factory.config.run import load_config
from factory.exits import COMPLETE, INTERRUPTED
from factory.graph import driver
from factory.graph.driver import EpisodeSettings
from factory.graph.execute import Execution, RunSummary
from factory.store.episodes import EPISODES_FOLDER, episode_name, wants_episode
from factory.store.location import Location
from factory.store.samples import Store
from factory.store.verify import verify
from factory.views.sample_text import prepared_episode
from tests.factory.filmed import FilmedWork
from tests.factory.toy import executed, refs

EXPERTS = ["recovery", "human"]


def run(out: Path | Store, every: int = 1, rounds: int = 2, n: int = 3, **options: Any) -> RunSummary:
    store = out if isinstance(out, Store) else Store(out)
    work = options.pop("work", FilmedWork())
    how = Execution("local", episodes=EpisodeSettings(every, prepared_episode), **options)
    return executed(work, refs(n), EXPERTS, rounds, store, how)


def there(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((out / EPISODES_FOLDER).glob("*"))}


def asked_for(out: Path, every: int = 1) -> set[str]:
    rows = Store(out).samples.read(["attempt_id", "settings_hash", "stage_versions"]).to_pylist()
    return {episode_name(row) for row in rows if wants_episode(row["attempt_id"], every)}


def attempt_of(data: bytes) -> str:
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    assert sum(1 for _ in reader.iter_messages()) > 100
    (record,) = reader.iter_metadata()
    return str(record.metadata["attempt_id"])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that wrote all of them."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert run(out).exit_code == COMPLETE
    return out


@pytest.mark.slow
def test_every_sample_has_its_episode_and_none_is_written_unless_asked_for(whole: Path, tmp_path: Path) -> None:
    found = there(whole)
    assert set(found) == asked_for(whole) and len(found) == len(Store(whole).samples) > 6
    assert all(attempt_of(data) == name.split("-")[0] for name, data in found.items())
    run(tmp_path, every=0)
    assert not (tmp_path / EPISODES_FOLDER).exists()


def test_one_in_n_is_a_choice_of_the_ids_alone(whole: Path, tmp_path: Path) -> None:
    run(tmp_path, every=3, rounds=1)
    run(tmp_path, every=3, rounds=2)
    assert there(tmp_path) == {name: data for name, data in there(whole).items() if name in asked_for(whole, 3)}
    many = [f"{i:016x}" for i in range(9000)]
    assert 2800 < sum(wants_episode(key, 3) for key in many) < 3200
    assert set(filter(lambda key: wants_episode(key, 6), many)) < set(filter(lambda key: wants_episode(key, 3), many))


@pytest.mark.slow
def test_what_is_missing_is_made_up_for_and_nothing_is_written_twice(whole: Path, tmp_path: Path) -> None:
    run(tmp_path, every=0)
    made_up = run(tmp_path)
    assert made_up.executed.attempts == 0 and made_up.executed.episodes == len(there(whole))
    assert there(tmp_path) == there(whole)
    (tmp_path / EPISODES_FOLDER / min(there(whole))).unlink()
    assert run(tmp_path).executed.episodes == 1
    assert run(tmp_path).executed.episodes == 0
    assert there(tmp_path) == there(whole)


@pytest.mark.slow
def test_a_run_killed_between_commit_and_episodes_ends_in_the_same_files(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def die(self: driver.EpisodeScheduler, paths: object) -> None:
        if paths:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(driver.EpisodeScheduler, "on_commit", die)
        with pytest.raises(Killed):
            run(tmp_path, shard_seconds=0.0)
    (tmp_path / EPISODES_FOLDER).mkdir()
    (tmp_path / EPISODES_FOLDER / ".half.mcap.0123abcd.tmp").write_bytes(b"half")
    assert len(Store(tmp_path).samples) > 0 and len(there(tmp_path)) == 1
    assert run(tmp_path).exit_code == COMPLETE
    assert there(tmp_path) == there(whole)


@pytest.mark.slow
def test_an_episode_that_cannot_be_written_costs_no_other_and_the_same_command_writes_it(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, bad = Location.write, min(there(whole))

    def full(self: Location, name: str, data: bytes) -> None:
        if name == bad:
            raise OSError("no space left")
        real(self, name, data)

    with monkeypatch.context() as patch:
        patch.setattr(Location, "write", full)
        summary = run(tmp_path)
    assert summary.exit_code == INTERRUPTED and "no space left" in summary.message
    assert run(tmp_path).executed.attempts == 0
    assert there(tmp_path) == there(whole)


@pytest.mark.slow
def test_a_redo_leaves_the_episodes_of_the_rows_that_are_there(tmp_path: Path) -> None:
    run(tmp_path)
    before = there(tmp_path)
    (tmp_path / EPISODES_FOLDER / "notes.txt").write_text("a user's own")
    run(tmp_path, work=FilmedWork(threshold=0.4, prepare_digest="perturb-2"), on_change="redo")
    after = there(tmp_path)
    assert after.pop("notes.txt") == b"a user's own"
    assert set(after) == asked_for(tmp_path) and not set(after) & set(before)


@pytest.mark.slow
def test_episodes_of_clips_that_are_not_in_the_run_are_left_alone(whole: Path, tmp_path: Path) -> None:
    run(tmp_path)
    assert run(tmp_path, every=2, n=1).executed.episodes == 0
    assert there(tmp_path) == there(whole)


@pytest.mark.parametrize(("text", "every"), [("none", 0), ("all", 1), ("1", 1), ("12", 12)])
def test_the_setting(text: str, every: int) -> None:
    assert load_config([f"episodes={text}"]).one_episode_in == every


@pytest.mark.parametrize("text", ["0", "-2", "some", "1.5"])
def test_a_setting_that_says_nothing_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="episodes"):
        load_config([f"episodes={text}"])


@pytest.mark.slow
def test_verify_finds_every_flipped_bit_of_an_episode_and_tells_outdated_ones(whole: Path, tmp_path: Path) -> None:
    run(tmp_path)
    assert verify(Store(tmp_path)).damage == () and verify(Store(tmp_path)).orphans == ()
    path = tmp_path / EPISODES_FOLDER / min(there(whole))
    data = path.read_bytes()
    for at in range(8, len(data) - 8, len(data) // 40):
        flipped = bytearray(data)
        flipped[at] ^= 4
        path.write_bytes(flipped)
        assert [path.name in line for line in verify(Store(tmp_path)).damage] == [True], f"byte {at} of {len(data)}"
    path.write_bytes(data[: len(data) // 2])
    assert len(verify(Store(tmp_path)).damage) == 1
    path.rename(path.with_name(path.name.replace(path.name[:4], "0000")))
    verdict = verify(Store(tmp_path))
    assert verdict.damage == () and len(verdict.orphans) == 1
