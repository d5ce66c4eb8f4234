"""A user's own reader and expert, in a folder outside the package, named by `_target_` alone."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.config.run import load_config
from factory.graph.steps import PreparedClip, RejectedAttempt, SampleColumns, run_attempt
from factory.readers.base import BadClip
from factory.setup.settings import Run, assemble
from factory.store.schema import BOOKKEEPING, sample_rows_to_table
from tasks.stages import Rejected

PLUGIN = '''
"""Somebody's own package: one log as a clip, and an expert that rolls on at its speed."""
from dataclasses import replace

import numpy as np

from factory.readers.base import BadClip, ClipIndex, ClipRef
from tasks.experts.protocol import Plan
from tasks.stages import Rejected
from tests.tasks.streets import street_clip


class MyReader:
    name = "mine"

    def __init__(self, root, n=2, blocks=True):
        self.root, self.n, self.blocks = root, n, blocks

    def index(self):
        return ClipIndex(tuple(ClipRef(self.name, "log", 1000 * i) for i in range(self.n)), dropped={"rain": 3})

    def read(self, ref):
        if ref.start_ms == 1000:
            raise BadClip(f"{self.root}/log", "x", "holds NaN")
        street = street_clip()
        road_map = street.road_map if self.blocks else replace(street.road_map, roadblock_of={})
        return replace(street, clip_id=ref.clip_id, dataset=self.name, log_id=ref.log_id, road_map=road_map)


class RollOn:
    name = "roll_on"

    def __init__(self, gain=1.0, stubborn=False):
        self.gain, self.stubborn = gain, stubborn

    def digest(self):
        return f"{self.gain} {self.stubborn}"

    def plan(self, scene, rng):
        if self.gain < 0.0:
            raise ValueError(f"gain is {self.gain}\\nand I only drive ahead")
        if self.stubborn:
            return Rejected("expert", "no_plan", "will not")
        x, y, heading, speed = scene.ego_state[:4]
        way = self.gain * speed * 0.1 * np.arange(1, 41)
        ahead = np.exp(-way / 15.0)  # turns back to the lane's direction and middle
        return Plan(np.stack([x + way, y * ahead, np.arctan(-y * ahead / 15.0)], axis=1))
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (tmp_path / "somebody").mkdir()
    (tmp_path / "somebody" / "__init__.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("somebody", None)


def words(package: Path, *overrides: str) -> list[str]:
    """The user's own reader and expert on the command line."""
    return [
        "clips=custom",
        "clips._target_=somebody.MyReader",
        f"+clips.root={package}",
        "+expert.mine._target_=somebody.RollOn",
        "experts=[mine,human]",
        "vocabulary.k=150",
        f"out={package}/out",
        *overrides,
    ]


def assembled(package: Path, *overrides: str) -> Run:
    """A run of them."""
    return assemble(load_config(words(package, *overrides)))


def test_my_reader_and_my_expert_make_samples(package: Path) -> None:
    run = assembled(package)
    assert run.reader.name == "mine"
    assert run.index.dropped == {"rain": 3}
    prepared = run.work.prepare(run.index.refs[0])
    assert isinstance(prepared, PreparedClip)
    results = [run_attempt(run.work, prepared, candidate.index, "mine") for candidate in prepared.candidates]
    rows = [result.row for result in results if isinstance(result, SampleColumns)]
    assert rows, [result.rejected for result in results if isinstance(result, RejectedAttempt)]
    rows.append(run_attempt(run.work, prepared, -1, "human").row)  # type: ignore[union-attr]
    books = dict.fromkeys(BOOKKEEPING, "x") | {"round": 0, "candidate_index": 0}
    table = sample_rows_to_table([dict(row) | books for row in rows])
    assert set(table["dataset"].to_pylist()) == {"mine"}
    assert set(table["image_source"].to_pylist()) == {"none"}, "no cameras, no images, and it is said"
    # What the row calls the proposal is what my expert asked for.
    proposal = np.asarray(rows[0]["proposal_10hz"])
    assert proposal.shape == (40, 3)
    np.testing.assert_allclose(proposal[:, 0], proposal[0, 0] * np.arange(1, 41), rtol=0.02, atol=0.2)


def test_my_reader_s_bad_clip_is_reported_by_file_and_field(package: Path) -> None:
    run = assembled(package)
    with pytest.raises(BadClip, match="log: x: holds NaN"):
        run.work.prepare(run.index.refs[1])


def test_a_map_without_roadblocks_is_reported_before_anything_is_computed(package: Path) -> None:
    run = assembled(package, "+clips.blocks=false")
    with pytest.raises(BadClip, match=r"clip \w{16} \(mine log at 0 s\): road_map.roadblock_of: has no roadblock of"):
        run.work.prepare(run.index.refs[0])


def test_my_expert_s_refusal_is_a_rejection(package: Path) -> None:
    run = assembled(package, "+expert.mine.stubborn=true")
    prepared = run.work.prepare(run.index.refs[0])
    assert isinstance(prepared, PreparedClip)
    result = run_attempt(run.work, prepared, 0, "mine")
    assert isinstance(result, RejectedAttempt)
    assert result.rejected == Rejected("expert", "no_plan", "will not")
    assert result.subscores == {}


def test_my_expert_s_settings_are_in_its_digest_and_nothing_else_changes(package: Path) -> None:
    run, faster = assembled(package), assembled(package, "+expert.mine.gain=1.1")
    assert run.work.expert_digest("mine") != faster.work.expert_digest("mine")
    assert run.work.identity == faster.work.identity


def test_arguments_my_reader_does_not_take_are_refused_by_name(package: Path) -> None:
    with pytest.raises(ConfigError, match=r"(?s)clips: .*colour"):
        assembled(package, "+clips.colour=red")
