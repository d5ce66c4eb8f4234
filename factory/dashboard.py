"""`python -m factory.dashboard out=<folder or URL>`: a live page of a run, in the browser.

    python -m factory.dashboard out=runs/demo               then open the address that it prints
    python -m factory.dashboard out=s3://bucket/samples port=9000
    python -m factory.dashboard out=runs/demo host=0.0.0.0  for others too: everyone who reaches the port sees the data

Works while a run goes on, and after it; it only reads. Ctrl-C ends it.
Exit codes: 0 ended, 2 bad arguments, nothing there to show, or the port is taken.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from factory.arguments import BAD_ARGUMENTS, Refused, parse
from factory.status import open_store

PORT = 8266  # Ray's own dashboard is at 8265


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    port: int = PORT
    host: str = "127.0.0.1"

    def __post_init__(self) -> None:
        if self.port >= 2**16:
            raise ValueError(f"port={self.port}: must be a number below 65536, 0 for any free one")


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        return serve(parse(Request, argv))
    except Refused as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_ARGUMENTS


def serve(request: Request) -> int:
    """Until Ctrl-C. Raises Refused where there is no run or the address cannot be had."""
    store = open_store(request.out)
    from factory.board.server import LOOPBACK, Board, Server

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
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
