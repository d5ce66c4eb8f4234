"""Who is connected to the dashboard: so many at most, and who asks nothing makes way for who comes."""

import socket
import threading
from contextlib import suppress

LOOK_AGAIN_S = 0.1


class Connections:
    """At most `most` at once, a thread each."""

    def __init__(self, most: int) -> None:
        self._places, self._lock = threading.Semaphore(most), threading.Lock()
        self._idle: dict[socket.socket, None] = {}  # of which no whole request has come, the longest first
        self._all: set[socket.socket] = set()

    def come(self, connection: socket.socket) -> None:
        """Wait for a place. The connection that has been idle for longest is closed for it."""
        while not self._places.acquire(blocking=False):
            self._hang_up_idlest()
            if self._places.acquire(timeout=LOOK_AGAIN_S):
                break
        with self._lock:
            self._all.add(connection)
            self._idle[connection] = None

    def asks(self, connection: socket.socket) -> None:
        """It is being answered, and stays until it is."""
        with self._lock:
            self._idle.pop(connection, None)

    def answered(self, connection: socket.socket) -> None:
        """It may ask again."""
        with self._lock:
            self._idle[connection] = None

    def gone(self, connection: socket.socket) -> None:
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
