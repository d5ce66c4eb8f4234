"""A bank's scores are those of the scenes that were put into it, to the last bit."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.csv_logs import CsvReader, write_log
from factory.setup.bank import PackedScene, write_bank, write_scenes
from tasks.bank import BankScores, SceneBank, _score_packed, pack_prepared
from tasks.caches import Damaged
from tasks.reward.epdms import PreparedScene, Scores, prepare, score
from tasks.reward.packing import packed, unpacked
from tasks.rollout.lqr import track
from tasks.subscores import OF_ONE_PLAN
from tasks.trajectories import score_trajectories
from tests.tasks.reward.random_worlds import random_world

ROOT = Path(__file__).resolve().parents[2]
SEEDS = range(24)


def plans(seed: int, count: int, steps: int = 40) -> np.ndarray:
    """Swerving ones of all speeds, a few far off the map."""
    rng = np.random.default_rng(seed)
    speed, turn = rng.uniform(-1.0, 15.0, (count, 1)), rng.normal(0.0, 0.3, (count, 1))
    speed[rng.random(count) < 0.05] = 200.0
    t = 4.0 / steps * np.arange(1, steps + 1)
    heading = turn * t
    return np.stack([speed * t * np.cos(heading / 2), speed * t * np.sin(heading / 2), heading], axis=-1)


@pytest.fixture(scope="module")
def worlds() -> dict[str, tuple[PreparedScene, np.ndarray]]:
    made = {str(seed): random_world(seed) for seed in SEEDS}
    return {name: (prepare(**world), world["past_states"][-1]) for name, world in made.items()}


@pytest.fixture(scope="module")
def bank(worlds: dict[str, tuple[PreparedScene, np.ndarray]], tmp_path_factory: pytest.TempPathFactory) -> SceneBank:
    folder = tmp_path_factory.mktemp("bank")
    scenes = [(name, PackedScene(pack_prepared(*world, reference_m=7.0))) for name, world in worlds.items()]
    write_scenes(folder / "scenes-00000.json", dict(scenes[:10]), {})
    write_scenes(folder / "scenes-00001.json", dict(scenes[10:]), {})
    return SceneBank(folder)


def expect_equal(bank: SceneBank, got_of: np.ndarray, score_of: np.ndarray, want: Scores) -> None:
    for i, name in enumerate(OF_ONE_PLAN):
        assert np.array_equal(got_of[:, i], getattr(want, name)), name
    assert np.array_equal(score_of, want.pdm_score)


@pytest.mark.parametrize("count", [1, 33, 300])
def test_random_worlds_get_the_scores_of_a_batch(
    bank: SceneBank, worlds: dict[str, tuple[PreparedScene, np.ndarray]], count: int
) -> None:
    names = [str(seed) for seed in SEEDS][:: 1 if count < 300 else 6]
    poses = np.stack([plans(int(name), count) for name in names])
    got = bank.score(names, poses, reference="batch", threads=1)
    assert np.array_equal(got.score, bank.score(names, poses, reference="batch", threads=3).score)
    for b, name in enumerate(names):
        prepared, ego = worlds[name]
        want = score(prepared, track(ego, poses[b], local=True))
        expect_equal(bank, got.subscores[b], got.score[b], want)


def test_a_reader_s_clips_get_the_scores_of_trajectories(tmp_path: Path) -> None:
    for log in ("one", "two"):
        write_log(tmp_path / "logs" / log)
    reader = CsvReader(tmp_path / "logs")
    refs = reader.index().refs
    (tmp_path / "logs" / "two" / "ego.csv").write_text("broken")
    left = write_bank(tmp_path / "bank", reader, refs)
    assert left and set(left) == {ref.clip_id for ref in refs if ref.log_id == "two"}
    bank = SceneBank(tmp_path / "bank")
    assert bank.clip_ids == tuple(ref.clip_id for ref in refs if ref.log_id == "one")
    for steps in (8, 40):
        poses = plans(0, 20, steps)
        got = bank.score(bank.clip_ids[:1], poses[None].astype(np.float32))
        want = score_trajectories(reader.read(refs[0]), poses.astype(np.float32))
        expect_equal(bank, got.subscores[0], got.score[0], want)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "bank").iterdir()}
    assert write_bank(tmp_path / "bank", reader, refs) == left, "goes on, here at the end"
    assert written == {path: path.stat().st_mtime_ns for path in (tmp_path / "bank").iterdir()}
    with pytest.raises(Damaged, match="a bank of other clips"):
        write_bank(tmp_path / "bank", reader, refs[:1])


def test_processes_write_the_shards_of_one_and_go_on_after_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("factory.setup.bank.SHARD", 1)
    for log in ("one", "two", "three"):
        write_log(tmp_path / "logs" / log)
    reader = CsvReader(tmp_path / "logs")
    refs = reader.index().refs
    alone, together = tmp_path / "alone", tmp_path / "together"
    assert write_bank(alone, reader, refs) == write_bank(together, reader, refs, workers=2) == {}
    whole = {path.name: path.read_bytes() for path in alone.iterdir()}
    assert whole == {path.name: path.read_bytes() for path in together.iterdir()} and len(whole) == 2 * len(refs)
    kept = (together / "scenes-00000.json").stat().st_mtime_ns
    (together / "scenes-00001.json").unlink()  # killed before the head, which is written last
    (together / "scenes-00001.bank").write_bytes(b"half")
    write_bank(together, reader, refs, workers=2)
    assert whole == {path.name: path.read_bytes() for path in together.iterdir()}
    assert kept == (together / "scenes-00000.json").stat().st_mtime_ns, "what was whole is not written again"


def test_what_is_no_drive_or_no_scene_is_refused_by_name(bank: SceneBank) -> None:
    poses = np.zeros((1, 2, 8, 3))
    assert bank.score(["3"], poses[:, :0]).score.shape == (1, 0)
    with pytest.raises(KeyError, match="no scene 'x' among its 24"):
        bank.score(["x"], poses)
    with pytest.raises(ValueError, match=r"poses must be \(2, P, 40 or 8, 3\), got \(1, 2, 8, 3\)"):
        bank.score(["1", "2"], poses)
    with pytest.raises(ValueError, match=r"poses must be \(K, 40 or 8, 3\)"):
        bank.score(["1"], np.zeros((1, 2, 9, 3)))
    with pytest.raises(ValueError, match="reference must be one of"):
        bank.score(["1"], poses, reference="human")  # type: ignore[arg-type]
    poses[0, 1, 4, 0] = np.nan
    with pytest.raises(ValueError, match=r"poses\[0\] \(7\): a plan or its drive is not finite"):
        bank.score(["7"], poses)


def test_damage_is_found_before_it_is_used(worlds: dict[str, tuple[PreparedScene, np.ndarray]], tmp_path: Path) -> None:
    head, body = tmp_path / "scenes-00000.json", tmp_path / "scenes-00000.bank"
    with pytest.raises(FileNotFoundError, match="write_bank"):
        SceneBank(tmp_path)
    write_scenes(head, {"a": PackedScene(pack_prepared(*worlds["0"]))}, {})
    whole = body.read_bytes()
    body.write_bytes(whole[:99] + bytes([whole[99] ^ 1]) + whole[100:])
    with pytest.raises(Damaged, match="scene a: its checksum is another"):
        SceneBank(tmp_path).score(["a"], np.zeros((1, 1, 8, 3)))
    body.write_bytes(whole[:-1])
    with pytest.raises(Damaged, match="write the bank again"):
        SceneBank(tmp_path)
    body.write_bytes(whole)
    head.write_text(head.read_text().replace('"a"', '"b"'))
    with pytest.raises(Damaged, match=r"scenes-00000\.json"):
        SceneBank(tmp_path)


def test_bytes_of_somebody_else_are_refused_or_scored_and_never_read_beyond(
    worlds: dict[str, tuple[PreparedScene, np.ndarray]],
) -> None:
    data = np.frombuffer(pack_prepared(*worlds["1"]), np.uint8)
    rng, poses, out = np.random.default_rng(0), plans(0, 3), (np.empty((3, len(OF_ONE_PLAN))), np.empty(3))
    went = set()
    for k in range(400):
        changed = data.copy()
        at = rng.integers(0, len(data) if k % 2 else 700, 3)
        changed[at] = rng.integers(0, 256, 3)
        changed.flags.writeable = False
        went.add(_score_packed(changed, poses, False, *out))
    assert 1 in went
    assert _score_packed(data, poses, False, *out) == 0


def test_numbers_come_back_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    parts = [
        rng.normal(size=99),
        np.array([np.nan, 0.0, -0.0, np.inf, 5e-324]),
        np.array([2**63 - 1, -(2**63), 0]),
        np.empty(0),
        np.linspace(4e6, 4e6 + 9, 41),
        (rng.random(5000) < 0.02).cumsum(),  # runs of all lengths
        np.zeros(777),
    ]
    for orders in ((0, 1, 2, 0, 1, 1, 0), (2, 2, 1, 0, 2, 2, 1)):
        data = packed(parts, orders)
        values, starts = unpacked(np.frombuffer(data, np.uint8), orders)
        for part, first, last in zip(parts, starts, starts[1:]):
            assert values[first:last].tobytes() == part.tobytes()
        assert not len(unpacked(np.frombuffer(data[:-1], np.uint8), orders)[0])
    assert len(packed([np.full(1000, 3.0)], (1,))) < 40


def test_bytes_that_unpack_to_far_more_than_they_are_are_refused() -> None:
    for length, n_codes in ((2**24 + 1, 2**17), (2**62, 2**62), (1000, 3), (1000, -4)):
        data = np.array([length, n_codes], np.int64).tobytes() + b"\xff" * 2**17 + bytes(8)
        assert not len(unpacked(np.frombuffer(data, np.uint8), (1,))[0])


@pytest.mark.parametrize(
    ("dtype", "through"), [("float32", "float32"), ("float64", "float64"), ("bfloat16", "float32")]
)
def test_tensors_get_the_scores_of_the_arrays_that_they_are(bank: SceneBank, dtype: str, through: str) -> None:
    import torch

    from tasks.bank_tensors import score_tensors

    names = ["1", "2", "5"]
    made = torch.from_numpy(np.stack([plans(int(name), 40, 8) for name in names])).to(getattr(torch, dtype))
    wide = torch.nn.functional.pad(made, (0, 2)).requires_grad_()
    for asked in (made, made.clone().requires_grad_(), wide[..., :3]):  # the last one lies with gaps
        got = score_tensors(bank, names, asked, reference="batch")
        want = bank.score(names, made.to(getattr(torch, through)).numpy(), reference="batch")
        assert got.score.dtype == asked.dtype and not got.score.requires_grad
        for tensor, array in ((got.score, want.score), (got.subscores, want.subscores)):
            assert torch.equal(tensor, torch.from_numpy(array).to(getattr(torch, through)).to(asked.dtype))
    with pytest.raises(ValueError, match=r"out must be \(3, 40, 8\) and \(3, 40\)"):
        bank.score(names, made.double().numpy(), out=replace(want, score=want.score[:2]))


def test_a_tensor_s_memory_is_read_where_it_lies(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    from tasks import bank_tensors

    given: list[tuple[int, ...]] = []

    def score(clip_ids: list[str], poses: np.ndarray, *, out: BankScores, **asked: Any) -> None:
        given.append((poses.ctypes.data, out.subscores.ctypes.data, out.score.ctypes.data))

    monkeypatch.setattr(bank, "score", score)
    for dtype in (torch.float32, torch.float64):
        made = torch.zeros(2, 3, 8, 3, dtype=dtype).requires_grad_()
        found = bank_tensors.score_tensors(bank, ["1", "2"], made)
        assert given.pop() == (made.data_ptr(), found.subscores.data_ptr(), found.score.data_ptr())


def test_the_page_s_step_teaches_a_planner_to_foresee_its_scores(
    bank: SceneBank, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    shown, step = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "bank.md").read_text(), re.S)
    exec(shown, {"__name__": "read"})
    monkeypatch.chdir(bank.folder.parent)
    page: dict[str, Any] = {}
    exec(step.replace('"bank"', repr(bank.folder.name)), page)
    names, anchors = ["1", "2"], torch.from_numpy(np.stack([plans(k, 16, 8) for k in range(2)])).float()
    logits = torch.nn.Parameter(torch.zeros(2, 16, 8))
    adam = torch.optim.Adam([logits], 0.2)
    for _ in range(60):
        page["step"](lambda inputs: (inputs, logits), adam, names, anchors)
    wanted = bank.score(names, anchors.numpy()).subscores
    assert np.array_equal(page["bank"].score(names, anchors.numpy()).subscores, wanted)
    clear = wanted != 0.5
    assert (torch.sigmoid(logits).detach().numpy().round() == wanted.round())[clear].mean() > 0.95
