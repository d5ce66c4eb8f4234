"""Commands that exchange samples and scenes with other programs: export, import, scene."""

import logging
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from factory.config.arguments import GIVEN_ALONE, POSITIONAL, RUN_SETTINGS, Refused, request_keys, run_command
from factory.config.datasets import find_function
from factory.config.shapes import key_of
from factory.config.words import did_you_mean
from factory.exits import COMPLETE, INTERRUPTED, Stopped
from factory.views.sample_text import find_sample_id, logged_drive, open_samples
from factory.views.status import open_store
from factory.wording import one_line, time_text

if TYPE_CHECKING:
    from factory.store.samples import Store
    from tasks.render.scene.asset import RenderAsset
    from tasks.world.arrays import Array
    from tasks.world.clip import PhotoDrive


Row = Mapping[str, Any]


@dataclass(frozen=True)
class ExportRequest:
    """The command line."""

    format: Literal["mcap", "mp4", "navsim"] = field(metadata=POSITIONAL)
    out: str
    sample: str | None = None
    every: int | None = None
    to: str = "."
    expert: tuple[str, ...] = ()
    round: tuple[str, ...] = ()
    split: tuple[str, ...] = ()
    tag: str = ""
    resize: bool = False
    missing: Literal["refuse", "black", "none"] = "refuse"
    map_location: str = ""
    for_: Literal["simscale", "drivor"] = "simscale"
    vocabulary: str | None = None
    executor: Literal["local", "ray"] = "local"
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.format == "navsim":
            self._check_all()
            return
        for name in [f.name for f in fields(self) if f.name not in EVERYWHERE]:
            if getattr(self, name) != getattr(type(self), name):
                raise ValueError(
                    f"{key_of(name)}=...: of export navsim alone; {self.format} takes sample= or every=, and to="
                )
        if (self.sample is None) == (self.every is None):
            raise ValueError("give either sample=<id> or every=<n>; see --help")
        if self.every == 0:
            raise ValueError("every=0: must be 1 or more")

    def _check_all(self) -> None:
        if self.sample is not None or self.every is not None:
            raise ValueError("sample= and every= are of single files; navsim takes expert=, round= and split=")
        if self.to == ".":
            raise ValueError("to=<folder> is missing: where logs, pictures, splits and rewards are written")
        if "://" in self.to:
            raise ValueError(f"to={self.to}: is written to a local folder; copy that")
        if self.workers == 0:
            raise ValueError("workers=0: must be 1 or more")
        if odd := [word for word in self.round if not (word.isascii() and word.isdecimal())]:
            raise ValueError(f"round={odd[0]}: must be a whole number, 0 or more")


EVERYWHERE = ("format", "out", "sample", "every", "to")


def export(request: ExportRequest) -> int:
    """`python -m factory export mcap|mp4|navsim out=<folder or URL> ...`: samples as files for other tools.

        python -m factory export mcap out=runs/demo sample=0             one sample for Foxglove, Lichtblick or Rerun
        python -m factory export mcap out=runs/demo every=10 to=looks    every tenth sample, a file each
        python -m factory export mp4 out=runs/demo sample=3fa9           a drive as H.264, from above and its cameras
        python -m factory export navsim out=runs/demo to=openscene       all in SimScale's layout, for its training

    `sample` is an ordinal, an id or the beginning of one, `to` a folder (the current one) or, for one sample, a file.
    `navsim` takes all samples, or those of expert=a,b round=0,1 split=train,val, and goes on where it was stopped:
        tag=<word>          behind the experts' names, so that splits of ours stand beside the released ones
        resize=true         pictures of other sizes to 1920x1080, which the released agents take for granted
        missing=black|none  for pictures that a sample has not: a black one, or none; refuse is the default
        map_location=<one>  of NAVSIM's four, for logs whose map has another name
        for=drivor          as DrivoR's training reads it: PDM-Closed's rounds 0 to 4, 14 frames, its configurations
        vocabulary=<.npy>   the trajectories that the labels are of, to be written beside the rewards
        executor=ray        workers on Ray: the cluster of RAY_ADDRESS, whose nodes see `out` and `to` by the same
                            paths, or one of this machine's own; local (the default): processes
        workers=<n>         at once; else 1, on Ray every core
    What is written: docs/navsim_format.md.
    """
    if request.format == "navsim" and request.executor == "ray":
        from factory.config.compose import need_run_extra
        from factory.graph.own_process import run_command_in_own_process

        need_run_extra("ray")
        return run_command_in_own_process(_export_navsim_on_ray, request)
    if request.format == "navsim":
        return _export_navsim(request)
    for path in _export_sample_files(request):
        print(path.resolve())
    return COMPLETE


