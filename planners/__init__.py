"""The consumer: planners, co-training, evaluation. Samples are read through factory.store.reader."""

import sys
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from factory import __version__ as __version__  # imported first: it finds tasks beside it, not in the working folder

if find_spec("torch") is None:
    _MISSING = 'planners need PyTorch: pip install "driving-data-factory[planners]", in a checkout make install'
    if sys.argv[0] == "-m" or sys.argv[0].endswith("/planners"):  # the commands: one line, no traceback
        print(f"error: {_MISSING}", file=sys.stderr)
        sys.exit(2)
    raise ModuleNotFoundError(_MISSING, name="torch")

if TYPE_CHECKING:
    from planners.data.dataset import SampleDataset as SampleDataset


def __getattr__(name: str) -> Any:
    """`SampleDataset`, which imports PyTorch; this package alone does not."""
    if name == "SampleDataset":
        return import_module("planners.data.dataset").SampleDataset
    raise AttributeError(f"module {__name__} has no attribute {name}")
