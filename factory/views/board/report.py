"""A run as one HTML file: the dashboard's page, style and scripts, the answers to what it asks, and some pictures.

Scripts and numbers are those of the live page; nothing is fetched, and the file's own policy forbids it.
"""

import base64
import hashlib
import json
import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory import __version__
from factory.config.arguments import Refused
from factory.files import DamagedFile
from factory.store.reader import decode_stored_image
from factory.store.samples import CURRENT_RUN, FACTS, LAST_RUN, RUN_FILE, Store
from factory.store.schema import NOW_INDEX
from factory.store.table import text_equals
from factory.views.board.gallery import Pictures, failures, gallery, gallery_card, newest_first_place, sample_page
from factory.views.board.overview import Drives, drives_as_json, overview
from factory.views.board.server import STATIC
from factory.views.board.watch import Snapshot, Watch
from factory.views.card import write_card, written_card
from factory.views.pictures import front_camera, images_at_now, small_jpeg
from factory.views.status import value_counts
from tasks.caches import json_with_checksum

if TYPE_CHECKING:
    from factory.setup.settings import Run

N_SAMPLES = 18  # in the gallery, each with a page and some 150 kB of pictures
N_LOOKS = 6  # the newest simulated ones, as the overview asks for them
N_FAILED = 200
N_VARIED = 24
PER_EXPERT = 200  # samples that `spread` looks at
CAMERA_PX = 320  # width of a camera frame on the page
FILE = "report.html"
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)


def write_report(store: Store, to: str | None = None) -> str:
    """Write the file, into `out` where no other place is named; where it is now. Raises Refused where it cannot be."""
    extra: dict[str, Any] = store.document(FACTS)
    shot, pictures = Watch(store).snapshot(), Pictures(store)
    settings = store.runs()[-1]["settings"] if store.runs() else {}
    extra["settings"] = {name: str(value) for name, value in settings.items()}
    page = report_page(store, shot, pictures, extra)
    if to is None:
        store.location.write(FILE, page)
        return f"{store.location.uri}/{FILE}"
    try:
        Path(to).expanduser().write_bytes(page)
    except OSError as error:
        raise Refused(f"to={to}: {error}") from error
    return str(Path(to).expanduser().resolve())


def write_pages(store: Store, assembled: "Run") -> tuple[str, str]:
    """Report and card at the end of a run, and report.json for later ones; where each is, as their writers say it.

    Pages that were made of the same tables, files and facts by this version stay as they are.
    """
    facts, made_of, known = run_facts(assembled), hashlib.sha256(__version__.encode()), dict[str, Any]()
    rows = [sorted(table.live_files()) for table in store.tables]
    made_of.update(json.dumps([facts, rows, Drives(store.location).files]).encode())
    for name in (RUN_FILE, CURRENT_RUN, LAST_RUN):
        made_of.update(store.location.read(name) or b"-")
    digest = made_of.hexdigest()
    with suppress(DamagedFile):
        known = store.document(FACTS)
    if known.get("pages_of") == digest and store.location.has(FILE) and (there := written_card(store)):
        return f"{store.location.uri}/{FILE}", there
    store.location.write(FACTS, json_with_checksum(facts).encode())
    where = write_report(store), write_card(store)
    store.location.write(FACTS, json_with_checksum(facts | {"pages_of": digest}).encode())
    return where


def run_facts(assembled: "Run") -> dict[str, Any]:
    """What the tables do not say of a run."""
    config, index, vocabulary = assembled.config, assembled.index, assembled.work.vocabulary
    n_found = len(index.refs) + len(index.broken)
    planned = n_found if config.limit is None else min(config.limit, n_found)
    return {
        "facts": {
            "clips of the newest run": f"{planned} of {n_found} found",
            "rounds": str(config.rounds),
            "experts": ", ".join(config.experts),
            "vocabulary": f"{len(vocabulary.trajectories)} trajectories, {Path(vocabulary.source).name}",
        },
        "left_out": {  # what the reader did not give, and why
            "Filtered windows": {reason: f"{count} windows" for reason, count in index.dropped.items()},
            "Skipped logs": dict(index.skipped_logs),
            "Broken logs": {f"{ref.log_id} at {ref.start_ms} ms": why for ref, why in index.broken.items()},
        },
    }


def report_page(store: Store, shot: Snapshot, pictures: Pictures, extra: Mapping[str, Any]) -> bytes:
    """The file.

    extra: what the live page does not show: facts, settings, left_out.
    """
    looks = gallery(shot, {"simulated": "1"}, 1, N_LOOKS)
    items = [gallery_card(shot, row) for row in _shown(shot, [item["attempt_id"] for item in looks["items"]])]
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
        found = sample_page(shot, attempt_id, row := pictures.row(shot, attempt_id), store.candidates)
        newer, older = ids[i - 1] if i else None, ids[i + 1] if i + 1 < len(ids) else None
        images = _with_pictures(found, row, kept)
        answers[f"/api/samples/{attempt_id}"] = found | {"images": images, "newer": newer, "older": older}
        kept[f"{attempt_id}/bev.jpg"] = _text(pictures.bev(shot, attempt_id, 600, NOW_INDEX))
    return _document({"answers": answers, "pictures": kept, "extra": extra})


def _shown(shot: Snapshot, always: Sequence[str]) -> list[Mapping[str, Any]]:
    """Rows of samples, newest first: some that must be there, and others as unlike each other as can be."""
    ids = list(dict.fromkeys([*always, *varied_sample_ids(shot.samples)]))[:N_SAMPLES]
    return [shot.newest(place) for place in sorted(newest_first_place(shot, attempt_id) for attempt_id in ids)]


def varied_sample_ids(samples: pa.Table) -> list[str]:
    """Ids of a few samples, each next one the least like those before it in expert, clip and round, then by its id.

    The same samples in any order give the same list.
    """
    rows = samples.select(["attempt_id", "expert", "clip_id", "round"])
    left: list[tuple[str, list[tuple[str, Any]]]] = []
    for expert in value_counts(rows["expert"]):
        of_expert = rows.take(np.flatnonzero(text_equals(rows["expert"], expert)))
        few = pc.select_k_unstable(of_expert, PER_EXPERT, [("attempt_id", "ascending")])
        left += [(str(row.pop("attempt_id")), list(row.items())) for row in of_expert.take(few).to_pylist()]
    left.sort(key=lambda row: row[0])
    used: Counter[tuple[str, Any]] = Counter()
    chosen: list[str] = []
    while left and len(chosen) < N_VARIED:
        best = min(range(len(left)), key=lambda i: (sum(used[value] for value in left[i][1]), i))
        attempt_id, values = left.pop(best)
        chosen.append(attempt_id)
        used.update(values)
    return chosen


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
    scripts = {}
    for path in STATIC.glob("*.js"):  # imports by bare names, which the import map knows: a data: URL has no neighbours
        script = re.sub(r'from "\./(\w+)\.js"', r'from "\1"', path.read_text(encoding="utf-8"))
        scripts[path.stem] = f"data:text/javascript;base64,{_text(script.encode())}"
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
