"""Folders of data with links in them, or with what macOS and Windows leave beside files, are read as without."""

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import chdir
from functools import cache
from pathlib import Path

import pytest

from examples import csv_logs
from factory.__main__ import main as factory
from factory.config.run import load_config
from factory.config.words import ConfigError
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.scenarionet.reader import MAPPING, SUMMARY
from factory.datasets.town.town import SUMS, repair_folder, write_once
from factory.exits import COMPLETE
from factory.files import file_digest, folders_in, matching_below
from factory.readers.base import BadClip, ClipIndex, ClipReader, ClipRef
from factory.readers.logs import LogReader
from factory.readers.pictures import file_and_frame
from factory.setup.settings import open_reader
from factory.store.reader import SampleTable
from tests.factory.data_folders import add_companions, put_behind_links
from tests.factory.datasets.navsim import simscale_writer
from tests.factory.datasets.navsim.small import road_frames, write_blobs, write_city, write_log
from tests.factory.datasets.py123d.py123d_logs import convert
from tests.factory.datasets.scenarionet import scenarionet_scenarios, test_photos
from tests.pages import REPOSITORY

Make = Callable[[Path, Path], None]  # writes a data set below a root; some from a log of the town
Kind = Callable[[Path], str]  # changes how a root comes; then the text that names it
SIMULATED = "synthetic_reaction_pdm_v1.0-0"


def av2(root: Path, street: Path) -> None:
    shutil.copytree(street, root / "train" / street.name)


def scenarionet(root: Path, street: Path) -> None:
    scenarionet_scenarios.save(scenarionet_scenarios.nuscenes(), root / "part")


def database(root: Path, street: Path) -> None:
    """Merged of another that lies beside it."""
    path = scenarionet_scenarios.save(scenarionet_scenarios.nuscenes(), root / "other", "scene.pkl")
    for name, content in ((SUMMARY, {path.name: {}}), (MAPPING, {path.name: "../other"})):
        (root / "merged").mkdir(exist_ok=True)
        (root / "merged" / name).write_bytes(pickle.dumps(content))


def sidecar(root: Path, street: Path) -> None:
    path = scenarionet_scenarios.save(scenarionet_scenarios.nuscenes(), root / "logs", "sd_nuscenes_x_scene-0001.pkl")
    test_photos.write(root / "photos" / path.stem, test_photos.sidecar())


def py123d(root: Path, street: Path) -> None:
    convert(street, root / "converted")
    shutil.copytree(street, root / "sensor" / street.parent.name / street.name)


def navsim(root: Path, street: Path) -> None:
    frames = road_frames()
    write_city(root)
    write_log(root, frames)
    write_blobs(root, frames)


def town(root: Path, street: Path) -> None:
    shutil.copytree(street.parent, root / street.parent.name)


def csv(root: Path, street: Path) -> None:
    csv_logs.write_log(root / "street")


CAMERAS = "clips.settings.cameras=[ring_front_center] clips.settings.width=64 clips.settings.height=36"
READERS: dict[Make, str] = {
    av2: "clips=av2 clips.root={root}",
    scenarionet: "clips=scenarionet clips.root={root}",
    database: "clips=scenarionet clips.root={root}/merged",
    sidecar: "clips=scenarionet clips.root={root}/logs clips.cameras={root}/photos",
    py123d: "clips=py123d clips.root={root}/converted clips.sensor_root={root}/sensor",
    navsim: "clips=navsim clips.root={root}/navsim_logs/mini clips.maps={root}/maps "
    "clips.sensors={root}/sensor_blobs/mini clips.cache_dir={root}/../kept",
    town: f"clips=synthetic clips.cache_dir={{root}} clips.n_clips=1 {CAMERAS} clips.settings.lidar_beams=32 "
    "clips.settings.lidar_azimuths=300 clips.settings.steps_per_photo=5",
    csv: "clips=custom clips._target_=examples.csv_logs.CsvReader +clips.root={root}",
}


@pytest.fixture(scope="module")
def street(small_town: Path) -> Path:
    return folders_in(small_town)[0]


def opened(make: Make, root: str) -> tuple[ClipReader, ClipIndex]:
    """As by a command."""
    words = [word.format(root=root) for word in READERS[make].split()]
    return open_reader(load_config([*words, "out=nowhere"]).clips)


