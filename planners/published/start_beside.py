"""What a public agent draws its weights to be before a training; it runs in the public code's own Python.

main([<checkout>, <case>, <picture width>, <picture height>, <out.ckpt>])
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import torch

from planners.published.beside import built, model_of, origin
from planners.published.formula import SEED, inputs


def main(argv: list[str]) -> None:
    """See the module."""
    code, case, width, height, out = argv[0], argv[1], int(argv[2]), int(argv[3]), argv[4]
    torch.manual_seed(SEED)
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("NAVSIM_DEVKIT_ROOT", code)
        model = model_of(built(case, inputs(width, height), Path(folder), width, height))
    torch.save({"state_dict": dict(model.state_dict()), "origin": origin(code)}, out)
