"""Every place that decodes pictures of a user's or of a table: as they are stored, and the header before anything."""

import io
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from factory.readers.base import BadClip
from factory.readers.pictures import read_header, without_exif
from factory.stages.sensors import decode_image, opened_photos, read_masks
from factory.store.reader import image_of
from planners.data.batch import ImageLayout
from planners.data.images import stitch_sample
from tasks.world.clip import Camera, SensorFile
from tests.pictures import declared, turned
from tests.planners import samples
from tests.planners.samples import Pixels

WIDTH, HEIGHT = 48, 32
SPARE_BYTES = 300 << 20  # that decoding may take; 30,000 x 30,000 pixels take 2.7 GB
CAMERA = Camera("front", WIDTH, HEIGHT, np.diag([40.0, 40.0, 1.0]), np.zeros(5), np.eye(4))
Place = Callable[[Path, bytes], Pixels]


def scene() -> Pixels:
    """Bright above, dark below, red on the left: turned any way it is another picture."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[: HEIGHT // 2] = 200
    pixels[:, : WIDTH // 2, 0] = 250
    return pixels


def encoded(suffix: str, pixels: Pixels | None = None) -> bytes:
    return cv2.imencode(suffix, (scene() if pixels is None else pixels)[..., ::-1])[1].tobytes()


def photo(folder: Path, data: bytes) -> Pixels:
    path = folder / "front.jpg"
    path.write_bytes(data)
    ((_, pixels),) = opened_photos([SensorFile("front", str(path), 0.0, np.eye(4))], [CAMERA])
    return pixels


def mask(folder: Path, data: bytes) -> Pixels:
    (folder / "front.png").write_bytes(data)
    return read_masks(str(folder), [CAMERA])["front"].astype(np.uint8)


def row(folder: Path, data: bytes) -> Pixels:
    return image_of(samples.pictures({"front": data}), "front", 0.0)


def batch(folder: Path, data: bytes) -> Pixels:
    sample = samples.pictures({"front": data})
    return stitch_sample(sample, ImageLayout(("front",), WIDTH, HEIGHT, rows_cut=0.0, sides_cut=0.0))


def agent(folder: Path, data: bytes) -> Pixels:
    return decode_image(data, "front.jpg")


PLACES: dict[str, Place] = {p.__name__: p for p in (photo, mask, row, batch, agent)}
KINDS = [(name, suffix) for name in PLACES for suffix in (".jpg", ".png") if (name, suffix) != ("batch", ".png")]


@contextmanager
def little_memory() -> Iterator[None]:
    """No more than SPARE_BYTES beyond what the process has."""
    has = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (has + SPARE_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize(("place", "suffix"), KINDS)
def test_pixels_come_as_they_are_stored_whatever_exif_says(
    tmp_path: Path, place: str, suffix: str, orientation: int
) -> None:
    plain = encoded(suffix)
    data = turned(plain, orientation)
    bare = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_COLOR)
    seen = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert (np.shape(seen) != np.shape(bare)) == (orientation > 4)
    np.testing.assert_array_equal(PLACES[place](tmp_path, data), PLACES[place](tmp_path, plain))


@pytest.mark.parametrize(("place", "suffix"), KINDS)
def test_a_picture_that_declares_gigabytes_is_refused_by_its_header(tmp_path: Path, place: str, suffix: str) -> None:
    data = declared(encoded(suffix), 30_000, 30_000)
    PLACES[place](tmp_path, encoded(suffix))  # what is loaded on first use is loaded
    assert len(data) < 1500
    calibrated = place in ("photo", "mask")
    wanted = f"but .* takes {WIDTH}x{HEIGHT}: restore" if calibrated else "more than the 67108864 pixels"
    named = "camera front" if place == "row" else "" if place == "batch" else r"\.(jpg|png)"
    with little_memory(), pytest.raises((BadClip, ValueError), match=f"{named}.*30000x30000, {wanted}"):
        PLACES[place](tmp_path, data)


@pytest.mark.parametrize("place", PLACES)
def test_a_picture_of_another_format_is_refused_by_its_name(tmp_path: Path, place: str) -> None:
    grey = scene()[..., :1].astype(np.float32)
    made = {suffix: encoded(suffix) for suffix in (".bmp", ".tiff", ".webp", ".gif")}
    made |= {".pfm": cv2.imencode(".pfm", grey)[1].tobytes(), ".hdr": b"#?RADIANCE\n"}
    names = {".bmp": "BMP", ".tiff": "TIFF", ".webp": "WebP", ".gif": "GIF", ".pfm": "PFM", ".hdr": "Radiance HDR"}
    for suffix, data in made.items():
        with pytest.raises((BadClip, ValueError), match=f"a {names[suffix]} file: convert it to a JPEG or PNG"):
            PLACES[place](tmp_path, data)
        for size in (2, len(data) // 2):
            with pytest.raises((BadClip, ValueError), match="JPEG or PNG"):
                PLACES[place](tmp_path, data[:size])
    with pytest.raises((BadClip, ValueError), match="empty"):
        PLACES[place](tmp_path, b"")


@pytest.mark.parametrize(("place", "suffix"), KINDS)
def test_a_picture_that_is_cut_off_is_refused(tmp_path: Path, place: str, suffix: str) -> None:
    data = encoded(suffix)
    cut = [data[:size] for size in (8, 20, 30, len(data) // 2)]
    if suffix == ".png":  # chunks that claim 2 GB
        cut += [data[:at] + b"\x7f\xff\xff\xff" + data[at + 4 :] for at in (33, len(data) - 12)]
    for broken in cut:
        with pytest.raises((BadClip, ValueError), match="cut off" if suffix == ".png" else r"cut off|decoded"):
            PLACES[place](tmp_path, broken)


@pytest.mark.parametrize("place", [name for name in PLACES if name not in ("mask", "batch")])
def test_grey_deep_and_cmyk_pictures_are_decoded_as_eight_bits_of_rgb(tmp_path: Path, place: str) -> None:
    grey = scene()[..., 1]
    cmyk = io.BytesIO()
    Image.fromarray(scene()).convert("CMYK").save(cmyk, "JPEG", quality=95)
    for data, wanted in (
        (encoded(".jpg", grey[..., None]), np.repeat(grey[..., None], 3, axis=2)),
        (cv2.imencode(".png", scene()[..., ::-1].astype(np.uint16) * 257)[1].tobytes(), scene()),
        (cmyk.getvalue(), scene()),
    ):
        found = PLACES[place](tmp_path, data)
        assert found.shape == (HEIGHT, WIDTH, 3) and found.dtype == np.uint8
        assert np.abs(found.astype(int) - wanted).mean() < 6.0


def test_what_turns_a_jpeg_is_taken_out_of_it_and_nothing_else() -> None:
    plain = encoded(".jpg")
    both = turned(turned(plain, 6), 3)
    assert without_exif(both) == without_exif(plain) == plain
    assert read_header(both) == ("JPEG", (WIDTH, HEIGHT))
