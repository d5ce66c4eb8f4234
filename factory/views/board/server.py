"""The HTTP side of the dashboard: GET only, from loopback unless told otherwise.

| path | answer |
|---|---|
| `/` and `/static/...` | the page, its style and scripts |
| `/api/overview` | factory.views.board.overview.overview |
| `/api/samples?page=1&size=12&order=newest&expert=...` | factory.views.board.gallery.gallery; filters: FILTERS there |
| `/api/samples/<attempt_id>` | factory.views.board.gallery.sample_page |
| `/api/failed?page=1` | factory.views.board.gallery.failures |
| `/api/drives` | factory.views.board.overview.drives_as_json |
| `/picture/<attempt_id>/<name>.jpg` | a JPEG, see factory.views.board.gallery |
| `/film/<drive_id>.mp4` | a planner's drive as a film |
| `/episode/<attempt_id>.mcap` | the sample for Foxglove, Lichtblick or Rerun |

Answers of /api/ are the JSON that the named functions return; an error is `{"error": why}` with 400 (a
question put wrongly), 403 (asked under another host name), 404 (not there), 500 (a bug, with a line on stderr) or 503
(the tables cannot be read now).
"""

import json
import re
import socket
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import pyarrow as pa
from deltalake.exceptions import DeltaError

from factory.store.samples import Store
from factory.views.board.gallery import BadRequest, NotFound, Pictures, failures, gallery, sample_page
from factory.views.board.overview import Drives, drives_as_json, overview
from factory.views.board.watch import LOOK_EVERY_S, Watch
from factory.wording import one_line

# Who is connected to the dashboard: so many at most, and who asks nothing makes way for who comes.

LOOK_AGAIN_S = 0.1


class Connections:
    """At most `most` at once, a thread each."""

    def __init__(self, most: int) -> None:
        self._places, self._lock = threading.Semaphore(most), threading.Lock()
        self._idle: dict[socket.socket, None] = {}  # of which no whole request has come, the longest first
        self._all: set[socket.socket] = set()

    def admit(self, connection: socket.socket) -> None:
        """Wait for a place. The connection that has been idle for longest is closed for it."""
        while not self._places.acquire(blocking=False):
            self._hang_up_idlest()
            if self._places.acquire(timeout=LOOK_AGAIN_S):
                break
        with self._lock:
            self._all.add(connection)
            self._idle[connection] = None

    def mark_busy(self, connection: socket.socket) -> None:
        """It is being answered, and stays until it is."""
        with self._lock:
            self._idle.pop(connection, None)

    def mark_idle(self, connection: socket.socket) -> None:
        """It may ask again."""
        with self._lock:
            self._idle[connection] = None

    def release(self, connection: socket.socket) -> None:
        """Its place is free."""
        with self._lock:
            self._idle.pop(connection, None)
            if connection in self._all:
                self._all.remove(connection)
                self._places.release()

    def _hang_up_idlest(self) -> None:
        """Its thread, which waits for a request, finds the connection at its end."""
        with self._lock:
            if self._idle:
                idlest = next(iter(self._idle))
                del self._idle[idlest]
                with suppress(OSError):  # it has just been closed by who called
                    idlest.shutdown(socket.SHUT_RDWR)


STATIC = Path(__file__).parent / "static"
KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
SERVED = {path.name: path for path in STATIC.iterdir() if path.suffix in KINDS}
ATTEMPT_ID = re.compile(r"[0-9A-Za-z_-]{1,64}")
LOOPBACK = ("127.0.0.1", "localhost", "::1")
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Frame-Options": "DENY",
}
CONNECTIONS = 64  # at once; browsers open six
FOREVER = "private, max-age=86400, immutable"


@dataclass(frozen=True)
class Answer:
    """What goes back."""

    status: int
    kind: str
    body: bytes
    cache: str = "no-store"


