"""Decoded pictures on disk: equal to the last bit, of their content alone, bounded, whole whoever writes them."""

import multiprocessing
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planners.data.batch import ImageLayout, Needs
from planners.data.images import CHECKSUM_BYTES, GB, PARTS, PictureCache, picture_key, stitch
from planners.data.index import DataSettings, open_data
from planners.data.loader import Loader
from planners.data.mix import MixSettings
from tasks.world.arrays import Bytes
from tests.planners.samples import Pixels, grey_pictures, jpeg, plain, sample, write_table

LAYOUT = ImageLayout(width=48, height=12)
ENTRY_BYTES = 48 * 12 * 3 + CHECKSUM_BYTES
SAMPLES = 40


def views(number: int) -> list[Bytes]:
    """Three JPEGs of one sample; no two samples have the same."""
    rng = np.random.default_rng(number)
    shades = [plain(tuple(rng.integers(0, 256, 3).tolist()), 64, 36) for _ in range(3)]
    return [np.frombuffer(jpeg(shade), np.uint8) for shade in shades]


def decoded(jpegs: Sequence[Bytes], kept: PictureCache | None = None, layout: ImageLayout = LAYOUT) -> Pixels:
    picture = np.full((layout.height, layout.width, 3), 99, np.uint8)
    (stitch if kept is None else kept.stitch)(jpegs, layout, picture)
    return picture


def entry_of(kept: PictureCache, jpegs: Sequence[Bytes], layout: ImageLayout = LAYOUT) -> Path:
    key = picture_key(jpegs, layout)
    return kept.folder / key[:2] / f"{key[2:]}.rgb"


@pytest.fixture
def kept(tmp_path: Path) -> PictureCache:
    return PictureCache(tmp_path / "pictures", limit_gb=1.0)