def _export_sample_files(request: ExportRequest) -> Iterator[Path]:
    """Write the files; their paths as they are written. Raises Refused where there is nothing, or no file can be."""
    store, target = open_store(request.out), Path(request.to)
    table = open_samples(store)
    if request.sample is not None:
        chosen = [find_sample_id(table, store, request.sample)]
    else:
        chosen = list(table.attempt_ids[:: request.every])
    suffix = f".{request.format}"
    is_file = target.suffix == suffix and not target.is_dir()
    if is_file and request.every is not None:
        raise Refused(f"to={request.to}: every=... writes a file for each sample; name a folder")
    try:
        for attempt_id in chosen:
            path = target if is_file else target / f"sample_{attempt_id}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_sample(request.format, store, table[attempt_id], path)
            yield path
    except (OSError, ValueError) as error:  # no such folder, another schema version
        raise Refused(f"{store.location.uri}: {error}") from error


def _export_navsim(request: ExportRequest) -> int:
    """All samples in SimScale's layout; the exit code. Raises Refused."""
    from factory.graph.parallel import WorkerDied, parallel_map
    from factory.graph.steps import TaskStopped
    from factory.store.location import Location
    from factory.store.reader import sample_table

    store = open_store(request.out)
    try:
        target = Location.parse(request.to, setting="to")
        dealt = partial(parallel_map, executor=request.executor, workers=request.workers, to=target)
        table = sample_table(store.location.uri, store.location.options)
        trajectories = _label_vocabulary(store, request.vocabulary)
        done = find_function("EXPORTS", request.format)(request, table, Path(target.uri), trajectories, dealt)
    except (OSError, ValueError) as error:  # no folder, a full disk, what cannot be written as asked
        raise Refused(str(error)) from error
    except WorkerDied as error:
        raise Stopped(str(error)) from error
    except (TaskStopped, KeyboardInterrupt) as error:
        at_once = "" if isinstance(error, TaskStopped) else " at once"
        print(f"interrupted{at_once}; run the same command again to go on", file=sys.stderr)
        return INTERRUPTED
    for note in done.notes:
        print(f"note: {note}")
    print(f"{done.written:,} logs written, {done.logs:,} in all, {done.n_bytes / 1e9:,.3f} GB: {target.uri}")
    return COMPLETE


def _export_navsim_on_ray(request: ExportRequest) -> int:
    """In the process that Ray may end."""
    return run_command((), lambda _: _export_navsim(request), str, elsewhere=", or give to=<another place>")


def _label_vocabulary(store: "Store", file: str | None) -> "Array | None":
    """(K, 40, 3) that the samples' labels are of; None where there are none, or of a file that was not named."""
    from factory.store.reader import SampleTable
    from factory.store.schema import LABEL_COLUMNS
    from factory.views.sample_text import labelled_trajectories

    samples = SampleTable(store.location.uri, store.location.options)
    digests = samples.table(["label_vocabulary"])["label_vocabulary"].to_pylist()
    labelled = next((i for i, digest in enumerate(digests) if digest is not None), None)
    if labelled is None:
        return None
    return labelled_trajectories(samples.sample(labelled, ["attempt_id", *LABEL_COLUMNS]), file)


def _write_sample(format: str, store: "Store", row: Row, path: Path) -> None:
    """One sample as one file."""
    logged = logged_drive(store, row["clip_id"], row["settings_hash"])
    if format == "mcap":
        from factory.views.episode_messages import episode_of

        path.write_bytes(episode_of(row, logged))
    else:
        from factory.views.pictures import write_mp4
        from factory.views.rendered_again import load_scene, sample_film, scene_digest_of

        digest = scene_digest_of(store, row)
        write_mp4(path, sample_film(row, None if digest is None else load_scene(store, digest), logged))


