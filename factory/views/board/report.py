"""A run as one HTML file: the dashboard with its answers and some pictures inside, nothing fetched."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factory.config.arguments import Refused

if TYPE_CHECKING:
    from factory.setup.settings import Run
    from factory.store.samples import Store
    from factory.views.examples import Picture

FILE = "report.html"
TOLD = "report.json"  # what only the newest run knows: its facts, what its reader left out, rejected attempts drawn


def write_report(store: "Store", to: str | None = None) -> str:
    """Write the file, into `out` where no other place is named; where it is now. Raises Refused where it cannot be."""
    from factory.views.board.gallery import Pictures
    from factory.views.board.still import still_page
    from factory.views.board.watch import Watch
    from factory.views.examples import strips_of
    from factory.views.scene_files import scene_tables

    told: dict[str, Any] = json.loads(store.location.read(TOLD) or b"{}")
    shot, pictures = Watch(store).now(), Pictures(store)
    shot.funnel  # noqa: B018  # counted first, while no picture takes memory
    told["strips"] = [
        strip | {"rows": {name: _plain(row) for name, row in strip["rows"].items()}}
        for strip in strips_of(store, shot.samples, partial(pictures.row, shot))
    ]
    told["scenes"] = scene_tables(Path(store.location.uri, "cache")) if store.location.is_local else {}
    settings = store.runs()[-1]["settings"] if store.runs() else {}
    told["settings"] = {name: str(value) for name, value in settings.items()}
    page = still_page(store, shot, pictures, told)
    if to is None:
        store.location.write(FILE, page)
        return f"{store.location.uri}/{FILE}"
    try:
        Path(to).expanduser().write_bytes(page)
    except OSError as error:
        raise Refused(f"to={to}: {error}") from error
    return str(Path(to).expanduser().resolve())


def remember(store: "Store", assembled: "Run") -> None:
    """Write report.json, for this report and later ones."""
    from factory.views.examples import Again, rejected_examples, rejected_rows

    config, index, vocabulary = assembled.config, assembled.index, assembled.work.vocabulary
    again = Again(store, assembled.work, {ref.clip_id: ref for ref in index.refs})
    drawn = rejected_examples(rejected_rows(store), again.picture)
    n_found = len(index.refs) + len(index.broken)
    planned = n_found if config.limit is None else min(config.limit, n_found)
    told = {
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
        "rejected": _plain(drawn),
    }
    store.location.write(TOLD, json.dumps(told).encode())


def _plain(pictures: "Sequence[Picture]") -> list[Mapping[str, Any]]:
    """As JSON has them."""
    return [
        asdict(one) | {"data": None if one.data is None else base64.b64encode(one.data).decode()} for one in pictures
    ]
