"""A reader tells, without reading a clip, whether the clip's log is still what it was."""

from collections.abc import Callable
from pathlib import Path

import pytest
from test_av2 import write_log

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.py123d.reader import Py123dReader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import BadClip, ClipRef
from factory.readers.logs import LogReader
from tests.factory.datasets.navsim.small import reader_of, road_frames, write_city
from tests.factory.datasets.navsim.small import write_log as write_navsim_log
from tests.factory.datasets.py123d.py123d_logs import convert
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town


def av2(folder: Path) -> tuple[AV2Reader, Path]:
    """A reader, and a file of its log that clips are computed from."""
    log = write_log(folder / "log-a")
    return AV2Reader(log), next((log / "map").glob("log_map_archive_*.json"))


def scenarionet(folder: Path) -> tuple[ScenarioNetReader, Path]:
    """Likewise."""
    return ScenarioNetReader(folder), town.save(town.nuplan(), folder)


def py123d(folder: Path) -> tuple[Py123dReader, Path]:
    """Likewise."""
    log = convert(write_log(folder / "source" / "log-a"), folder / "out")
    return Py123dReader(log), log / "map.arrow"


def navsim(folder: Path) -> tuple[NavsimReader, Path]:
    """Likewise."""
    write_city(folder)
    log = write_navsim_log(folder, road_frames())
    return reader_of(folder, sensors=None), log


def navsim_map(folder: Path) -> tuple[NavsimReader, Path]:
    """Likewise; the city's map is no part of the log."""
    reader, _ = navsim(folder)
    return reader, next(folder.glob("maps/*/*/map.gpkg"))


Reader = LogReader | NavsimReader


@pytest.mark.parametrize("make", [av2, navsim, navsim_map, py123d, scenarionet])
def test_the_digest_is_the_clip_s_and_follows_the_log(make: Callable[..., tuple[Reader, Path]], tmp_path: Path):
    reader, file = make(tmp_path)
    ref = reader.index().refs[0]
    before = reader.digest(ref)
    assert before == reader.read(ref).content_digest
    content = file.read_bytes()
    file.write_bytes(content + b" ")
    assert reader.digest(ref) != before
    file.write_bytes(content)
    assert reader.digest(ref) == before
    with pytest.raises(BadClip, match="no log gone"):
        reader.digest(ClipRef(reader.name, "gone", 0))
