"""NAVSIM's folders in small: a town's log, its city, and a second stage of the log's own frames 4 s later."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from factory.datasets.av2.reader import read_log
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import write_logs
from factory.readers.pickles import load_plain
from tests.factory.datasets.navsim import scene_pickles
from tests.factory.datasets.navsim.geopackage_writer import (
    CITIES,
    ORIGIN,
    stub_rows,
    town_rows,
    write_geopackage,
    write_root,
)
from tests.factory.datasets.navsim.openscene_writer import Place, Sensed, write_openscene

NOW, TOKENS = 4, ("0000000000005a00c", "0000000000005a00b")


def write_town(root: Path, split: str, folder: Path, location: str, sensed: Sensed | None = None) -> Path:
    """A town's log in OpenScene's form, its map as that of the city; the log's pickle."""
    log = read_log(folder)
    rows = town_rows(log.road_map)
    version, zone = CITIES[location]
    (root / "maps" / location / version / "map.gpkg").unlink(missing_ok=True)
    write_geopackage(root / "maps" / location / version / "map.gpkg", rows, zone)
    blocks = log.road_map.roadblock_of
    number = {blocks[str(row["fid"])]: str(row["lane_group_fid"]) for row in rows["lanes_polygons"]}
    number |= {blocks[str(row["fid"])]: str(row["lane_group_connector_fid"]) for row in rows["lane_connectors"]}
    place = Place(location, np.append(ORIGIN, 0.0), roadblock_number=number.__getitem__)
    return write_openscene(root, split, folder.name, log, place, sensed)


def write_installation(root: Path) -> Path:
    """A log, its city and one group: frames 4 and 3 of the log, then 12 and 11."""
    write_root(root / "maps", "sg-one-north", stub_rows())
    (folder,) = write_logs(root / "av2", (1,), 0, TownSettings(cameras=(), lidar_beams=0))
    frames = frames_of(write_town(root, "test", folder, next(iter(CITIES))))
    scenes = root / "navhard_two_stage" / "synthetic_scene_pickles"
    scenes.mkdir(parents=True)
    for token, at in zip(TOKENS, (NOW + 8, NOW + 7)):
        scene_pickles.write_scene(scenes, scene_pickles.scene_of_log(frames, at, token))
    write_split(root, frames)
    return root


def frames_of(path: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = load_plain(path.read_bytes(), str(path))
    return found


def write_split(root: Path, frames: list[dict[str, Any]], *further: Any) -> None:
    now, before = frames[NOW]["token"], frames[NOW - 1]["token"]
    mapping = [[now, before, [list(TOKENS)]], *further]
    split = {"defaults": [{"scene_filter": "small"}], "data_split": "test", "reactive_all_mapping": mapping}
    (root / "split.yaml").write_text(yaml.safe_dump(split))
    (root / "scene_filter").mkdir(exist_ok=True)
    (root / "scene_filter" / "small.yaml").write_text(yaml.safe_dump({"tokens": [now, before]}))
