"""`python -m factory dashboard out=<folder or URL>`: a live page of a run, in the browser.

    python -m factory dashboard out=runs/demo               then open the address that it prints
    python -m factory dashboard out=s3://bucket/samples port=9000
    python -m factory dashboard out=runs/next wait=true     a run that is still to begin: the address once it has
    python -m factory dashboard out=runs/demo host=0.0.0.0  for others too: everyone who reaches the port sees the data

Works while a run goes on, and after it; it only reads. Ctrl-C ends it.
"""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from factory.config.arguments import Refused
from factory.views.status import NothingThere, open_store

if TYPE_CHECKING:
    from factory.store.samples import Store

PORT = 8266  # Ray's own dashboard is at 8265


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    port: int = PORT  # 0: any free one
    host: str = "127.0.0.1"  # 0.0.0.0: for others too
    wait: bool = False  # until there is a run

    def __post_init__(self) -> None:
        if self.port >= 2**16:
            raise ValueError(f"port={self.port}: must be a number below 65536, 0 for any free one")


def main(request: Request) -> None:
    """Serve until Ctrl-C."""
    try:
        serve(request)
    except KeyboardInterrupt:
        print()


def serve(request: Request) -> None:
    """Until Ctrl-C, which raises. Raises Refused where there is no run or the address cannot be had."""
    store = awaited(request.out) if request.wait else open_store(request.out)
    from factory.views.board.server import LOOPBACK, Board, Server

    board = Board(store)
    try:
        server = Server(board, request.host, request.port)
    except OSError as error:
        raise Refused(f"host={request.host} port={request.port}: {error}; choose another port=") from error
    print(f"reading {store.location.uri}", flush=True)
    board.answer("/api/overview")  # now, not when the page is opened
    host = f"[{request.host}]" if ":" in request.host else request.host
    print(f"{store.location.uri} is shown at http://{host}:{server.server_address[1]}/ until Ctrl-C", flush=True)
    if request.host not in LOOPBACK:
        print("warning: everyone who reaches this port sees the run's data and pictures; there is no password")
    with server:
        server.serve_forever()


def awaited(out: str, look_every_s: float = 2.0) -> "Store":
    """The store of a run, once it has begun to write. Raises Refused where none can be."""
    is_told = False
    while True:
        try:
            return open_store(out)
        except NothingThere as nothing:
            if not is_told:
                print(f"no store at {nothing.uri} yet: waiting for a run to begin, until Ctrl-C", flush=True)
            is_told = True
            time.sleep(look_every_s)
