"""The consumer: planners, co-training, evaluation. Samples are read through factory.store.reader."""

import sys
from importlib.util import find_spec

from factory import __version__ as __version__  # imported first: it finds tasks beside it, not in the working folder

if find_spec("torch") is None:
    _MISSING = 'planners need PyTorch: pip install -e ".[planners]" in the checkout (make install for its CPU build)'
    if sys.argv[0] == "-m":  # `python -m planners.<command>` imports this package first: one line, no traceback
        print(f"error: {_MISSING}", file=sys.stderr)
        sys.exit(2)
    raise ModuleNotFoundError(_MISSING, name="torch")
