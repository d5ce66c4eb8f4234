"""Plans among the answering traffic of real logs get the factory's own scores from a bank; make long: on every clip."""

from pathlib import Path

import pytest

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import ClipReader
from factory.setup.bank import write_bank
from tasks.bank import SceneBank
from tests.tasks.test_bank import plans
from tests.tasks.test_bank_traffic import IDM, expect_the_factory_s


@pytest.fixture(params=["av2", "nuscenes"])
def reader(request: pytest.FixtureRequest, shared_root: Path) -> ClipReader:
    data = shared_root / "data"
    if request.param == "av2":
        return AV2Reader(data / "av2" / "sensor" / "val")
    return ScenarioNetReader(data / "scenarionet" / "nuscenes")


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.long)])
def test_plans_among_recorded_cars_get_the_factory_s_scores(reader: ClipReader, every: int, tmp_path: Path) -> None:
    assert write_bank(tmp_path, reader, traffic=IDM) == {}
    bank, poses = SceneBank(tmp_path), plans(3, 5)
    for ref in reader.index().refs[::every]:
        expect_the_factory_s(bank, [reader.read(ref)], poses)
    ids, many = bank.clip_ids, poses[None].repeat(len(bank), 0)
    assert (bank.score(ids, many).score != bank.score(ids, many, traffic="idm").score).any()
