"""Folders of data with links in them, or with what macOS and Windows leave beside files, are read as without."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from factory.__main__ import main as factory
from factory.config.run import load_config
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.town.town import SUMS, repair_folder, write_once
from factory.exits import COMPLETE
from factory.files import folders_in, matching_below
from factory.readers.base import BadClip, ClipRef
from factory.readers.logs import LogReader
from factory.setup.settings import open_reader
from factory.store.reader import SampleTable
from tests.factory.data_folders import add_companions, put_behind_links
from tests.factory.datasets.navsim import simscale_writer
from tests.factory.datasets.navsim.small import road_frames, write_blobs, write_city, write_log
from tests.factory.datasets.py123d.py123d_logs import convert
from tests.factory.datasets.scenarionet import scenarionet_scenarios
from tests.pages import REPOSITORY

SIMULATED = "synthetic_reaction_pdm_v1.0-0"


def av2(root: Path, street: Path) -> list[str]:
    shutil.copytree(street, root / "train" / street.name)
    return ["clips=av2", f"clips.root={root}"]


def scenarionet(root: Path, street: Path) -> list[str]:
    (root / "part").mkdir(parents=True)
    scenarionet_scenarios.save(scenarionet_scenarios.nuscenes(), root / "part")
    return ["clips=scenarionet", f"clips.root={root}"]


def py123d(root: Path, street: Path) -> list[str]:
    convert(street, root)
    return ["clips=py123d", f"clips.root={root}"]


def navsim(root: Path, street: Path) -> list[str]:
    frames = road_frames()
    write_city(root)
    write_log(root, frames)
    write_blobs(root, frames)
    folders = {"root": "navsim_logs/mini", "maps": "maps", "sensors": "sensor_blobs/mini", "cache_dir": "../kept"}
    return ["clips=navsim", *(f"clips.{key}={root / path}" for key, path in folders.items())]


READERS = {make.__name__: make for make in (av2, scenarionet, py123d, navsim)}
SPOILED: dict[str, Callable[[Path], None]] = {
    "companions": add_companions,
    "links": lambda root: put_behind_links(root, root.parent / "elsewhere"),
}


@pytest.fixture(scope="module")
def street(small_town: Path) -> Path:
    return folders_in(small_town)[0]


def read(words: list[str], to: Path) -> bytes:
    """The windows of all clips, as a table that the vocabulary command makes of them."""
    assert factory(["vocabulary", f"table={to}", "clips.split=train", *words]) == COMPLETE
    return to.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("spoil", SPOILED)
@pytest.mark.parametrize("data_set", READERS)
def test_links_are_followed_and_companions_passed_over(
    data_set: str, spoil: str, street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = READERS[data_set](tmp_path / "root", street)
    known = read(words, tmp_path / "known.npz")
    SPOILED[spoil](tmp_path / "root")
    assert read(words, tmp_path / "found.npz") == known
    said = capsys.readouterr().out
    assert re.findall(r"\d+ of them from \d+ train logs", said).count(f"{windows(said)} of them from 1 train logs") == 2
    assert "unreadable" not in said


def windows(said: str) -> str:
    found = re.search(r"(\d+) of them", said)
    assert found is not None and int(found[1]) > 0
    return found[1]


OF_LOGS = {  # files that clips are computed from; a city's map is no part of a log
    "av2": ("train/*/map/log_map_archive_*.json",),
    "scenarionet": ("part/*.pkl",),
    "py123d": ("logs/*/*/map.arrow",),
    "navsim": ("navsim_logs/mini/*.pkl", "maps/*/*/map.gpkg"),
}


@pytest.mark.parametrize(("data_set", "file"), [(name, file) for name, files in OF_LOGS.items() for file in files])
def test_the_digest_is_the_clip_s_and_follows_the_log(data_set: str, file: str, street: Path, tmp_path: Path) -> None:
    """Told without reading a clip."""
    words = READERS[data_set](tmp_path / "root", street)
    reader, index = open_reader(load_config([*words, "out=nowhere"]).clips)
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


@pytest.mark.parametrize("spoil", SPOILED)
def test_simscale_s_logs_and_rewards_are_found_behind_links_and_among_companions(spoil: str, tmp_path: Path) -> None:
    for number in (1, 2):
        simscale_writer.write_log(tmp_path / "root", SIMULATED, number, 0)
    SPOILED[spoil](tmp_path / "root")
    assert factory(["import", "simscale", f"root={tmp_path / 'root'}", f"out={tmp_path / 'out'}"]) == COMPLETE
    assert len(SampleTable(tmp_path / "out")) == 2


@pytest.mark.slow
def test_the_command_follows_a_link_to_a_folder_and_names_one_that_leads_nowhere(tmp_path: Path) -> None:
    words = scenarionet(tmp_path / "real", tmp_path)
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "part").symlink_to("../real/part")
    (tmp_path / "root" / "gone").symlink_to("/unmounted/part")
    words[-1] = f"clips.root={tmp_path / 'root'}"
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