class Board:
    """Answers questions about one store."""

    def __init__(self, store: Store, look_every_s: float = LOOK_EVERY_S) -> None:
        self.watch = Watch(store, look_every_s)
        self._store = store
        self._pictures = Pictures(store)
        self._drives = Drives(store.location)

    def answer(self, target: str) -> Answer:
        """The answer to GET `target`, path and query."""
        try:
            return self._answer(target)
        except BadRequest as error:
            return _json({"error": str(error)}, 400)
        except NotFound as error:
            return _json({"error": str(error.args[0])}, 404)
        except (DeltaError, OSError, pa.ArrowException) as error:
            return _json({"error": f"the tables cannot be read now: {error}"}, 503)

    def _answer(self, target: str) -> Answer:
        try:
            parts = urlsplit(target)
        except ValueError as error:
            raise BadRequest(f"no address: {error}") from error
        query = dict(parse_qsl(parts.query, keep_blank_values=True))
        match parts.path.split("/")[1:]:
            case [""]:
                return _static("index.html")
            case ["static", name]:
                return _static(name)
            case ["api", "overview"]:
                return _json(overview(self.watch.snapshot(), self._store.location.uri, time.time()))
            case ["api", "samples"]:
                page, size = _pop_number(query, "page", 1), _pop_number(query, "size", 12)
                order = query.pop("order", "newest")
                return _json(gallery(self.watch.snapshot(), query, page, size, order))
            case ["api", "samples", attempt_id]:
                shot = self.watch.snapshot()
                row = self._pictures.row(shot, _valid_id(attempt_id))
                return _json(sample_page(shot, attempt_id, row, self._store.candidates))
            case ["api", "failed"]:
                return _json(failures(self.watch.snapshot(), _pop_number(query, "page", 1)))
            case ["api", "drives"]:
                return _json(drives_as_json(self._drives.rows()))
            case ["film", name]:
                film = self._drives.film(_valid_id(name.removesuffix(".mp4")))
                if film is None:
                    raise NotFound(f"no film {name}")
                return Answer(200, "video/mp4", film, FOREVER)
            case ["picture", attempt_id, name]:
                return self._picture(_valid_id(attempt_id), name, query)
            case ["episode", name]:
                attempt_id = _valid_id(name.removesuffix(".mcap"))
                return Answer(
                    200, "application/octet-stream", self._pictures.episode(self.watch.snapshot(), attempt_id)
                )
        raise NotFound(f"nothing is at {parts.path}")

    def _picture(self, attempt_id: str, name: str, query: dict[str, str]) -> Answer:
        shot = self.watch.snapshot()
        if name == "front.jpg":
            data = self._pictures.front(shot, attempt_id)
        elif name == "bev.jpg":
            data = self._pictures.bev(shot, attempt_id, _pop_number(query, "size", 300), _pop_number(query, "step", 15))
        elif re.fullmatch(r"[0-9]{1,4}\.jpg", name):
            small = query.get("small") == "1"
            data = self._pictures.image(shot, attempt_id, int(name.removesuffix(".jpg")), small)
        else:
            raise NotFound(f"no picture {name}: there are front.jpg, bev.jpg and <n>.jpg")
        return Answer(200, "image/jpeg", data, FOREVER if "v" in query else "no-store")


def _valid_id(attempt_id: str) -> str:
    if not ATTEMPT_ID.fullmatch(attempt_id):
        raise NotFound("no sample of that name: an id is letters, digits, _ and -")
    return attempt_id


def _pop_number(query: dict[str, str], name: str, otherwise: int) -> int:
    """Takes it out of the query."""
    text = query.pop(name, str(otherwise))
    if not (text.isascii() and text.isdecimal() and len(text) < 9):
        raise BadRequest(f"{name}={text}: must be a number")
    return int(text)


def _json(value: Any, status: int = 200) -> Answer:
    return Answer(status, "application/json", json.dumps(value, allow_nan=False).encode())


def _static(name: str) -> Answer:
    if name not in SERVED:
        raise NotFound(f"no file {name}")
    return Answer(200, f"{KINDS[SERVED[name].suffix]}; charset=utf-8", SERVED[name].read_bytes(), "no-cache")


class Server(ThreadingHTTPServer):
    """Serves a board; a thread a connection, CONNECTIONS at most."""

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 128

    def __init__(self, board: Board, host: str, port: int) -> None:
        self.board, self.connections = board, Connections(CONNECTIONS)
        self.host_names = {*LOOPBACK, host} if host in LOOPBACK else None  # None: any
        super().__init__((host, port), Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        self.connections.admit(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        super().shutdown_request(request)
        self.connections.release(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """One line, and none where the other side has gone."""
        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            print(f"{client_address[0]}: {type(error).__name__}: {one_line(error)}", file=sys.stderr)


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "factory", ""
    timeout = 20  # seconds without a byte
    disable_nagle_algorithm = True  # with it, and headers and body sent apart, an answer waits 40 ms for nothing
    wbufsize = -1

    def do_GET(self) -> None:
        self.server.connections.mark_busy(self.connection)
        if {"content-length", "transfer-encoding"} & {name.lower() for name in self.headers}:
            self.close_connection = True  # a body is not read, and is no next request
        try:
            answer = self._answer()
        except Exception as error:  # the page goes on with the rest
            print(f"{self.path[:200]!r}: {type(error).__name__}: {one_line(error)}", file=sys.stderr)
            answer = _json({"error": "a bug: the dashboard's own output says which"}, 500)
        self._send(answer)
        self.server.connections.mark_idle(self.connection)

    def _answer(self) -> Answer:
        names = self.server.host_names
        if len(self.headers.get_all("Host", [])) > 1:
            return _json({"error": "more than one header Host"}, 400)
        try:
            asked = (urlsplit(f"//{self.headers.get('Host', '')}").hostname or "").lower()
        except ValueError:
            return _json({"error": "the header Host is none"}, 400)
        if names is not None and asked not in names:
            said = f"this server answers to {', '.join(sorted(names))}, not to {asked or 'no name'}"
            return _json({"error": said}, 403)
        return self.server.board.answer(self.path)

    def _send(self, answer: Answer) -> None:
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.body)))
        self.send_header("Cache-Control", answer.cache)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(answer.body)

    def end_headers(self) -> None:
        """Also of the pages that the standard library answers a broken request with."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Only what went wrong is said."""
        if len(args) > 1 and str(args[1]) >= "500":
            print(f"{self.address_string()} {format % args!a}", file=sys.stderr)

    def log_error(self, format: str, *args: object) -> None:
        """What was refused is told to who asked for it."""
