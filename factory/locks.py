"""Who works on a file alone, among the threads and processes of one machine."""

import errno
import fcntl
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)  # what flock says where there are none


@contextmanager
def locked(file: IO[Any]) -> Iterator[None]:
    """Alone with an open file until it is left and closed; the kernel frees it when its holder dies.

    On a file system without locks, as mounts of object stores and some network shares are, a file of this machine's
    temporary folder stands for it. Raises OSError where that cannot be locked either.
    """
    with ExitStack() as held:
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            fcntl.flock(held.enter_context(_stand_in(file.name).open("ab")), fcntl.LOCK_EX)
        yield


def _stand_in(name: str) -> Path:
    """In a folder of this user's own, as others may write to the temporary one."""
    folder = Path(tempfile.gettempdir(), f"driving-data-factory-locks-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise PermissionError(errno.EPERM, "belongs to another user", str(folder))
    return folder / f"{hashlib.sha256(os.path.realpath(name).encode()).hexdigest()[:32]}.lock"
