"""Compressed scenes: what Niantic's library writes is read, what is written is what it would write."""

import gzip
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest

from factory.views.scene_files import decompress_zstd
from tasks.render.splatting import sh
from tasks.render.splatting.formats import from_spz, to_spz
from tasks.render.splatting.gaussians import EMPTY, Gaussians, rotations_of
from tests.tasks.render.splatting.test_ply import some

# `some(3, 8, seed=5)` by spz 21715c3: loadSplatFromPly of our .ply, then saveSpz with PackOptions.from = RDF.
PUBLIC = {
    2: "H4sIAAAAAAAAA/NzDw5gYmBgYAZiJh4GBg6Tf//+/5k37//kA390NRgi9Zg+Xvxn94ohJYxxK3NjeXjGyvSAWZUr4ha79yyMXLLI6UXO"
    "ws71h+8VHN9QsaChYUNFxYwFBQsaChZMODChoGBCw4KCioaCjo6KhowZC4CgICFhQgJIQUNBQ8KEBRs6KjoqJkyYAORtmJAQANTVUAAACV"
    "BQZpEAAAA=",
    3: "H4sIAAAAAAAAA/NzDw5gZmBgAGEmHgYGDpN///7/mTfv/+QDf3Q1GCL1mD5e/Gf3iiEljHErc2N5eMbK9IBZlSviFrv3LIxcssgp9e0n"
    "tRrDkMPfIpapbqhY0NCwoaJixoKCBQ0FCyYcmFBQMKFhQUFFQ0FHR0VDxowFQFCQkDAhAaSgoaAhYcKCDR0VHRUTJkwA8jZMSAgA6mooAA"
    "A7n4+tlAAAAA==",
    4: "TkdTUAQAAAADAAAAAgwABiAAAAAAAAAAAAAAAAAAAAAkAAAAAAAAABsAAAAAAAAADAAAAAAAAAADAAAAAAAAABIAAAAAAAAACQAAAAAAAAAS"
    "AAAAAAAAAAkAAAAAAAAAFQAAAAAAAAAMAAAAAAAAAD0AAAAAAAAASAAAAAAAAAAotS/9IBvZAAAINP7+//yenv+TwPwtKABZLgLx0f4+6g"
    "BkVgEotS/9IAMZAAC1A4EotS/9IAlJAAB3V2ipZ1CaeagotS/9IAlJAABeo0eMoVmkokIotS/9IAxhAABl7fImfDFUw/ZYpiUotS/9IEil"
    "AQCCBAwSsCXpzMU3Br4qr8djLB4Mw+BcYlcQHYptJ5O5QZHraIT+A4ATEadZqYEursM25JsA",
}


def apart(one: Gaussians, other: Gaussians) -> dict[str, float]:
    """The largest difference of each part; rotations as matrices, for two quaternions are one rotation."""
    turns = np.abs(rotations_of(one.quats) - rotations_of(other.quats)).max()
    names = ("means", "log_scales", "opacities", "colours", "sh_rest")
    return {name: np.abs(getattr(one, name) - getattr(other, name)).max(initial=0.0) for name in names} | {
        "quats": turns
    }


@pytest.mark.parametrize("version", PUBLIC)
def test_a_file_of_the_public_library_is_the_scene_it_was_made_of(version: int) -> None:
    scene = some(3, 8, seed=5)
    found = apart(scene, from_spz(b64decode(PUBLIC[version]), decompress_zstd)[0])
    assert found["means"] <= 0.5 / 4096  # half of the last bit
    assert found["log_scales"] <= 0.5 / 16 + 1e-6 and found["opacities"] <= 0.5 / 255 + 1e-6
    assert found["colours"] <= 0.5 / 255 / 0.15 * sh.C0 + 1e-6 and found["sh_rest"] <= 8.5 / 128
    assert found["quats"] <= (0.03 if version == 2 else 0.005)


def test_what_is_written_is_what_the_public_library_writes() -> None:
    ours, theirs = (gzip.decompress(data) for data in (to_spz(some(3, 8, seed=5), False), b64decode(PUBLIC[3])))
    assert ours == theirs


@pytest.mark.parametrize("count", sh.COUNTS)
def test_every_degree_comes_back_within_its_bits(count: int) -> None:
    scene = some(300, count, seed=count)
    found = apart(scene, from_spz(to_spz(scene, True), decompress_zstd)[0])
    assert found["means"] <= 0.5 / 4096 and found["quats"] <= 0.005
    assert found["sh_rest"] <= (4.5 if count == 3 else 8.5) / 128


def test_writing_what_was_read_changes_nothing() -> None:
    for antialiased in (False, True):
        data = to_spz(some(200, 15), antialiased)
        assert to_spz(*from_spz(data, decompress_zstd)) == data


def test_a_scene_far_from_its_origin_keeps_what_bits_it_can() -> None:
    scene = some(20, 0)
    far = replace(scene, means=scene.means + np.array([30_000.0, 0.0, -30_000.0], np.float32))
    found = from_spz(to_spz(far, False), decompress_zstd)[0]
    assert 1e-3 < np.abs(found.means - far.means).max() <= 0.5 / 2**8 + 1e-3  # 2**15 m take 15 of 23 bits
    with pytest.raises(ValueError, match="spz: means: 9000000 m from the origin"):
        to_spz(replace(far, means=np.full_like(far.means, 9e6)), False)


def test_faults_are_named() -> None:
    data = to_spz(some(5, 3), False)
    plain = gzip.decompress(data)
    public = b64decode(PUBLIC[4])
    with pytest.raises(ValueError, match="spz: log_scales: NaN"):
        to_spz(replace(some(5, 0), log_scales=np.full((5, 3), np.nan, np.float32)), False)
    for broken, said in (
        (b"ply\n", "neither with NGSP nor as gzip"),
        (data[:-20], "truncated"),
        (data[:-1], "truncated"),
        (gzip.compress(plain[:10]), "header: truncated"),
        (gzip.compress(plain[:-1]), "take 161 bytes, 160 found"),
        (gzip.compress(b"NGSX" + plain[4:]), "version"),
        (gzip.compress(plain[:4] + b"\x05" + plain[5:]), "version: 5"),
        (gzip.compress(plain[:8] + b"\xff\xff\xff\x7f" + plain[12:]), "2,147,483,647 Gaussians in a file of"),
        (gzip.compress(plain[:12] + b"\x04" + plain[13:]), "SH degree 4"),
        (gzip.compress(plain[:14] + b"\x02" + plain[15:]), "extensions"),
        (gzip.compress(bytes(10_000_000)), "expands beyond"),
        (to_spz(EMPTY, False), "0 Gaussians"),
        (public[:20], "header: truncated"),
        (public[:15] + b"\x05" + public[16:], "expected 6"),
        (public[:-1], "they end at byte"),
        (public[:40] + b"\x1c" + public[41:], "expected 6"),
        (public[:150] + b"\x00" * (len(public) - 150), "zstd"),
    ):
        with pytest.raises(ValueError, match="spz: ") as caught:
            from_spz(broken, decompress_zstd)
        assert said in str(caught.value), (said, str(caught.value))