CAMERAS = "nuscenes-cameras"


@dataclass(frozen=True)
class ImportRequest:
    """The command line."""

    source: Literal["simscale", "navhard", "navtest", "nuscenes-cameras"] = field(metadata=POSITIONAL)
    root: str
    out: str
    maps: str | None = None
    rewards: str | None = None
    vocabulary: str | None = None
    pictures: bool = True
    only: tuple[str, ...] = ()
    logs: str | None = None
    sensors: str | None = None
    split: str | None = None
    version: str | None = None
    sweeps: bool = True

    def __post_init__(self) -> None:
        if self.source == CAMERAS:
            return
        if self.version is not None or not self.sweeps:
            raise ValueError(f"version= and sweeps= are of import {CAMERAS}")
        if (self.rewards is None) != (self.vocabulary is None):
            raise ValueError("rewards= and vocabulary= go together: scores mean nothing without their trajectories")
        if self.source != "simscale":
            needed = ("logs", "maps", "split") if self.source == "navhard" else ("maps", "split")
            if missing := [name for name in needed if getattr(self, name) is None]:
                takes = ", ".join(f"{name}=" for name in needed)
                raise ValueError(f"{missing[0]}=... is missing: import {self.source} takes {takes}")
            if (self.sensors is None) == self.pictures:
                raise ValueError("sensors= and pictures=: give the folder of pictures, or pictures=false")


def import_(request: ImportRequest) -> int:
    """`python -m factory import simscale|navhard|navtest|nuscenes-cameras root=<folder> out=<...>`: others' data.

        python -m factory import simscale root=SimScale_data out=runs/simscale maps=nuplan/maps
        python -m factory import simscale root=exported out=runs/back only=[synthetic_reaction_pdm_v1.0-0]
        python -m factory import simscale root=SimScale_data out=runs/simscale rewards=traj_pdm vocabulary=16384.npy

    simscale: the released layout, moved into NAVSIM's folders or as unpacked, and what `export navsim` wrote, human
    samples too. One row for each log, which `train`, `show`, `dashboard`, `report` and `export` take as any other
    (`data.sim=[runs/simscale]`).
        maps=<folder>        nuPlan's, for lanes, route and lights of each row; without it these columns are empty
        rewards=<folder>     reward pickles, or one of them; with vocabulary=<.npy> they become the rows' labels
        pictures=false       rows without pictures
        only=[a,b]           these of the folders alone
    navhard: NAVSIM's two-stage benchmark, which `python -m planners evaluate benchmark=<out>` takes.
        python -m factory import navhard root=navhard_two_stage logs=navsim_logs/test sensors=sensor_blobs/test \\
            maps=maps split=.../train_test_split/navhard_two_stage.yaml out=runs/navhard
        root=<folder>        synthetic_scene_pickles and sensor_blobs of the second stage
        logs=, sensors=      of the first stage; pictures=false needs no sensors
        split=<.yaml>        whose reactive_all_mapping says which scenes belong together
    navtest: its one-stage benchmark, the frames that a scene filter or split names, for the same `evaluate`.
        python -m factory import navtest root=navsim_logs/test sensors=sensor_blobs/test maps=maps \\
            split=.../train_test_split/navtest.yaml out=runs/navtest
        root=<folder>        the logs; sensors=, pictures= and maps= as above
    nuscenes-cameras: where nuScenes' photos and lidar are, as sidecars of ScenarioNet's logs (docs/photos.md), one
    file a scene below out=, which `clips=scenarionet clips.cameras=<out> clips.sensor_root=<root>` takes.
        python -m factory import nuscenes-cameras root=/data/nuscenes version=v1.0-mini out=/data/photos
        root=<folder>        samples, sweeps, v1.0-*; nothing of it is copied
        version=v1.0-mini    of the tables; needed where several are there
        sweeps=false         keyframes alone: photos at 2 Hz instead of 12; lidar is always that of keyframes
        only=[scene-0103]    these scenes alone
    The same command again goes on, and tries what failed once more. What is kept and what is lost: docs/navsim.md.
    """
    if request.source == CAMERAS:
        return _import_nuscenes_cameras(request)
    from deltalake.exceptions import DeltaError

    from factory.files import why_unusable
    from factory.readers.base import BadClip
    from factory.store.location import Location
    from factory.store.samples import ChangedRun, Store
    from factory.store.table import AnotherWriter
    from factory.views.status import failure_summary

    if unusable := why_unusable(request.out):
        raise Refused(unusable)
    try:
        store = Store(Location.parse(request.out))
        summary, said = find_function("IMPORTS", request.source)(request, store)
    except (BadClip, ChangedRun, AnotherWriter, ValueError, OSError, ImportError, DeltaError) as error:
        raise Refused(one_line(error)) from error
    counts = summary.counts
    print(f"{counts['accepted']:,} samples imported, {summary.executed.found_done:,} were there: {store.location.uri}")
    for line in filter(None, (summary.message, said, failure_summary(store) if counts["failed"] else "")):
        print(line)
    return summary.exit_code


