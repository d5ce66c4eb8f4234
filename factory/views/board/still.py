"""The dashboard as one file: its page, style and scripts, the answers to what it asks, and pictures of some samples.

Scripts and numbers are those of the live page; nothing is fetched, and the file's own policy forbids it.
"""

import base64
import json
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any

from factory.store.reader import decode_stored_image
from factory.store.samples import Store
from factory.store.schema import NOW_INDEX
from factory.views.board.drives import Drives, drives_as_json
from factory.views.board.gallery import Pictures, card_of, failures, gallery, place_of, whole
from factory.views.board.overview import overview
from factory.views.board.server import STATIC
from factory.views.board.watch import Snapshot
from factory.views.examples import CAMERA_PX, few_of_each, spread
from factory.views.sample_picture import front_camera, images_at_now, small_jpeg

N_SAMPLES = 18  # in the gallery, each with a page and some 150 kB of pictures
N_LOOKS = 6  # the newest simulated ones, as the overview asks for them
N_FAILED = 200
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)


def still_page(store: Store, shot: Snapshot, pictures: Pictures, extra: Mapping[str, Any]) -> bytes:
    """The file.

    extra: what the live page does not show: facts, settings, scenes, left_out, rejected, strips (static/extra.js reads
    it).
    """
    looks = gallery(shot, {"simulated": "1"}, 1, N_LOOKS)
    items = [card_of(shot, row) for row in _shown(shot, [item["attempt_id"] for item in looks["items"]])]
    kept: dict[str, str] = {}
    answers: dict[str, Any] = {
        "/api/overview": overview(shot, store.location.uri, time.time()),
        f"/api/samples?size={N_LOOKS}&simulated=1": looks,
        "/api/samples": {"total": shot.samples.num_rows, "page": 1, "pages": 1, "items": items},
        "/api/failed?page=1": failures(shot, 1, N_FAILED) | {"pages": 1},
        "/api/drives": drives_as_json(Drives(store.location).rows(), with_films=False),
    }
    ids = [item["attempt_id"] for item in items]
    for i, attempt_id in enumerate(ids):
        found = whole(shot, attempt_id, row := pictures.row(shot, attempt_id), store.candidates)
        newer, older = ids[i - 1] if i else None, ids[i + 1] if i + 1 < len(ids) else None
        images = _with_pictures(found, row, kept)
        answers[f"/api/samples/{attempt_id}"] = found | {"images": images, "newer": newer, "older": older}
        kept[f"{attempt_id}/bev.jpg"] = _text(pictures.bev(shot, attempt_id, 600, NOW_INDEX))
    return _document({"answers": answers, "pictures": kept, "extra": extra})


def _shown(shot: Snapshot, always: Sequence[str]) -> list[Mapping[str, Any]]:
    """Rows of samples, newest first: some that must be there, and others as unlike each other as can be."""
    rows = few_of_each(shot.samples.select(["attempt_id", "expert", "clip_id", "round"]), "expert")
    varied = spread(rows, lambda r: (r["expert"], r["clip_id"], r["round"]), lambda r: str(r["attempt_id"]))
    ids = list(dict.fromkeys([*always, *(row["attempt_id"] for row in varied)]))[:N_SAMPLES]
    return [shot.newest(place) for place in sorted(place_of(shot, attempt_id) for attempt_id in ids)]


def _with_pictures(found: Mapping[str, Any], row: Mapping[str, Any], kept: dict[str, str]) -> list[dict[str, Any]]:
    """A sample's images at now alone, which are kept, small."""
    at_now = {(image["camera"], float(image["time_s"])): image for image in images_at_now(row)}
    images = []
    for image in found["images"]:
        stored = at_now.get((image["camera"], image["time_s"]))
        try:
            small = None if stored is None else _text(small_jpeg(decode_stored_image(stored), CAMERA_PX))
        except ValueError:  # the page says that there is no picture
            continue
        if small is None:
            continue
        images.append(image)
        kept[f"{row['attempt_id']}/{image['index']}.jpg"] = small
        if image["camera"] == front_camera(row):
            kept[f"{row['attempt_id']}/front.jpg"] = small
    return images


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _document(kept: Mapping[str, Any]) -> bytes:
    """index.html with everything that it names inside; data is JSON in which no tag can begin."""
    scripts = {
        path.stem: "data:text/javascript;base64," + _text(_bare(path.read_text(encoding="utf-8")).encode())
        for path in STATIC.glob("*.js")
    }
    data = json.dumps(kept, allow_nan=False).replace("<", "\\u003c")
    page = (STATIC / "index.html").read_text(encoding="utf-8")
    page, links = re.subn(r"<link [^>]*>\n|<script [^>]*></script>\n", "", page)
    assert links == 3, "index.html names an icon, a style and a script"
    style = (STATIC / "board.css").read_text(encoding="utf-8")
    inside = (
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n<style>{style}</style>\n'
        f'<script type="importmap">{json.dumps({"imports": scripts})}</script>\n'
        f'<script type="application/json" id="kept">{data}</script>\n'
        '<script type="module">import "app";</script>\n</head>'
    )
    return page.replace("</head>", inside).encode()


def _bare(script: str) -> str:
    """Its imports by bare names, which the import map knows: a data: URL has no neighbours."""
    return re.sub(r'from "\./(\w+)\.js"', r'from "\1"', script)
