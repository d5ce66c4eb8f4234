"""Which samples there are to learn from, and what is refused before the first batch."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.store.reader import SampleTable
from factory.store.samples import Store
from planners.data.batch import ImageLayout, Needs
from planners.data.index import Dataset, DataSettings, make_feed, open_data
from planners.data.mix import MixSettings
from tests.planners.samples import FRONT_YAWS, grey_pictures, jpeg, pictures, plain, sample, write_table

PICTURE = Needs(image=ImageLayout(width=48, height=12))
N_CLIPS, ROUNDS = 10, 3


def town() -> list[dict[str, Any]]:
    """Ten clips, a human row each; three rounds of two experts, pictures of 20 + round dB."""
    rows = [sample(clip) for clip in range(N_CLIPS)]
    for i, expert in enumerate(("recovery", "pdm_closed")):
        for round_ in range(ROUNDS):
            for clip in range(N_CLIPS):
                number = 100 + 100 * i + 10 * round_ + clip
                rows.append(sample(number, expert, round_, clip, psnr=20.0 + round_))
    return rows


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("town") / "out"
    write_table(path, town(), shard_rows=7, group_rows=3)
    return str(path)


def opened(out: str, **settings: Any) -> Dataset:
    return open_data(DataSettings(real=out, sim=(out,), **settings))


def test_one_table_serves_both_sides(out: str) -> None:
    both = opened(out)
    assert both.rows.attempt_id.tolist() == sorted(SampleTable(out).attempt_ids)
    assert (both.rows.simulated == (both.rows.expert != "human")).all() and both.rows.simulated.sum() == 60
    real, sim = open_data(DataSettings(real=(out,))), open_data(DataSettings(sim=out))
    assert not real.rows.simulated.any() and len(real) == 10
    assert sim.rows.simulated.all() and len(sim) == 60
    assert real.label_vocabulary == "vocabulary-1" and len({real.digest, sim.digest, both.digest}) == 3


@pytest.mark.slow
def test_the_index_is_what_the_rows_say(out: str) -> None:
    data = opened(out)
    for i, one in enumerate(SampleTable(out)[key] for key in data.rows.attempt_id.tolist()):
        assert (data.rows.clip_id[i], data.rows.round[i], data.rows.expert[i]) == (
            one["clip_id"],
            one["round"],
            one["expert"],
        )
    labels = {one["attempt_id"]: one["label_2hz"] for one in SampleTable(out)}
    assert np.array_equal(data.labels_2hz(), [labels[key] for key in data.rows.attempt_id.tolist()])
    assert "recovery: 30 (10 of round 0, 10 of round 1, 10 of round 2)" in data.text()


def test_plans_to_learn_from_are_found_in_every_shard_and_row_group(tmp_path: Path) -> None:
    """A sample's plan is its number; shards of 7 rows in row groups of 3, the samples' order not that of the file."""
    numbers = np.random.default_rng(0).permutation(20)
    plans = np.broadcast_to(numbers[:, None, None], (20, 8, 3)).astype(np.float32)
    rows = [sample(int(n), label_2hz=plan) for n, plan in zip(numbers, plans)]
    write_table(tmp_path / "out", rows, shard_rows=7, group_rows=3)
    data = open_data(DataSettings(real=str(tmp_path / "out")))
    assert data.rows.group.max() == 2 and len(data.files) == 3
    assert data.labels_2hz()[:, 4, 1].tolist() == list(range(20))


@pytest.mark.parametrize(
    ("settings", "count", "kept"),
    [
        ({"max_round": 0}, 20, lambda rows: rows.round == 0),
        ({"experts": ("recovery",)}, 30, lambda rows: rows.expert == "recovery"),
        ({"psnr_min": 21.0}, 40, lambda rows: rows.psnr >= 21.0),
        ({"psnr_max": 21.0}, 20, lambda rows: rows.psnr < 21.0),
        ({"limit_sim": 17}, 17, None),
    ],
)
def test_filters_are_of_the_simulated_samples(out: str, settings: dict[str, Any], count: int, kept: Any) -> None:
    rows = opened(out, **settings).rows
    assert (~rows.simulated).sum() == N_CLIPS and rows.simulated.sum() == count
    assert kept is None or kept(rows.select(rows.simulated)).all()


def test_a_share_of_the_real_clips_takes_their_simulated_samples_with_it(out: str) -> None:
    shares = [opened(out, real_share=share).rows for share in (0.3, 0.5, 1.0)]
    clips = [set(rows.clip_id[~rows.simulated].tolist()) for rows in shares]
    assert [len(c) for c in clips] == [3, 5, 10] and clips[0] < clips[1] < clips[2]
    for rows, kept in zip(shares, clips):
        assert set(rows.clip_id[rows.simulated].tolist()) == kept and rows.simulated.sum() == 6 * len(kept)
    other = opened(out, real_share=0.5, seed=1).rows
    assert set(other.clip_id.tolist()) != clips[1]


def test_a_limit_draws_the_same_samples_and_a_smaller_one_a_part_of_them(out: str) -> None:
    few, many = (set(opened(out, limit_sim=n).rows.attempt_id.tolist()) for n in (10, 20))
    assert few < many and few == set(opened(out, limit_sim=10).rows.attempt_id.tolist())
    assert few != set(opened(out, limit_sim=10, seed=1).rows.attempt_id.tolist())


def test_the_digest_is_of_the_samples_not_of_their_files(out: str, tmp_path: Path) -> None:
    write_table(tmp_path / "other", town())
    assert opened(str(tmp_path / "other")).digest == opened(out).digest
    remade = [row | {"settings_hash": "settings-2"} for row in town()]
    write_table(tmp_path / "remade", remade)
    assert opened(str(tmp_path / "remade")).digest != opened(out).digest


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_round": -1}, "data.max_round=-1 leaves no simulated samples"),
        (
            {"experts": ("recovry",)},
            r"no simulated samples of recovry; there are those of \['pdm_closed', 'recovery'\]",
        ),
        ({"psnr_min": 30.0}, "data.psnr_min=30.0 leaves no simulated"),
        ({"limit_sim": 61}, "limit_sim=61, but there are 60"),
    ],
)
def test_a_filter_that_leaves_nothing_is_named(out: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        opened(out, **settings)


def test_settings_that_make_no_sense_are_refused() -> None:
    for wrong in ({"real_share": 0.0}, {"real_share": 1.5}, {"limit_sim": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            DataSettings(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"give data\.real"):
        open_data(DataSettings())


def test_tables_that_hold_nothing_wanted_are_named(out: str, tmp_path: Path) -> None:
    write_table(tmp_path / "human", [sample(1000)])
    write_table(tmp_path / "sim", [sample(1001, "recovery")])
    with pytest.raises(ValueError, match=f"data.sim: no simulated samples in {tmp_path}/human"):
        open_data(DataSettings(sim=(out, str(tmp_path / "human"))))
    with pytest.raises(ValueError, match=f"data.real: no samples with expert=human in {tmp_path}/sim"):
        open_data(DataSettings(real=str(tmp_path / "sim")))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        open_data(DataSettings(real=str(tmp_path / "nowhere")))
    with pytest.raises(ValueError, match="twice"):
        open_data(DataSettings(sim=(out, out)))


def test_a_sample_in_two_tables_is_named_with_both(out: str, tmp_path: Path) -> None:
    write_table(tmp_path / "copy", [sample(105, "recovery", 0, 5), sample(2000, "recovery")])
    with pytest.raises(ValueError, match=f"attempt00105 and 0 more stand twice, in {out} and {tmp_path}/copy"):
        open_data(DataSettings(sim=(out, str(tmp_path / "copy"))))


def test_a_table_of_another_version_is_named(tmp_path: Path) -> None:
    write_table(tmp_path, [sample(0)])
    Store(tmp_path).samples.set_property("factory.schema_version", "1")
    with pytest.raises(ValueError, match=f"{tmp_path}.*schema_version 1, this version reads and writes 7"):
        open_data(DataSettings(real=str(tmp_path)))


def test_an_image_planner_refuses_samples_without_images_by_name(out: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"{out}: sample attempt00000 and 69 more are without images.*render=auto"):
        make_feed(open_data(DataSettings(real=out, sim=out)), PICTURE)
    write_table(tmp_path, [sample(0, **grey_pictures(9)), sample(1)])
    with pytest.raises(ValueError, match="sample attempt00001 is without images"):
        make_feed(open_data(DataSettings(real=str(tmp_path))), PICTURE)


def test_cameras_that_are_missing_are_refused_by_name(tmp_path: Path) -> None:
    views = dict.fromkeys(FRONT_YAWS, jpeg(plain((1, 2, 3))))
    two = {name: views[name] for name in ("front", "left")}
    write_table(tmp_path / "a", [sample(0, **pictures(views)), sample(1, **pictures(two))])
    data = open_data(DataSettings(real=str(tmp_path / "a")))
    with pytest.raises(ValueError, match=rf"{tmp_path}/a: sample attempt00001: no image of camera right at now"):
        make_feed(data, PICTURE)
    with pytest.raises(ValueError, match=r"attempt00000: no camera rear \(image\.cameras\); there are"):
        make_feed(data, Needs(image=ImageLayout(cameras=("rear",))))
    rigs = make_feed(data, Needs(image=ImageLayout(cameras=("front",)))).cameras
    assert rigs == (("front",), ("front",))


def test_samples_without_a_wanted_camera_that_was_too_poor_are_left_out_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    views = dict.fromkeys(FRONT_YAWS, jpeg(plain((1, 2, 3))))
    rig = pictures(views)
    without = rig | {
        "images": [image for image in rig["images"] if image["camera"] != "right"],
        "cameras_left_out": [{"camera": "right", "why": "19.30 dB, below 20"}],
    }
    write_table(tmp_path, [sample(0, **rig), sample(1, **without)])
    data = open_data(DataSettings(real=str(tmp_path)))
    feed = make_feed(data, PICTURE)
    assert feed.dataset.rows.attempt_id.tolist() == ["attempt00000"] and len(feed.cameras) == len(feed.size) == 1
    assert "left out 1 of 2 samples: their block shows a camera of the picture too poorly" in caplog.text
    assert len(make_feed(data, Needs(image=ImageLayout(cameras=("front",)))).cameras) == 2
    with pytest.raises(ValueError, match=r"2 of 2 samples: .* planner.settings.image\.cameras=\[\.\.\.\] names others"):
        write_table(tmp_path / "poor", [sample(0, **without), sample(1, **without)])
        make_feed(open_data(DataSettings(real=str(tmp_path / "poor"))), PICTURE)


def test_labels_that_are_missing_or_of_another_vocabulary_are_refused_by_name(tmp_path: Path) -> None:
    none = dict.fromkeys(("label_vocabulary", "label_traffic", "label_reference_progress_m"))
    none |= dict.fromkeys(("label_subscores", "label_progress"))
    rows = [sample(0), sample(1, "recovery", **none), sample(2, "recovery", label_vocabulary="vocabulary-2")]
    needs = Needs(labels="vocabulary-1")
    for number, message in ((1, "without labels"), (2, "with labels of vocabulary vocabulary-2")):
        write_table(tmp_path / str(number), [rows[0], rows[number]])
        table = str(tmp_path / str(number))
        with pytest.raises(ValueError, match=rf"{table}: sample attempt0000{number} is {message}.* vocabulary-1"):
            make_feed(open_data(DataSettings(real=table, sim=table)), needs)
    write_table(tmp_path / "all", rows)
    mixed = open_data(DataSettings(real=str(tmp_path / "all"), sim=str(tmp_path / "all")))
    assert mixed.label_vocabulary == "vocabulary-1 and vocabulary-2 (1 of 3 samples without)"
    assert mixed.training_data().label_vocabulary == mixed.label_vocabulary
    write_table(tmp_path / "bare", [sample(0, **none)])
    assert open_data(DataSettings(real=str(tmp_path / "bare"))).label_vocabulary is None


def test_a_mix_that_the_samples_do_not_allow_is_refused(out: str) -> None:
    with pytest.raises(ValueError, match=r"sim_ratio=0\.5 needs real and simulated.*no simulated ones"):
        open_data(DataSettings(real=out), mix=MixSettings(sim_ratio=0.5))
    with pytest.raises(ValueError, match="n_agents=3"):
        make_feed(open_data(DataSettings(real=out)), Needs(n_agents=3))