def _import_nuscenes_cameras(request: ImportRequest) -> int:
    """Write the sidecars and say what each holds. Raises Refused."""
    from factory.readers.base import BadClip

    root, out = Path(request.root), Path(request.out)
    photos = 0
    try:
        for done in find_function("SIDECARS", request.source)(root, out, request.version, request.only, request.sweeps):
            photos += done.photos
            where = f"{done.photos:,} photos of {done.cameras} cameras, {done.sweeps} sweeps: {done.path}"
            print(f"{done.scene}  {where if done.photos else 'no photo is there: no sidecar'}")
            if done.missing:
                print(f"  {len(done.missing):,} files of the tables are not there, such as {done.missing[0]}")
    except (BadClip, ValueError, OSError) as error:
        raise Refused(one_line(error)) from error
    if not photos:
        raise Refused(f"{root}: none of the photos that its tables name is there; unpack samples/ and sweeps/ into it")
    return 0


SCENE_KEYS = {  # of each action
    "info": (),
    "export": ("to", "format", "out", "rasterize"),
    "import": ("to", "like", "origin", "traversal", "transforms", "antialiased"),
    "build": ("to", "root", "width", "masks", "settings"),
    "film": ("to", "root", "width", "camera", "aside", "turn"),
    "serve": ("host", "port", "root", "pinhole", "usdz", "settings"),
}
OWN_SIZE = ("render.width", "render.height")  # of runs: width= is that of scene build
SCENE_WIDTH, FILM_WIDTH = 480, 640  # pixels, of photos that are no narrower


@dataclass(frozen=True)
class SceneRequest:
    """The command line."""

    action: Literal["info", "export", "import", "build", "film", "serve"] = field(metadata=POSITIONAL)
    files: tuple[str, ...] = field(metadata=POSITIONAL)
    to: str | None = None
    like: str | None = None
    origin: str | None = None
    format: Literal["ply", "spz", "ckpt"] | None = None
    rasterize: Literal["classic", "antialiased"] | None = None
    traversal: int | None = None
    transforms: str | None = None
    antialiased: bool | None = None
    out: str | None = None
    root: str | None = None
    width: int | None = None
    masks: str | None = None
    camera: str | None = None
    aside: float | None = None
    turn: float | None = None
    host: str | None = None
    port: int | None = None
    pinhole: bool | None = None
    usdz: str | None = None
    settings: tuple[str, ...] = field(default=(), metadata=RUN_SETTINGS | GIVEN_ALONE)

    def __post_init__(self) -> None:
        if self.action == "film" and len(self.files) != 2:
            raise ValueError("scene film takes a scene and its cameras.json; see --help")
        if self.action == "serve" and len(self.files) > 2:
            raise ValueError("scene serve takes a run's out, or a scene and its cameras.json; see --help")
        if self.action not in ("info", "film", "serve") and len(self.files) != 1:
            raise ValueError(f"scene {self.action} takes one file; see --help")
        if self.action not in ("info", "serve") and self.to is None:
            raise ValueError(f"scene {self.action} takes to=...; see --help")
        takes = SCENE_KEYS[self.action]
        for word in self.settings:
            key = word.partition("=")[0]
            if self.action == "serve":
                fits, like = key == "render.backend" or key.partition(".")[0] == "traffic", "render.backend"
            else:
                fits, like = key.startswith("render.") and key not in OWN_SIZE, "render.fit.iterations"
            if "settings" not in takes or not fits:
                known = [f"{name}=" for name in (*request_keys(SceneRequest), like)]
                raise ValueError(f"scene {self.action} takes no {key}=; see --help{did_you_mean(key, known)}")
        for name in [name for name in request_keys(SceneRequest) if name not in ("action", "files")]:
            if getattr(self, name) is not None and name not in takes:
                raise ValueError(f"scene {self.action} takes no {name}=; see --help")
        if self.action == "export" and self.out is not None and self.format != "ckpt":
            raise ValueError("out= brings vehicles' poses into a checkpoint: format=ckpt")
        if self.rasterize is not None and self.out is None:
            raise ValueError("rasterize= goes with out=: opacities depend on where the cameras drove")
        if self.like is not None and self.origin is not None:
            raise ValueError("give origin= or like=: the other scene has an origin of its own")
        if self.width is not None and self.width < 16:
            raise ValueError(f"width={self.width}: must be 16 pixels or more")
        if self.port is not None and not 0 <= self.port < 1 << 16:
            raise ValueError(f"port={self.port}: must be from 0, for a free one, to 65535")
        if self.action == "film" and not str(self.to).endswith(".mp4"):
            raise ValueError(f"to={self.to}: must end in .mp4")
        for name, value in (("aside", self.aside), ("turn", self.turn)):
            if value is not None and not abs(value) <= 180.0:
                raise ValueError(f"{name}={value}: must be a number from -180 to 180")


