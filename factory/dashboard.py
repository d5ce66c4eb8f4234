"""`python -m factory.dashboard out=<folder or URL>`: a live page of a run, in the browser.

    python -m factory.dashboard out=runs/demo               then open the address that it prints
    python -m factory.dashboard out=s3://bucket/samples port=9000
    python -m factory.dashboard out=runs/demo host=0.0.0.0  for others too: everyone who reaches the port sees the data

Works while a run goes on, and after it; it only reads. Ctrl-C ends it.
Exit codes: 0 ended, 2 bad arguments, nothing there to show, or the port is taken.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields

from factory.show import BAD_ARGUMENTS, Refused, open_store

PORT = 8266  # Ray's own dashboard is at 8265


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    port: int = PORT
    host: str = "127.0.0.1"


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        return serve(parse(argv))
    except Refused as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_ARGUMENTS


def parse(argv: Sequence[str]) -> Request:
    """key=value arguments. Raises Refused for an unknown key, a missing value or a port that is none."""
    known = [f.name for f in fields(Request)]
    given: dict[str, str] = {}
    for argument in argv:
        key, equals, value = argument.partition("=")
        if key not in known or not equals or not value:
            raise Refused(f"{argument!r}: expected one of {', '.join(f'{name}=...' for name in known)}; see --help")
        if key in given:
            raise Refused(f"{key} is given twice")
        given[key] = value
    if "out" not in given:
        raise Refused("out=<folder or URL of a run> is missing; see --help")
    port = given.get("port", str(PORT))
    if not (port.isascii() and port.isdecimal() and int(port) < 2**16):
        raise Refused(f"port={port}: must be a number below 65536, 0 for any free one")
    return Request(given["out"], int(port), given.get("host", "127.0.0.1"))


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
