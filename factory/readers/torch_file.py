"""Checkpoints of torch as data: tensors, arrays and plain values, nothing that runs, and no more than the file may say.

`torch.load` of weights alone calls nothing of a stranger's; what it builds is as large as its references make it, and
a key of a dictionary may take for ever to hash. So the streams are looked through before, and the value after.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from factory.readers.base import BadClip
from factory.readers.pickle_shape import check_opcodes
from factory.readers.plain_values import check_values
from factory.readers.restricted_pickle import PLAIN_OPCODES
from factory.wording import one_line

OPCODES = PLAIN_OPCODES | {"NEWOBJ", "BINPERSID"}  # objects and storages, of which torch takes its own alone
OLD_STREAMS = 5  # pickles before the numbers in files of before 1.6: magic, version, machine, content, storages
MOST_EXPANDED = 2  # members are stored as they are


def load_tensors(path: Path, safe: Sequence[Any] = ()) -> Any:
    """What a checkpoint holds, its tensors on the CPU; safe: further classes that it may name.

    Raises ValueError that names the file and says in one line why it is none, OSError, and ImportError without torch.
    """
    import torch

    check_checkpoint(path)
    try:
        with torch.serialization.safe_globals(list(safe)):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # whatever a damaged file, or an object that is refused, raises
        said = one_line(error).partition(". ")[0]
        raise ValueError(f"{path}: cannot be read as a checkpoint of tensors and plain values: {said}") from error
    try:
        check_values(content, path.stat().st_size, str(path), "checkpoint")
    except BadClip as error:
        raise ValueError(str(error)) from error
    return content


def check_checkpoint(path: Path) -> None:
    """Raises ValueError where a stream of the file would take for ever or without end to load, and OSError."""
    try:
        if not zipfile.is_zipfile(path):
            with path.open("rb") as stream:
                for _ in range(OLD_STREAMS):
                    check_opcodes(stream, str(path), OPCODES)
            return
        with zipfile.ZipFile(path) as packed:
            members = packed.infolist()
            if sum(member.file_size for member in members) > MOST_EXPANDED * path.stat().st_size:
                raise BadClip(str(path), "checkpoint", "its members are packed to less than half their size: refused")
            for member in members:
                if member.filename.endswith(".pkl"):
                    check_opcodes(packed.read(member), str(path), OPCODES)
    except (BadClip, zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError) as error:
        said = error.problem if isinstance(error, BadClip) else one_line(error)
        raise ValueError(f"{path}: cannot be read as a checkpoint of tensors and plain values: {said}") from error
