"""The machine: clips in, committed samples out, exactly once."""

import os
import sys

from factory.exits import exit_on_early_interrupt

if sys.argv[:1] == ["-m"] and {"factory", "planners"} & {word.partition(".")[0] for word in sys.orig_argv}:
    exit_on_early_interrupt()  # `python -m factory ...` imports this package before all else
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's products are small: threads would wait busily for them

import importlib
import importlib.util
from pathlib import Path


def _claim_sibling(name: str) -> None:
    """Make `import <name>` mean the package installed beside this one.

    `python -m factory.run` puts the working directory first on the path: a user's own `tasks.py` would shadow ours.
    """
    if name in sys.modules:
        return
    folder = Path(__file__).resolve().parent.parent / name
    if not (folder / "__init__.py").is_file():
        return  # an editable install that maps packages itself
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)


_claim_sibling("tasks")

__version__: str = importlib.import_module("tasks").__version__
