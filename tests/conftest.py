"""Where tests on real data find it, and how properties are tested: with the same examples on every machine, untimed.

`--hypothesis-profile=search` looks for new examples instead.
"""

import gc
import os
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

UNTIMED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # kernels compile at their first call
settings.register_profile("search", UNTIMED)
settings.register_profile("repeatable", UNTIMED, derandomize=True)
settings.load_profile("repeatable")

# Read when gRPC is first used: its handlers of fork() hold up what Ray forks, where a test of this process has used it.
os.environ["GRPC_ENABLE_FORK_SUPPORT"] = "0"

# Commands that tests start heed these, also where a shell or nohup has begun the suite itself with them ignored.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Takes the thousands of tests out of what the garbage collector looks through again and again: 4 % of the time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def shared_root() -> Path:
    """The folder of real logs and reference numbers beside the checkout; skips the test where it is missing."""
    root = Path(__file__).resolve().parents[2] / "shared"
    if not (root / "reference").is_dir():
        pytest.skip(f"real logs and reference numbers are no part of the project, and {root} has none")
    return root
