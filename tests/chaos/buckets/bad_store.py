"""A bucket that misbehaves: moto's S3 server behind a proxy on loopback which breaks requests as it is told.

Both clients of a run, Arrow's and delta-rs's, go through it by AWS_ENDPOINT_URL. Signatures are not looked at.
"""

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

BUCKET = "bucket"
ERROR = "<?xml version='1.0' encoding='UTF-8'?><Error><Code>{code}</Code><Message>{said}</Message></Error>"
LISTED = re.compile(rb"<(Contents|Version)>(?:(?!</\1>).)*?<Key>([^<]*)</Key>.*?</\1>", re.DOTALL)
HOPS = ("connection", "transfer-encoding", "content-length", "expect", "keep-alive")


class What(StrEnum):
    """A request is met with."""

    SLOW_DOWN = "503 SlowDown"
    EXPIRED = "403 ExpiredToken"
    DENIED = "403 AccessDenied"
    LATE = "an answer that comes late"
    TORN = "half an answer"
    CUT = "a connection cut in the middle of what is sent"  # nothing is stored
    KILL = "a SIGKILL in the middle of what is sent"  # of the victim
    UNANSWERED = "a connection cut after it was done"  # whether it was done the client cannot know
    UNLISTED = "a listing without what is new"


@dataclass
class Fault:
    """Of the requests that match, those from number `first` on, `times` of them."""

    what: What
    method: str = "."  # a pattern
    target: str = ""  # a pattern, looked for in path and query
    first: int = 1
    times: int = 10**9
    seconds: float = 0.0  # LATE: for so long; UNLISTED: new for so long
    share: float = 1.0  # of them, by chance
    other: "Fault | None" = None  # what the others may meet
    seen: int = 0
    met: int = 0

    def meets(self, method: str, target: str) -> bool:
        if not (re.match(self.method, method) and re.search(self.target, target)):
            return False
        self.seen += 1
        chance = zlib.crc32(f"{self.what}{self.seen}".encode()) / 2**32
        is_met = self.first <= self.seen < self.first + self.times and chance < self.share
        self.met += is_met
        return is_met

    @property
    def all(self) -> "list[Fault]":
        return [self, *(self.other.all if self.other is not None else ())]


@dataclass
class BadStore:
    """A running server and proxy. `fault` holds for all requests from when it is set."""

    url: str
    straight: str  # without the proxy
    fault: Fault | None = None
    victim: int = 0  # process
    log: list[str] = field(default_factory=list)  # requests: method, target, status
    stored_s: dict[str, float] = field(default_factory=dict)  # key -> when it came first
    lock: threading.Lock = field(default_factory=threading.Lock)

    def met(self, method: str, target: str) -> Fault | None:
        with self.lock:
            faults = self.fault.all if self.fault is not None else []
            return next((fault for fault in faults if fault.meets(method, target)), None)

    def environment(self, faults: bool = True) -> dict[str, str]:
        """Variables for a process that uses the bucket."""
        return credentials(self.url if faults else self.straight)


def credentials(url: str) -> dict[str, str]:
    """What both clients read, as variables and as storage options."""
    return {
        "AWS_ENDPOINT_URL": url,
        "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b",
        "AWS_REGION": "us-east-1",
        "AWS_ALLOW_HTTP": "true",
        "AWS_EC2_METADATA_DISABLED": "true",
    }


@contextmanager
def moto_server() -> Iterator[str]:
    """The URL of S3 in a process of its own, with the bucket: in a thread here it would wait for deltalake's lock."""
    import boto3

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    quiet = subprocess.DEVNULL
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=quiet, stderr=quiet)
    try:
        for _ in range(200):
            with socket.socket() as client:
                if client.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        url = f"http://127.0.0.1:{port}"
        keys = {"aws_access_key_id": "a", "aws_secret_access_key": "b", "region_name": "us-east-1"}
        boto3.client("s3", endpoint_url=url, **keys).create_bucket(Bucket=BUCKET)
        yield url
    finally:
        server.terminate()
        server.wait(timeout=10)