def clips_of(make: Make, root: str) -> list[object]:
    """What a run would find under this root, to the last byte of a photo."""
    reader, index = opened(make, root)
    assert index.refs and not index.broken and not index.skipped_logs, index.broken
    found: list[object] = []
    for clip in map(reader.read, index.refs):
        files = [(f.sensor, f.time_s, file_digest(file_and_frame(f.uri)[0])) for f in (*clip.images, *clip.sweeps)]
        found.append((clip.clip_id, clip.split, clip.content_digest, clip.ego_states.tobytes(), files))
    return found


def among_companions(root: Path) -> str:
    add_companions(root)
    return str(root)


def all_behind_links(root: Path) -> str:
    """The root too."""
    put_behind_links(root, root.parent / "elsewhere")
    root.rename(root.parent / "there")
    root.symlink_to("there")
    return str(root)


def oddly_told(root: Path) -> str:
    """From the home folder, there and back, with a slash at the end of a name that has what shells and lists mind."""
    odd = root.rename(root.with_name("a b=c,d [e] (f) {g} 'h' \"i\" #j %k $l ü~"))
    return f"~/{odd.name}/../{odd.name}/"


def upper_case(root: Path) -> str:
    """What is looked for by its suffix."""
    for pattern in ("*/sd_*.pkl", "navsim_logs/*/*.pkl", "train/*/sensors/cameras/*/*.jpg"):
        for path in list(root.glob(pattern)):
            path.rename(path.with_suffix(path.suffix.upper()))
    return str(root)


KINDS = (among_companions, all_behind_links, oddly_told, upper_case)
COMES_AS = [(make, kind) for make in READERS for kind in KINDS]
COMES_AS = [pair for pair in COMES_AS if pair[1] is not upper_case or pair[0] in (av2, sidecar, navsim)]


@pytest.fixture(scope="module")
def made(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[Make], tuple[Path, list[object]]]:
    """A data set's folder, and its clips as they are found there by a path from the folder above."""

    @cache
    def of(make: Make) -> tuple[Path, list[object]]:
        root = tmp_path_factory.mktemp(make.__name__) / "root"
        make(root, street)
        with chdir(root.parent):
            return root, clips_of(make, "./root/../root")

    return of