@pytest.fixture
def no_decoder(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of what was asked of the decoder after all."""
    asked: list[str] = []
    monkeypatch.setattr("planners.data.images.stitch", lambda *given: asked.append("stitch"))
    return asked


def test_a_kept_picture_is_the_decoded_one_and_is_not_decoded_again(
    kept: PictureCache, no_decoder: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("planners.data.images.stitch", stitch)
        assert (decoded(views(0), kept) == decoded(views(0))).all()
    assert (decoded(views(0), kept) == decoded(views(0))).all() and not no_decoder
    assert (decoded(views(1), kept) == 99).all() and no_decoder == ["stitch"]


def test_other_content_or_another_layout_is_another_picture(kept: PictureCache) -> None:
    """Whatever the pixels depend on is in the name; the names of cameras are not."""
    left, front, right = views(0)
    changed = front.copy()
    changed[-30] ^= 1
    layouts = [replace(LAYOUT, **change) for change in ({"rows_cut": 0.1}, {"sides_cut": 0.1}, {"decoding": "full"})]
    names = {picture_key([left, front, right], layout) for layout in (LAYOUT, *layouts)}
    names |= {picture_key(jpegs, LAYOUT) for jpegs in ([left, changed, right], [right, front, left], [left, front])}
    whole = np.concatenate([left, front])
    names |= {picture_key([whole[:i], whole[i:], right], LAYOUT) for i in (100, len(left) + 1)}
    assert len(names) == 9
    assert picture_key([left, front, right], replace(LAYOUT, cameras=("a", "b", "c"))) in names
    for layout in (LAYOUT, *layouts):
        assert (decoded(views(0), kept, layout) == decoded(views(0), None, layout)).all()
        assert (decoded(views(0), kept, layout) == decoded(views(0), None, layout)).all()


@pytest.mark.parametrize("damage", ["a bit", "short", "long", "empty", "of another"])
def test_a_damaged_entry_is_made_again(kept: PictureCache, damage: str, no_decoder: list[str]) -> None:
    path = entry_of(kept, views(0))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("planners.data.images.stitch", stitch)
        decoded(views(0), kept)
        whole = path.read_bytes()
        decoded(views(1), kept)
        other = entry_of(kept, views(1)).read_bytes()
        bit = bytes([*whole[:500], whole[500] ^ 4, *whole[501:]])
        broken = {"a bit": bit, "short": whole[:-5], "long": whole + b"\0", "empty": b"", "of another": other}
        path.write_bytes(broken[damage])
        assert (decoded(views(0), kept) == decoded(views(0))).all()
        assert path.read_bytes() == whole
    assert (decoded(views(0), kept) == decoded(views(0))).all() and not no_decoder


def test_the_folder_never_takes_more_than_its_limit(tmp_path: Path) -> None:
    """Two entries fit into each of its 256 parts, and what finds its part full is decoded, to the same pixels."""
    kept = PictureCache(tmp_path, limit_gb=2.5 * PARTS * ENTRY_BYTES / GB)
    keys = [picture_key(views(number), LAYOUT)[:2] for number in range(700)]
    for number in range(700):
        if keys.count(keys[number]) >= 4:
            assert (decoded(views(number), kept) == decoded(views(number))).all()
    entries = [path.parent.name for path in tmp_path.rglob("*.rgb")]
    assert entries and {entries.count(part) for part in set(entries)} == {2}
    assert kept.held_bytes() == len(entries) * ENTRY_BYTES
    assert all((decoded(views(i), kept) == decoded(views(i))).all() for i in range(700) if keys[i] == entries[0])


def test_a_limit_for_less_than_a_picture_in_each_part_is_refused(tmp_path: Path) -> None:
    PictureCache(tmp_path, limit_gb=0.81).check(ImageLayout())
    with pytest.raises(ValueError, match=r"data.pictures_gb=0.8: pictures of 2048 x 512 need at least 0.81, 256 of"):
        PictureCache(tmp_path, limit_gb=0.8).check(ImageLayout())
    with pytest.raises(ValueError, match=r"data.pictures=s3://b: must be a folder of this machine"):
        DataSettings(pictures="s3://b")


def test_the_draft_of_a_killed_process_is_in_nobodys_way(kept: PictureCache) -> None:
    path = entry_of(kept, views(0))
    path.parent.mkdir(parents=True)
    (path.parent / "draft").write_bytes(b"half a picture" * 1000)
    assert (decoded(views(0), kept) == decoded(views(0), kept)).all()
    assert path.stat().st_size == ENTRY_BYTES and not (path.parent / "draft").exists()


def _decode_all(folder: str, rounds: int) -> None:
    """One process of several, in an order of its own; wrong pixels end it."""
    kept = PictureCache(Path(folder), limit_gb=1.0)
    for seed in range(rounds):
        for number in np.random.default_rng(seed).permutation(12).tolist():
            if not (decoded(views(number), kept) == decoded(views(number))).all():
                raise SystemExit(f"picture {number} is wrong")


def test_processes_share_a_folder(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    several = [context.Process(target=_decode_all, args=(str(tmp_path), 2)) for _ in range(3)]
    for process in several:
        process.start()
    for process in several:
        process.join()
    assert [process.exitcode for process in several] == [0, 0, 0]
    entries = sorted(path.name for path in tmp_path.rglob("*") if path.is_file() and path.name != "lock")
    assert entries == sorted(f"{picture_key(views(number), LAYOUT)[2:]}.rgb" for number in range(12))


def test_batches_are_the_same_with_and_without(tmp_path: Path, no_decoder: list[str]) -> None:
    """In the first pass, in the second and in another process's loader, from memory or read in windows."""
    out = str(tmp_path / "table")
    write_table(tmp_path / "table", [sample(i, **grey_pictures(3 * i)) for i in range(SAMPLES)], group_rows=4)
    plain_data, needs = open_data(DataSettings(real=out)), Needs(image=LAYOUT)
    data = open_data(DataSettings(real=out, pictures=str(tmp_path / "pictures"), pictures_gb=1.0))
    mix = MixSettings(shuffle_mb=1)
    expected = [batch.image for batch in Loader(plain_data, needs, mix, 8, workers=3).epoch(0)]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("planners.data.images.stitch", stitch)
        first = Loader(data, needs, mix, 8, workers=3)
        for batch, image in zip(first.epoch(0), expected, strict=True):
            assert batch.image is not None and image is not None and batch.image.equal(image)
    second = Loader(data, needs, mix, 8, workers=3)
    assert f"decoded pictures: 0.0 of at most 1 GB in {tmp_path / 'pictures'}" in second.text()
    for batch, image in zip(second.epoch(0), expected, strict=True):
        assert batch.image is not None and image is not None and batch.image.equal(image)
    assert not no_decoder