def scene(request: SceneRequest) -> None:
    """`python -m factory scene info|export|import|build|film|serve ...`: scenes of 3D Gaussians, one file each.

    info SCENE...                       what is in it: Gaussians, nodes, sky, range, quality, digest
    export SCENE to=FOLDER              background.ply, one node-<track id>.ply a vehicle, sky.png, scene.json
    export SCENE to=FOLDER format=spz   the same, a tenth the size; format=ckpt: checkpoints, of the background as of
                                        WorldEngine, of vehicles as of nerfstudio's splatfacto
    export SCENE to=FOLDER format=ckpt out=RUN   as WorldEngine and AlpaSim's MTGS server lay a scene out, with a sky
                                        and the vehicles where the log had them by the run's prepared clips;
                                        rasterize=classic: opacities for that mode, AlpaSim's (default: antialiased)
    import FILE to=SCENE                a .ply, .spz or checkpoint (.ckpt, .pt, .pth: splatfacto, MTGS, WorldEngine) as
                                        a scene under a plain sky; origin=x,y,z puts it into the world [m]
    import FILE to=SCENE like=OTHER     the same with the origin, nodes, sky and range of another scene
    build cameras.json to=SCENE         a scene of photos and their poses (docs/photos.md), fitted and measured as in a
                                        run; the same command goes on where it was stopped
    film SCENE cameras.json to=MP4      photo beside the scene from aside=1 m to the left of it (below 0: to the right),
                                        turned by turn=0 degrees to the left; camera=NAME: not the one that looks ahead
    serve RUN                           its clips' scenes and traffic for AlpaSim, by gRPC (docs/alpasim.md)
    serve SCENE cameras.json            the pictures of one that was built so; port=50051 host=127.0.0.1, pinhole=true:
                                        cameras are told without distortion; render.backend=, traffic=, traffic.*;
                                        usdz=FOLDER: writes there what AlpaSim's runtime lists scenes by

    traversal=N takes the colours of an MTGS checkpoint's N-th traversal (default: their mean), transforms=FILE
    takes back nerfstudio's dataparser_transforms.json. antialiased=true|false: how a file was made to be drawn
    (rasterize_mode of gsplat), where it does not say so; .spz, MTGS and WorldEngine do, of others it is that of
    like=, or false.

    root=FOLDER is what paths in cameras.json count from (default: its folder), width=N that of the pictures in pixels
    (default: 480 of a scene, 640 of a film, or the photos'). build takes masks=FOLDER|none of the car that carries the
    cameras (default: found in the photos), and a run's settings render.*, such as render.fit.iterations=4000.

    The .ply files are standard 3D Gaussian splatting (gsplat, nerfstudio, SuperSplat). A background is in metres
    from the scene's origin, a node in its box's frame. A block's scene lies in <out>/cache/block-*.safetensors; an
    edited one put back under the same name is what the next run draws.
    """
    from factory.readers.base import BadClip
    from factory.stages.scene_file import read_scene, write_scene
    from factory.views.scene_files import (
        classic_scene,
        export_scene,
        info_text,
        logged_rig,
        logged_vehicles,
        read_splats,
        scene_from_splats,
    )
    from factory.views.status import open_store
    from tasks.render.splatting.formats import LoggedVehicle
    from tasks.render.splatting.gsplat_backend import BackendMissing

    file, to = Path(request.files[0]), Path(request.to or "")
    try:
        match request.action:
            case "info":
                print("\n\n".join(info_text(path, read_scene(path)) for path in map(Path, request.files)))
            case "export":
                asset, vehicles, unseen, rig = read_scene(file), list[LoggedVehicle](), list[str](), None
                if request.out is not None:
                    store = open_store(request.out)
                    vehicles, unseen = logged_vehicles(store, asset)
                    rig = logged_rig(store, asset)
                    if request.rasterize == "classic":
                        asset, vehicles = classic_scene(asset, vehicles, rig)
                print("\n".join(map(str, export_scene(asset, to, f".{request.format or 'ply'}", vehicles, rig))))
                if unseen:
                    print(f"left out    {', '.join(unseen)}: no clip of the run shows them here")
            case "import":
                transforms = None if request.transforms is None else Path(request.transforms)
                found = read_splats(file, request.traversal, transforms)
                print(
                    info_text(
                        to, write_scene(to, scene_from_splats(found, request.like, request.origin, request.antialiased))
                    )
                )
                if found.left_out:
                    print(f"left out    {', '.join(found.left_out)}: bodies that bend need their network")
            case "build":
                _build_scene(request, file, to)
            case "film":
                _film_scene(request, read_scene(file), Path(request.files[1]), to)
            case "serve":
                _serve_scenes(request)
    except (BadClip, BackendMissing, ValueError, OSError) as error:
        raise Refused(str(error)) from error


