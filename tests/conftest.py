"""Where tests on real data find it."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_root() -> Path:
    """The folder of real logs and reference numbers beside the checkout; skips the test where it is missing."""
    root = Path(__file__).resolve().parents[2] / "shared"
    if not (root / "reference").is_dir():
        pytest.skip(f"real logs and reference numbers are not at {root}")
    return root
