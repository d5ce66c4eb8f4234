"""A drive as a film at 10 Hz: from above, and what the front camera saw when the plan of the moment was made."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from factory.store.location import Location
from factory.store.reader import decode_stored_image
from factory.views.board.overview import FILMS
from factory.views.pictures import (
    BACKGROUND,
    EXPERT,
    LOGGED,
    PERTURBED,
    Boxes,
    DrawnPath,
    draw_bev,
    front_camera,
    letterboxed,
    map_shapes,
    write_mp4,
    write_text,
)
from planners.drive.alpasim_score import AlpasimColumns, failure_reason
from planners.drive.loop import PLAN_STEPS, ClosedLoopDrive
from tasks.world.arrays import Image
from tasks.world.clip import STEP_S
from tasks.world.frames import HEADING, VX

BEV_PX, CAMERA_PX = (560, 560), (720, 405)  # width, height
HOLD = 10  # pictures that the end is shown for


Rig = Sequence[Mapping[str, Any]] | None  # the column `cameras`


def write_film(
    out: Location, drive_id: str, made: ClosedLoopDrive, columns: AlpasimColumns, rig: Rig, title: str
) -> str:
    """The film's file under `out`, written whole."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "drive.mp4")
        write_mp4(path, film_frames(made, columns, rig, title))
        out.child(FILMS).write(f"{drive_id}.mp4", path.read_bytes())
    return f"{FILMS}/{drive_id}.mp4"


def film_frames(made: ClosedLoopDrive, columns: AlpasimColumns, rig: Rig, title: str) -> Iterator[Image]:
    """RGB pictures (560, 1280, 3), one each 0.1 s, the last several times."""
    sheet = None
    for step in range(made.n_steps + 1):
        sheet = _sheet(made, columns, rig, title, step)
        yield sheet
    if sheet is not None:
        yield from [sheet] * HOLD


def _sheet(made: ClosedLoopDrive, columns: AlpasimColumns, rig: Rig, title: str, step: int) -> Image:
    clip, pose = made.start.scene.clip, made.ego_states[step, : HEADING + 1]
    ways = [
        DrawnPath(clip.ego_states[made.start.scene.step :, : HEADING + 1], LOGGED, "logged", dashed=True),
        DrawnPath(made.ego_states[: step + 1], PERTURBED, "driven"),
    ]
    planned = min(step // PLAN_STEPS, len(made.plans) - 1)
    if planned >= 0:
        ways.append(DrawnPath(made.plans[planned], EXPERT, "plan", dashed=True))
    shapes = map_shapes(clip, made.start.scene.step + step)
    boxes = Boxes(made.agents.boxes[step], made.agents.kinds)
    bev = draw_bev(pose, shapes, boxes, pose, ways, f"{title}  t = {step * STEP_S:.1f} s", BEV_PX)
    sheet = np.full((BEV_PX[1], BEV_PX[0] + CAMERA_PX[0], 3), BACKGROUND, np.uint8)
    sheet[:, : BEV_PX[0]] = bev
    images = made.images[planned] if planned >= 0 else ()
    front = front_camera({"images": images, "cameras": rig})
    if front is not None:
        seen = next(image for image in images if image["camera"] == front)
        sheet[: CAMERA_PX[1], BEV_PX[0] :] = letterboxed(decode_stored_image(seen), *CAMERA_PX)
    for row, line in enumerate(_lines(made, columns, front, step, planned)):
        write_text(sheet, line, (BEV_PX[0] + 12, CAMERA_PX[1] + 26 + 24 * row), 0.5)
    return sheet


def _lines(made: ClosedLoopDrive, columns: AlpasimColumns, front: str | None, step: int, planned: int) -> list[str]:
    seen = "sees no pictures" if front is None else f"camera {front} at {planned * PLAN_STEPS * STEP_S:.1f} s"
    told = [seen, f"{made.ego_states[step, VX]:.1f} m/s"]
    if step == made.n_steps:
        progress, why = 100.0 * min(columns.progress_rel_to_total, 1.0), failure_reason(vars(columns))
        told.append(f"score {columns.score:.2f}, progress {progress:.0f} %{f', {why}' if why else ''}")
    return told