def _build_scene(request: SceneRequest, sidecar: Path, to: Path) -> None:
    """Fit, and say what came out. Raises ValueError, BadClip, BackendMissing and OSError."""
    from factory.config.compose import compose, fill
    from factory.stages.assets import load_or_build_scene, scene_path, why_no_scene
    from factory.stages.sensors import choose_cameras, files_of_cameras, refuse_unknown_masks
    from factory.views.scene_files import info_text
    from tasks.render.scene.engine import require_backend
    from tasks.render.settings import RenderSettings

    if to.is_dir():
        raise ValueError(f"to={to}: is a folder; name a file in it")
    drive, began = _read_drive(request, sidecar), time.monotonic()
    words = [] if request.masks is None else [f"render.own_body={request.masks}"]
    settings = fill(RenderSettings, compose("run", [*words, *request.settings])["render"], "render")
    cameras = choose_cameras(drive.cameras, settings.cameras)
    width = request.width or min(cameras[0].width, SCENE_WIDTH)
    settings = replace(settings, width=width, height=round(width * cameras[0].height / cameras[0].width))
    refuse_unknown_masks(settings.own_body, drive.cameras)
    require_backend(settings.backend)
    if why := why_no_scene(drive, settings):
        raise ValueError(f"{sidecar}: {why}")
    parts = to.with_name(f"{to.name}.parts")  # what is half done, by what it is made of
    with progress_on_stderr("factory.stages"):
        asset = load_or_build_scene(drive, settings, parts, os.cpu_count() or 1)
    assert asset is not None
    scene_path(drive, settings, parts).replace(to)
    shutil.rmtree(parts)
    photos, took_s = files_of_cameras(cameras, drive.block.images), time.monotonic() - began
    print(info_text(to, asset))
    print(
        f"made of     {len(photos):,} photos of {len(cameras)} cameras, {len(drive.block.sweeps):,} sweeps, "
        f"in {time_text(took_s)}"
    )