@pytest.mark.slow
@pytest.mark.parametrize(("make", "kind"), COMES_AS)
def test_the_same_clips_are_found_however_their_folder_comes(
    make: Make,
    kind: Kind,
    made: Callable[[Make], tuple[Path, list[object]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root, known = made(make)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert clips_of(make, kind(shutil.copytree(root, tmp_path / "root", symlinks=True))) == known


LINKED = {  # what a clip is made of, were it there
    av2: ("train", "*/*/*.feather", "*/*/calibration", "*/*/map", "*/*/map/*.json", "*/*/sensors", "*/*/sensors/lidar"),
    scenarionet: ("part", "part/*.pkl"),
    database: ("merged", "merged/*.pkl", "other", "other/*.pkl"),
    sidecar: ("logs", "logs/*.pkl", "photos", "photos/*", "photos/*/*.json"),
    py123d: ("converted", "*/logs", "*/logs/*", "*/logs/*/*", "*/logs/*/*/*.arrow", "sensor"),
    navsim: ("*", "*/*", "maps/*/*", "maps/*/*/*", "navsim_logs/*/*.pkl", "sensor_blobs/*/*"),
}


@pytest.mark.slow
@pytest.mark.parametrize("make", LINKED)
def test_a_link_that_leads_nowhere_is_named_where_it_lies(
    make: Make, street: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """By the reader's error, or by a line in the log where the reader says what it expected."""
    root = tmp_path / "root"
    make(root, street)
    for path in sorted(path for pattern in LINKED[make] for path in root.glob(pattern)):
        path.rename(tmp_path / "away")
        path.symlink_to("/unmounted/data")
        caplog.clear()
        with pytest.raises((BadClip, ConfigError, AssertionError)) as error:
            clips_of(make, str(root))
        assert "leads to /unmounted/data, which is not there" in f"{error.value} {caplog.text}", path
        path.unlink()
        (tmp_path / "away").rename(path)


OF_LOGS = {  # files that clips are computed from; a city's map is no part of a log
    av2: ("train/*/map/log_map_archive_*.json",),
    scenarionet: ("part/*.pkl",),
    py123d: ("converted/logs/*/*/map.arrow",),
    navsim: ("navsim_logs/mini/*.pkl", "maps/*/*/map.gpkg"),
}


@pytest.mark.parametrize(("make", "file"), [(make, file) for make, files in OF_LOGS.items() for file in files])
def test_the_digest_is_the_clip_s_and_follows_the_log(make: Make, file: str, street: Path, tmp_path: Path) -> None:
    """Told without reading a clip."""
    make(tmp_path / "root", street)
    reader, index = opened(make, str(tmp_path / "root"))
    (path,), ref = (tmp_path / "root").glob(file), index.refs[0]
    assert isinstance(reader, LogReader | NavsimReader)
    before = reader.digest(ref)
    assert before == reader.read(ref).content_digest
    content = path.read_bytes()
    path.write_bytes(content + b" ")
    assert reader.digest(ref) != before
    path.write_bytes(content)
    assert reader.digest(ref) == before
    with pytest.raises(BadClip, match="no log gone"):
        reader.digest(ClipRef(reader.name, "gone", 0))


@pytest.mark.parametrize("kind", (all_behind_links, among_companions))
def test_simscale_s_logs_and_rewards_are_found_behind_links_and_among_companions(kind: Kind, tmp_path: Path) -> None:
    for number in (1, 2):
        simscale_writer.write_log(tmp_path / "root", SIMULATED, number, 0)
    kind(tmp_path / "root")
    assert factory(["import", "simscale", f"root={tmp_path / 'root'}", f"out={tmp_path / 'out'}"]) == COMPLETE
    assert len(SampleTable(tmp_path / "out")) == 2


@pytest.mark.slow
def test_the_command_follows_a_link_to_a_folder_and_names_one_that_leads_nowhere(tmp_path: Path) -> None:
    scenarionet(tmp_path / "real", tmp_path)
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "part").symlink_to("../real/part")
    (tmp_path / "root" / "gone").symlink_to("/unmounted/part")
    words = [word.format(root=tmp_path / "root") for word in READERS[scenarionet].split()]
    command = [sys.executable, "-m", "factory", "vocabulary", f"table={tmp_path / 'found.npz'}", "clips.split=train"]
    done = subprocess.run([*command, *words], cwd=REPOSITORY, capture_output=True, text=True, timeout=250)
    assert (done.returncode, "from 1 train logs" in done.stdout) == (0, True), done.stderr
    assert f"{tmp_path}/root/gone is passed over: the link leads to /unmounted/part, which is not there" in done.stderr


def test_a_folder_is_entered_once_and_by_its_own_path_where_it_has_one(tmp_path: Path) -> None:
    for path in ("root/b/x.pkl", "elsewhere/y.pkl"):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).touch()
    for name, to in {"a": "b", "c": "../elsewhere", "d": "../elsewhere", "e": ".", "f": "f"}.items():
        os.symlink(to, tmp_path / "root" / name)
    root = tmp_path / "root"
    assert matching_below(root, "*.pkl") == [root / "b" / "x.pkl", root / "c" / "y.pkl"]
    assert matching_below(tmp_path / "nowhere", "*.pkl") == []


def test_a_whole_folder_is_made_and_mended_behind_a_link_to_another_disk(tmp_path: Path) -> None:
    def write(folder: Path) -> None:
        (folder / "a").mkdir()
        for name in ("a/x", "y"):
            (folder / name).write_text(f"{name} as it was written")

    with tempfile.TemporaryDirectory(dir="/dev/shm") as other_disk:
        assert os.stat(other_disk).st_dev != tmp_path.stat().st_dev, "a file cannot be renamed from one to the other"
        root = tmp_path / "root"
        root.symlink_to(Path(other_disk) / "root")
        write_once(root, write)
        for name in ("a/x", "y"):
            (root / name).write_text("damaged")
        shutil.move(root / "a", tmp_path / "a")
        (root / "a").symlink_to(tmp_path / "a")
        (tmp_path / "of_another" / "z").mkdir(parents=True)
        (root / "stray").symlink_to(tmp_path / "of_another")
        repair_folder(root, write)
        assert (tmp_path / "of_another" / "z").is_dir() and not (root / "stray").exists()
        assert [(root / name).read_text() for name in ("a/x", "y")] == [f"{n} as it was written" for n in ("a/x", "y")]
        assert {path.relative_to(root).as_posix() for path in root.rglob("*")} == {"a", "a/x", SUMS, "y"}
        assert list(Path(other_disk).iterdir()) == [Path(other_disk) / "root"]
        assert list(tmp_path.glob(".*")) == []
