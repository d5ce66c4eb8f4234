"""A city of nuPlan's size: `python -m tests.bench.bench_maps [lanes=20000]`.

A generated grid of two-lane streets, written as a GeoPackage; read once, opened from its cache, asked around points.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import shapely

from factory.datasets.navsim.maps import City, cache_file, kept_tables, load_tables
from tests.factory.readers.geopackage_writer import LAYERS, ORIGIN, Row, write_geopackage

BLOCK_M, CROSSING_M, WIDTH_M = 80.0, 20.0, 3.5
RADIUS_M = 100.0


def city_rows(n_lanes: int) -> dict[str, list[Row]]:
    """About n_lanes lanes of a grid of streets, two lanes either way, and connectors straight on between them."""
    side = int(np.ceil(np.sqrt(n_lanes / 8)))
    rows: dict[str, list[Row]] = {layer: [] for layer in LAYERS}
    fids = iter(range(1, 100 * n_lanes))
    pitch = BLOCK_M + CROSSING_M
    turns = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]).round() for a in np.pi / 2 * np.arange(4)]
    for turn in turns:
        for street in range(side):
            before: list[int] = []
            before_group = 0
            for k in range(side):
                start = np.array([k * pitch, street * pitch]) - side * pitch / 2.0
                group, lanes = next(fids), [next(fids), next(fids)]
                for index, lane in enumerate(lanes):
                    offset = -(0.5 + index) * WIDTH_M
                    row = {"lane_fid": lane, "lane_group_fid": group, "lane_index": index, "speed_limit_mps": 13.4}
                    _lane(rows, fids, turn, lane, start + np.array([0.0, offset]), BLOCK_M, "lanes_polygons", row)
                box = _box(start - [0.0, WIDTH_M], BLOCK_M, 2 * WIDTH_M, turn)
                rows["lane_groups_polygons"].append({"fid": group, "shape": box})
                if before:
                    joint, crossing = start - [CROSSING_M, 0.0], next(fids)
                    box = _box(joint - [0.0, WIDTH_M], CROSSING_M, 2 * WIDTH_M, turn)
                    ends = {"from_lane_group_fid": before_group, "to_lane_group_fid": group}
                    rows["lane_group_connectors"].append({"fid": crossing, "shape": box} | ends)
                    rows["intersections"].append({"fid": next(fids), "shape": box})
                    for index, (old, new) in enumerate(zip(before, lanes)):
                        offset = -(0.5 + index) * WIDTH_M
                        row = {"exit_lane_fid": old, "entry_lane_fid": new, "lane_group_connector_fid": crossing}
                        _lane(
                            rows,
                            fids,
                            turn,
                            next(fids),
                            joint + np.array([0.0, offset]),
                            CROSSING_M,
                            "lane_connectors",
                            row,
                        )
                before, before_group = lanes, group
    return rows


def _box(start: np.ndarray, length: float, width: float, turn: np.ndarray) -> shapely.Polygon:
    low, high = start - [0.0, width / 2.0], start + np.array([length, width / 2.0])
    return shapely.Polygon(shapely.get_coordinates(shapely.box(*low, *high)) @ turn.T + ORIGIN)


def _lane(rows: dict, fids: object, turn: np.ndarray, fid: int, start: np.ndarray, length: float, layer: str, row: Row) -> None:  # fmt: skip # noqa: E501
    steps = np.arange(0.0, length + 1.0, 2.0)
    lines = []
    for offset in (0.0, WIDTH_M / 2.0, -WIDTH_M / 2.0):
        points = np.column_stack([start[0] + steps, np.full(len(steps), start[1] + offset)])
        lines.append(shapely.LineString(points @ turn.T + ORIGIN))
    sides = {"left_boundary_fid": next(fids), "right_boundary_fid": next(fids)}
    for boundary, line in zip(sides.values(), lines[1:]):
        rows["boundaries"].append({"fid": boundary, "shape": line})
    ring = np.concatenate([shapely.get_coordinates(lines[1]), shapely.get_coordinates(lines[2])[::-1]])
    is_lane = layer == "lanes_polygons"
    owner = {"lane_fid": fid if is_lane else None, "lane_connector_fid": None if is_lane else fid}
    rows["baseline_paths"].append({"fid": next(fids), "shape": lines[0]} | owner)
    polygon = shapely.Polygon(ring)
    if is_lane:
        rows[layer].append({"fid": fid, "shape": polygon} | sides | row)
    else:
        rows[layer].append({"fid": fid, "shape": lines[0]} | row)
        own = {"fid": next(fids), "shape": polygon, "lane_connector_fid": fid}
        rows["gen_lane_connectors_scaled_width_polygons"].append(own | sides)


def main(n_lanes: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = str(Path(folder) / "cache")
        path = Path(folder) / "us-nv-las-vegas-strip" / "9" / "map.gpkg"
        rows = city_rows(n_lanes)
        write_geopackage(path, rows, 32611)
        began = time.perf_counter()
        kept_tables(path)
        read_s = time.perf_counter() - began
        began = time.perf_counter()
        city = City("us-nv-las-vegas-strip", path, load_tables(cache_file(path)))
        open_s = time.perf_counter() - began
        rng = np.random.default_rng(0)
        reach = np.sqrt(n_lanes / 8) * (BLOCK_M + CROSSING_M) / 2.0 - 2 * RADIUS_M
        points = ORIGIN + rng.uniform(-reach, reach, (200, 2))
        times = []
        for _ in range(2):  # lanes not seen before, and seen before
            for point in points:
                began = time.perf_counter()
                found = city.road_map(point[None], RADIUS_M)
                times.append(1e3 * (time.perf_counter() - began))
        print(f"{len(rows['lanes_polygons'])} lanes, {len(rows['lane_connectors'])} connectors")
        print(f"{'the GeoPackage, once':40} {read_s:8.2f} s")
        print(f"{'from the cache':40} {open_s:8.2f} s  ({cache_file(path).stat().st_size / 1e6:.1f} MB)")
        for name, part in (("100 m around a new point", times[:200]), ("100 m around a known point", times[200:])):
            print(f"{name:40} {np.median(part):8.2f} ms  (at most {max(part):.2f})")
        print(f"{'lanes found around the last':40} {len(found.lanes):8d}")


if __name__ == "__main__":
    main(int(dict(word.split("=") for word in sys.argv[1:]).get("lanes", 20_000)))
