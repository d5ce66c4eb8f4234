"""Real logs, damaged: `python -m tests.chaos.damaged_logs SHARED [seeds=0-200] [of=av2,nuscenes,navsim] [rows=0]`.

Of each data set a log a seed is copied with damages of the kinds in damages.py, at random, and read: two to four of
any kind, at odd seeds a single one of one frame. Held against the log as it is

- no window that lies outside of all damages is lost (0.6 s around a damage count as inside: velocities are fitted to
  the frames around), and what is read there is the same to the byte. nuScenes' ego alone is smoothed as a whole, on a
  clock that all frames tell: what is done to it moves it by less than 0.3 m outside;
- inside, things and parts of the map that no damage touches are the same to the byte too, and where anything differs a
  repair says so. What the clock is off by 3 % or jitters by 10 ms moves everything, by less than a metre.

Prints a table by data set and kind. rows=N: of N logs with one short damage also two whole runs, without pictures: the
samples of windows outside are the same but for the digest of the log's files. NAVSIM's logs are frames that `factory
export navsim` wrote of runs on the Argoverse and nuScenes logs, the samples of a log joined to one log again.
"""

import pickle
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.av2.reader import read_log as read_av2
from factory.datasets.navsim.reader import NavsimReader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.datasets.scenarionet.reader import read_log as read_scenario
from factory.readers.logs import WholeLog
from factory.run import main as run
from tests.chaos.damaged_logs.comparison import DataSet, Told, damaged, unequal_rows
from tests.chaos.damaged_logs.damages import ALL
from tests.chaos.damaged_logs.logs import AV2Files, NavsimLog, NuscenesLog
from tests.factory.datasets.navsim.geopackage_writer import CITIES, ORIGIN, Fids, Row, town_rows, write_geopackage
from tests.writable import load_writable

CITY = "us-ma-boston"


def data_sets(
    shared: Path, folder: Path, of: Sequence[str], to_export: int | None = None
) -> Iterator[tuple[str, DataSet]]:
    """The shared logs, and such as an export writes below a folder; to_export: the first of nuScenes alone."""
    av2 = tuple(sorted((shared / "data/av2/sensor/val").iterdir()))
    files = sorted((shared / "data/scenarionet/nuscenes").glob("*.pkl"))
    moving = tuple(path for path in files if "0553" not in path.name)  # whose ego stands
    if "av2" in of:
        yield "av2", DataSet(av2, AV2Files, lambda root, _: AV2Reader(root), lambda root, _: of_run("av2", root))
    if "nuscenes" in of:
        yield (
            "nuscenes",
            DataSet(
                moving,
                NuscenesLog,
                lambda root, _: ScenarioNetReader(root),
                lambda root, _: of_run("scenarionet", root),
            ),
        )
    if "navsim" in of:
        rows = exported_logs("scenarionet", moving[:to_export], read_scenario, folder / "nuscenes")
        if to_export is None:
            rows |= exported_logs("av2", av2, read_av2, folder / "av2")

        def maps(root: Path, log: Path) -> Path:
            return root / "maps" if (root / "maps").is_dir() else log.parent / "maps"

        def reader(root: Path, log: Path) -> NavsimReader:
            return NavsimReader(root, maps(root, log), stride_s=0.5, cache_dir=str(root / "tables"))

        def words(root: Path, log: Path) -> list[str]:
            return [*of_run("navsim", root), f"clips.maps={maps(root, log)}"]

        yield "navsim", DataSet(tuple(rows), lambda path: NavsimLog(path, rows[path], CITY), reader, words)


def of_run(clips: str, root: Path) -> list[str]:
    """Words that choose the logs."""
    return [f"clips={clips}", f"clips.root={root}"]


def exported_logs(
    clips: str, logs: Sequence[Path], read: Callable[[Path], WholeLog], folder: Path
) -> dict[Path, dict[str, list[Row]]]:
    """What `factory export navsim` writes of the human samples of logs, joined to a log again, and rows of its map.

    A sample is 12 frames and begins a second after the one before: of a frame in several the last one's counts.
    """
    from factory.__main__ import main as factory

    out, to = folder / "run", folder / "export"
    words = [
        *of_run(clips, logs[0].parent),
        f"clips.only=[{','.join(log.stem for log in logs)}]",
        "experts=[human]",
        "rounds=1",
        "render=none",
        "reward.labels=none",
    ]
    if code := run([*words, "executor=local", f"out={out}"]):
        raise RuntimeError(f"the run to export ended with {code}")
    if code := factory(["export", "navsim", f"out={out}", f"to={to}", f"map_location={CITY}", "missing=none"]):
        raise RuntimeError(f"the export ended with {code}")
    samples = [load_writable(path) for path in sorted(to.glob("navsim_logs/*/*.pkl"))]
    rows_of = dict[Path, dict[str, list[Row]]]()
    for log in logs:
        name = log.stem.replace("-", "_")
        own = sorted((s for s in samples if s[0]["log_name"].startswith(name)), key=lambda s: s[0]["timestamp"])
        frames = {frame["timestamp"]: frame for sample in own for frame in sample}
        road_map = read(log).road_map
        rows, (version, zone) = town_rows(road_map), CITIES[CITY]
        blocks = road_map.roadblock_of
        fids = Fids(list(road_map.lanes))  # as town_rows numbers them
        driven = [blocks[lane_id] for lane_id, lane in road_map.lanes.items() if lane.drives_cars]
        number = {block: str(fids("block", block)) for block in driven}
        (folder / name).mkdir()
        write_geopackage(folder / name / "maps" / CITY / version / "map.gpkg", rows, zone)
        for k, (_, frame) in enumerate(sorted(frames.items())):
            route = [number.get(block, "0") for block in frame["roadblock_ids"]]
            frame |= {"log_name": name, "frame_idx": k, "roadblock_ids": route}
            frame["ego2global_translation"] = frame["ego2global_translation"] + np.append(ORIGIN, 0.0)
        path = folder / name / f"{name}.pkl"
        path.write_bytes(pickle.dumps([frame for _, frame in sorted(frames.items())]))
        rows_of[path] = rows
    return rows_of


def main(argv: Sequence[str]) -> int:
    """The table; 1 where anything is not as it should be."""
    shared, *words = argv
    given = dict(word.split("=", 1) for word in words)
    first, _, stop = given.get("seeds", "0-200").rpartition("-")
    seeds, of = range(int(first or 0), int(stop)), given.get("of", "av2,nuscenes,navsim").split(",")
    n_rows = int(given.get("rows", 0))
    fine = True
    lines, rows = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name, data in data_sets(Path(shared).resolve(), Path(folder), of):
            for kind, told in sorted(damaged(data, seeds).items()):
                said = "all" if kind == ALL else kind
                lines.append(f"| {name} | {said} | {' | '.join(str(value) for value in vars(told).values())} |")
                fine &= told.is_fine
            for seed in range(n_rows):
                n, wrong = unequal_rows(data, seed)
                rows.append(f"{name}, seed {seed}: {n} rows outside, unequal {len(wrong)} {'; '.join(wrong)}")
                fine &= not wrong
    print("| logs | damage |", " | ".join(f.name.replace("_", " ") for f in fields(Told)), "|")
    print("|---|---|" + "---|" * len(fields(Told)))
    print("\n".join([*lines, *rows]))
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
