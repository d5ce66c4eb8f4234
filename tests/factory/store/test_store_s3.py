"""The same store behind an object-store URL, against a local S3 server."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from factory.graph.driver import EpisodeSettings
from factory.graph.execute import Execution
from factory.store.location import BadLocation, Location
from factory.store.reader import SampleTable
from factory.store.samples import Store
from factory.store.verify import verify
from factory.views.board.server import Board
from factory.views.sample_text import prepared_episode
from tests.chaos.buckets.bad_store import BUCKET, credentials, moto_server
from tests.factory.filmed import FilmedWork
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork, executed, refs


@pytest.fixture(scope="module")
def s3() -> Iterator[dict[str, str]]:
    """Storage options of a server in its own process: in a thread of this one it would wait for deltalake's lock."""
    pytest.importorskip("boto3")
    with moto_server() as url:
        yield credentials(url)


@pytest.mark.slow
def test_a_bucket_holds_the_same_rows_as_a_folder(s3: dict[str, str], tmp_path: Path) -> None:
    url = f"s3://{BUCKET}/runs/one"
    for rounds in (1, 3):
        for out in (Store(url, s3), Store(tmp_path)):
            summary = executed(ToyWork(), refs(3), ["recovery", "human"], rounds, out)
            assert summary.exit_code == 0
    assert summary.executed.prepared == 0
    assert_same_tables(Location.parse(url, s3), tmp_path)
    assert verify(Store(url, s3)).damage == () and verify(Store(url, s3)).orphans == ()
    samples = SampleTable(url, s3)
    assert samples[0]["label_10hz"].shape == (40, 3) and len(samples) == len(SampleTable(tmp_path))


@pytest.mark.slow
def test_a_bucket_holds_the_same_episodes_as_a_folder_and_makes_up_for_lost_ones(
    s3: dict[str, str], tmp_path: Path
) -> None:
    url, how = f"s3://{BUCKET}/runs/filmed", Execution("local", episodes=EpisodeSettings(1, prepared_episode))
    for out in (Store(url, s3), Store(tmp_path)):
        executed(FilmedWork(), refs(2), ["recovery"], 1, out, how)
    there, here = Location.parse(url, s3).child("episodes"), Location.parse(tmp_path).child("episodes")
    names = here.names()
    assert names and there.names() == names
    assert [there.read(name) for name in names] == [here.read(name) for name in names]
    there.remove(names[0])
    again = executed(FilmedWork(), refs(2), ["recovery"], 1, Store(url, s3), how)
    assert again.executed.episodes == 1 and there.read(names[0]) == here.read(names[0])


@pytest.mark.slow
def test_the_dashboard_follows_a_run_in_a_bucket(s3: dict[str, str]) -> None:
    url = f"s3://{BUCKET}/runs/two"
    board = None
    for rounds in (1, 2):
        out = Store(url, s3)
        assert executed(ToyWork(), refs(2), ["recovery"], rounds, out).exit_code == 0
        board = board or Board(Store(url, s3), look_every_s=0.0)
        assert json.loads(board.answer("/api/overview").body)["counts"]["samples"] == len(out.samples)
    (item,) = json.loads(board.answer("/api/samples?size=1").body)["items"]
    for target in (f"/api/samples/{item['attempt_id']}", f"/picture/{item['attempt_id']}/bev.jpg"):
        assert board.answer(target).status == 200


@pytest.mark.parametrize("url", ["gopher://bucket/run", "S3://bucket/run", "://run"])
def test_an_unknown_kind_of_url_is_refused(url: str) -> None:
    with pytest.raises(BadLocation, match="a URL of s3, "):
        Location.parse(url)


def test_a_relative_path_inside_a_submitted_job_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Location.parse("runs/x").uri.startswith("/")
    monkeypatch.setenv("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")
    with pytest.raises(BadLocation, match="absolute path or a URL"):
        Location.parse("runs/x")
    assert Location.parse("/data/x").uri == "/data/x"
