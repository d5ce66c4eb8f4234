"""A block's scene fitted to its photos, in stretches: a killed fit goes on where the last stretch ended."""

import json
import logging
import time
import zipfile
from pathlib import Path

import numpy as np

from factory.graph.work import Halted, Stopped, never
from factory.stages.sensors import SensorData
from factory.store.disk import whole_file
from factory.wording import time_text
from tasks.render.fit.losses import Lpips
from tasks.render.fit.reconstruct import advance, backend_of, finish
from tasks.render.fit.start import prepare
from tasks.render.fit.state import FitState
from tasks.render.scene.asset import RenderAsset
from tasks.render.settings import Backend, FitSettings
from tasks.sealed import check, seal
from tasks.world.agents import AgentTracks

STRETCH = 500  # iterations between two saves
BEGUN, SAID = ".fit.npz", ".fit.json"  # what is half done, and how far it is
FRESH_S = 120.0  # what was said longer ago is no news
log = logging.getLogger(__name__)


def fitted(
    path: Path,
    data: SensorData,
    agents: AgentTracks | None,
    settings: FitSettings,
    threads: int,
    stopped: Stopped = never,
    backend: Backend = Backend.CPU,
    lpips: Lpips | None = None,
) -> RenderAsset:
    """The scene of a block's sensors; what is half done lies beside `path`, where the scene will be stored.

    A fit that was killed or halted comes to the same bytes as one that was not. Raises Halted once it is `stopped`,
    with all of its iterations kept, ValueError without photos to learn from, and BackendMissing.
    """
    drawing = backend_of(backend, threads)
    problem, state = prepare(data.photos, data.sweeps, agents, settings, threads=threads, known=data.known)
    begun, said = path.with_suffix(BEGUN), path.with_suffix(SAID)
    state = _resumed(begun, state)
    first, began = state.iteration, time.monotonic()

    def say(iteration: int, loss: float, psnr_db: float) -> None:
        per_s = (iteration - first) / (time.monotonic() - began)
        left = time_text((settings.iterations - iteration) / per_s)
        text = f"fit {iteration}/{settings.iterations}, {per_s:.1f} iterations/s, {psnr_db:.1f} dB, ETA {left}"
        log.info("%s: %s, loss %.4f", path.stem, text, loss)
        said.write_text(json.dumps({"block": path.stem, "text": text}))

    while state.iteration < settings.iterations:
        advance(problem, state, settings, state.iteration + STRETCH, say, threads, stopped, drawing)
        arrays = state.arrays()
        with whole_file(begun, sum(array.nbytes for array in arrays.values())) as draft:
            with draft.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
            seal(draft, begun.name)
        if state.iteration < settings.iterations and stopped():
            said.unlink(missing_ok=True)
            raise Halted(f"{path.stem}: {state.iteration} of {settings.iterations} iterations are done")
    asset = finish(problem, state, threads, lpips)
    begun.unlink(missing_ok=True)
    said.unlink(missing_ok=True)
    return asset


def fits_going_on(folder: Path) -> list[str]:
    """How far each fit in a cache folder is, as it said itself in the last two minutes."""
    found = []
    for path in sorted(folder.glob(f"*{SAID}")):
        try:
            if time.time() - path.stat().st_mtime < FRESH_S:
                found.append(json.loads(path.read_text())["text"])
        except (OSError, ValueError, KeyError):  # ended, or is being written, at this moment
            continue
    return found


def _resumed(begun: Path, start: FitState) -> FitState:
    if not begun.exists():
        return start
    try:
        check(begun, begun.name)
        with np.load(begun, allow_pickle=False) as arrays:
            return FitState.from_arrays(dict(arrays))
    except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
        log.warning("%s is damaged (%s); the fit begins again", begun, error)
        return start
