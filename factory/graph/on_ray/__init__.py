"""The graph as Ray tasks, on this machine or on a cluster. All of this package that imports ray is here."""

import os

# Read when ray is imported, which the modules of this folder do.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # keeps every listener on 127.0.0.1
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")  # of results that nobody asks for: their report tells of it
os.environ.setdefault("RAY_task_oom_retries", "2")  # Ray's own default retries a task that runs out of memory for ever
# Ray keeps processes that claimed a GPU apart from others and ends idle ones beyond a node's cores: while tasks of both
# kinds take turns, scenes, CUDA and imports would be loaded again and again.
os.environ.setdefault("RAY_num_workers_soft_limit", "1024")
