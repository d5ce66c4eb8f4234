"""Whatever is sent to the dashboard: an answer or a closed connection, no traceback; others are served meanwhile."""

import http.client
import os
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from factory.store.samples import Store
from factory.views.board.server import CONNECTIONS, Board, Server
from tests.factory.graph.runs import run
from tests.pages import REPOSITORY

At = tuple[str, int]
HOST = b"Host: localhost\r\n\r\n"
MALFORMED = {
    "no HTTP": b"\x16\x03\x01\x00\xa5\x01\x00\x00\xa1\x03\x03\r\n\r\n",
    "nothing": b"\r\n\r\n",
    "bad method": b"BREW /api/overview HTTP/1.1\r\n" + HOST,
    "bad version": b"GET / HTTP/99.99\r\n" + HOST,
    "no version's number": b"GET / HTTP/x\r\n" + HOST,
    "huge header": b"GET / HTTP/1.1\r\nX: " + b"a" * 200_000 + b"\r\n" + HOST,
    "many headers": b"GET / HTTP/1.1\r\n" + b"X: a\r\n" * 500 + HOST,
    "huge address": b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n" + HOST,
    "bad percent": b"GET /api/samples?expert=%zz%ff%00&page=%31 HTTP/1.1\r\n" + HOST,
    "bytes": b"GET /\xff\xfe\x80?\xc3\x28=\x9f HTTP/1.1\r\n" + HOST,
    "traversal": b"GET /static/../../../../etc/passwd HTTP/1.1\r\n" + HOST,
    "traversal, quoted": b"GET /static/%2e%2e%2f%2e%2e%2fetc%2fpasswd HTTP/1.1\r\n" + HOST,
    "bracket": b"GET //[x/y HTTP/1.1\r\n" + HOST,
    "bracket in Host": b"GET / HTTP/1.1\r\nHost: [x\r\n\r\n",
    "no Host": b"GET / HTTP/1.1\r\n\r\n",
    "two Hosts": b"GET / HTTP/1.1\r\nHost: evil.example\r\n" + HOST,
    "huge numbers": b"GET /api/samples?page=99999999&size=99999999 HTTP/1.1\r\n" + HOST,
    "unknown filter": b"GET /api/samples?order=%27&expert=%00 HTTP/1.1\r\n" + HOST,
    "large body": b"POST /api/samples HTTP/1.1\r\nContent-Length: 10000000\r\n" + HOST + b"x" * 10_000_000,
    "body of a GET": b"GET /nothing HTTP/1.1\r\nContent-Length: 40\r\n"
    + HOST
    + b"GET /api/overview HTTP/1.1\r\n"
    + HOST,
    "negative length": b"GET /nothing HTTP/1.1\r\nContent-Length: -1\r\n" + HOST,
    "half": b"GET /api/over",
}


@pytest.fixture(scope="module")
def at(tmp_path_factory: pytest.TempPathFactory) -> Iterator[At]:
    with Server(Board(Store(tmp_path_factory.mktemp("none"))), "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield "127.0.0.1", server.server_address[1]
        server.shutdown()
        thread.join()


def sent(at: At, data: bytes) -> bytes:
    """What comes back until the connection is closed by the other side, as it is once nothing more is sent."""
    with socket.create_connection(at, timeout=20) as connection, suppress(ConnectionError):
        connection.sendall(data)
        with suppress(OSError):  # it is closed already
            connection.shutdown(socket.SHUT_WR)
        parts = []
        while part := connection.recv(65536):
            parts.append(part)
        return b"".join(parts)
    return b""


def is_answered(at: At) -> bool:
    connection = http.client.HTTPConnection(*at, timeout=20)
    connection.request("GET", "/static/board.css")
    answer = connection.getresponse()
    connection.close()
    return answer.status == 200


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_malformed_is_refused(at: At, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    back = sent(at, MALFORMED[name])
    heads = [line for line in back.split(b"\r\n") if line.startswith(b"HTTP/1.1 ")]
    assert len(heads) <= 1 and not any(head[9:10] == b"2" for head in heads if name not in ("bad percent", "bytes"))
    assert all(back.count(b"Content-Security-Policy: default-src 'none'") == 1 for _ in heads)
    assert b"root:" not in back and "Traceback" not in capfd.readouterr().err
    assert is_answered(at)


def test_random_bytes_bring_nothing_down(at: At, capfd: pytest.CaptureFixture[str]) -> None:
    chance = random.Random(1)
    good = b"GET /api/samples?page=1&size=12&order=newest HTTP/1.1\r\n" + HOST
    for _ in range(200):
        data = bytearray(good)
        for _ in range(chance.randrange(1, 6)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        back = sent(at, bytes(data[: chance.choice((len(data), chance.randrange(len(data))))]))
        assert b"HTTP/1.1 500" not in back, data
    assert "Traceback" not in capfd.readouterr().err and is_answered(at)


CLIENTS = 300
ASKED = b"GET /static/board.js HTTP/1.1\r\n" + HOST
RESET = struct.pack("ii", 1, 0)  # SO_LINGER: what is closed is reset


def left_early(at: At, number: int) -> socket.socket | None:
    """A client that goes in one way or another; one that does not is still there."""
    client = socket.create_connection(at, timeout=20)
    match number % 5:
        case 0:  # says nothing
            pass
        case 1:  # reads nothing of what it asked for
            client.sendall(ASKED * 3)
        case 2:  # the same, and breaks the connection off
            client.sendall(ASKED * 3)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        case 3:
            client.sendall(b"GET /api/over")
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        case 4:  # trickles, and stays
            client.sendall(b"G")
            return client
    client.close()
    return None


def size_of(pid: int) -> tuple[int, int, int]:
    """Threads, open files and resident kB of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    threads, kilobytes = (int(re.findall(rf"^{key}:\s+(\d+)", status, re.M)[0]) for key in ("Threads", "VmRSS"))
    return threads, len(os.listdir(f"/proc/{pid}/fd")), kilobytes


@pytest.mark.slow
def test_the_dashboard_outlives_hundreds_of_clients_that_leave_early(tmp_path: Path) -> None:
    """And who read what it prints."""
    run(tmp_path, n=1, rounds=1)
    words = [sys.executable, "-m", "factory", "dashboard", f"out={tmp_path}", "port=0"]
    with subprocess.Popen(words, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None and served.stderr is not None
        served.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:(\d+)/", served.stdout.readline())
        assert found
        served.stdout.close()
        at = "127.0.0.1", int(found[1])
        assert is_answered(at)
        threads, files, kilobytes = size_of(served.pid)
        trickling: list[socket.socket] = []
        for number in range(CLIENTS):
            client = left_early(at, number)
            trickling += [] if client is None else [client]
            for one in trickling[-10:]:
                with suppress(OSError):  # it had to make way
                    one.sendall(b"E")
        assert is_answered(at)
        after = size_of(served.pid)
        assert after[0] <= threads + CONNECTIONS and after[1] <= files + CONNECTIONS and after[2] <= kilobytes + 200_000
        for one in trickling:
            one.close()
        assert is_answered(at)
        served.send_signal(signal.SIGINT)
        assert served.wait(30) == 0
        assert served.stderr.read() == ""