@contextmanager
def bad_store() -> Iterator[BadStore]:
    """Proxy and server, until the block ends."""
    with moto_server() as straight:
        proxy = _Server(("127.0.0.1", 0), _Proxy)
        store = BadStore(f"http://127.0.0.1:{proxy.server_address[1]}", straight)
        proxy.store = store  # type: ignore[attr-defined]
        thread = threading.Thread(target=proxy.serve_forever, daemon=True)
        thread.start()
        try:
            yield store
        finally:
            proxy.shutdown()
            proxy.server_close()
            thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Who asked has gone: it was killed, or its connection was cut."""


class _Proxy(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    wbufsize = -1
    disable_nagle_algorithm = True

    def _pass_on(self) -> None:
        store: BadStore = self.server.store  # type: ignore[attr-defined]
        fault = store.met(self.command, self.path)
        what = fault.what if fault is not None else None
        if what in (What.CUT, What.KILL):
            self._body(half=True)
            if what is What.KILL:
                os.kill(store.victim, signal.SIGKILL)
            self._cut(store, "cut")
            return
        body = self._body()
        if what in (What.SLOW_DOWN, What.EXPIRED, What.DENIED):
            status, code = what.split()
            self._answer(store, int(status), {}, ERROR.format(code=code, said="as asked for by a test").encode())
            return
        if what is What.LATE and fault is not None:
            time.sleep(fault.seconds)
        status, headers, data = self._ask(store.straight, body)
        if status < 300 and self.command in ("PUT", "POST"):
            store.stored_s.setdefault(unquote(urlsplit(self.path).path), time.monotonic())
        if what is What.UNANSWERED:
            self._cut(store, f"{status} unanswered")
            return
        if what is What.UNLISTED and fault is not None and b"<ListBucketResult" in data:
            data = _without_new(data, store.stored_s, time.monotonic() - fault.seconds)
        self._answer(store, status, headers, data, torn=what is What.TORN)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = _pass_on

    def _body(self, half: bool = False) -> bytes:
        if self.headers.get("Transfer-Encoding", "").lower() == "chunked":
            parts = []
            while size := int(self.rfile.readline().split(b";")[0], 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
                if half:
                    break
            else:
                self.rfile.readline()
            return b"".join(parts)
        n = int(self.headers.get("Content-Length") or 0)
        return self.rfile.read(n // 2 if half else n)

    def _ask(self, url: str, body: bytes) -> tuple[int, Mapping[str, str], bytes]:
        host = urlsplit(url).netloc
        asking = http.client.HTTPConnection(host, timeout=60)
        headers = {name: value for name, value in self.headers.items() if name.lower() not in HOPS}
        try:
            asking.request(self.command, self.path, body or None, headers | {"Content-Length": str(len(body))})
            answer = asking.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            asking.close()

    def _answer(
        self, store: BadStore, status: int, headers: Mapping[str, str], data: bytes, torn: bool = False
    ) -> None:
        store.log.append(f"{self.command} {self.path} {status}{' torn' if torn else ''}")
        n = headers.get("Content-Length", "0") if self.command == "HEAD" else str(len(data))
        with suppress(OSError):  # who asked was killed
            self.send_response_only(status)
            for name, value in headers.items():
                if name.lower() not in HOPS:
                    self.send_header(name, value)
            if status not in (204, 304):
                self.send_header("Content-Length", n)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data[: len(data) // 2] if torn else data)
            self.wfile.flush()
            if torn:
                self._shut()

    def _cut(self, store: BadStore, how: str) -> None:
        store.log.append(f"{self.command} {self.path} {how}")
        self._shut()

    def _shut(self) -> None:
        self.close_connection = True
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)

    def log_message(self, format: str, *args: object) -> None:
        """The store's own log is for those who look."""


def _without_new(data: bytes, stored_s: Mapping[str, float], since_s: float) -> bytes:
    def keep(found: re.Match[bytes]) -> bytes:
        key = f"/{BUCKET}/{unquote(found[2].decode())}"
        return b"" if stored_s.get(key, 0.0) > since_s else found[0]

    return LISTED.sub(keep, data)


def environment_of(store: BadStore, faults: bool = True) -> dict[str, str]:
    """This process's, with the bucket's."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
    return own | store.environment(faults)