@contextmanager
def progress_on_stderr(name: str) -> Iterator[None]:
    """What the modules below `name` log of their work, line by line."""

    class Plain(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            return re.sub(r"^block-\w+: ", "", super().format(record))

    told, logger = logging.StreamHandler(), logging.getLogger(name)
    told.setFormatter(Plain())
    level = logger.level
    logger.addHandler(told)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(told)
        logger.setLevel(level)


def _film_scene(request: SceneRequest, asset: "RenderAsset", sidecar: Path, to: Path) -> None:
    """Write the film. Raises ValueError, BadClip and OSError."""
    import numpy as np

    from factory.stages.sensors import choose_cameras
    from factory.views.pictures import write_mp4
    from factory.views.rendered_again import shifted_film
    from tasks.world.clip import front_camera

    drive = _drive_of_scene(request, asset, sidecar)
    axes = np.array([camera.ego_from_camera[:2, 2] for camera in drive.cameras])
    ahead = front_camera([camera.name for camera in drive.cameras], axes) or drive.cameras[0].name
    (camera,) = choose_cameras(drive.cameras, [request.camera or ahead])
    times_s = [file.time_s for file in drive.block.images if file.sensor == camera.name]
    rate = round(1.0 / float(np.median(np.diff(times_s)))) if len(times_s) > 1 else 1
    aside_m, width = 1.0 if request.aside is None else request.aside, request.width or min(camera.width, FILM_WIDTH)
    write_mp4(to, shifted_film(asset, drive, camera, aside_m, request.turn or 0.0, width), max(rate, 1))
    print(f"{to.resolve()}: {len(times_s)} photos of {camera.name}, {max(rate, 1)} a second")


def _serve_scenes(request: SceneRequest) -> None:
    """Answer until the process is asked to end. Raises ValueError, BadClip, BackendMissing, OSError and Refused."""
    from factory.alpasim.artifact import write_artifacts
    from factory.alpasim.scenes import Scenes, scene_of_drive, scenes_of_run
    from factory.alpasim.sensors import Sensors
    from factory.alpasim.traffic import Traffic
    from factory.alpasim.wire import serve
    from factory.config.compose import compose, fill
    from factory.stages.scene_file import read_scene
    from tasks.render.scene.engine import require_backend
    from tasks.render.settings import RenderSettings
    from tasks.settings import TrafficSettings

    composed = compose("run", request.settings)
    backend = fill(RenderSettings, composed["render"], "render").backend
    traffic = fill(TrafficSettings, composed["traffic"], "traffic")
    require_backend(backend)
    if len(request.files) == 1:
        scenes = scenes_of_run(open_store(request.files[0]))
    else:
        sidecar, asset = Path(request.files[1]), read_scene(Path(request.files[0]))
        served = scene_of_drive(_drive_of_scene(request, asset, sidecar), asset)
        scenes = Scenes({asset.digest: lambda: served})
    if not scenes.ids:
        raise ValueError(f"{request.files[0]}: no clip's scene is kept there: none was built, or the cache is gone")
    services = [Sensors(scenes, backend, request.pinhole or False).service, Traffic(scenes, traffic).service]
    print(f"{len(scenes.ids)} scenes, such as {scenes.ids[0]}", flush=True)
    if request.usdz is not None:
        write_artifacts(scenes, Path(request.usdz))
    serve(services, request.host or "127.0.0.1", 50051 if request.port is None else request.port)


def _drive_of_scene(request: SceneRequest, asset: "RenderAsset", sidecar: Path) -> "PhotoDrive":
    """The drive that a scene was built of. Raises ValueError, BadClip."""
    drive = _read_drive(request, sidecar)
    if asset.block is None or (asset.block.log_id, asset.block.start_s) != (drive.log_id, drive.block.start_s):
        raise ValueError(f"{request.files[0]}: is no scene that was built of {sidecar}")
    return drive


def _read_drive(request: SceneRequest, sidecar: Path) -> "PhotoDrive":
    """What a sidecar says without a log. Raises BadClip."""
    drive: PhotoDrive = find_function("DRIVES", "photos")(sidecar, Path(request.root or sidecar.parent))
    return drive
