"""Where this user's caches lie."""

import os
from pathlib import Path


def user_cache() -> Path:
    """The project's folder in the user's cache (XDG base directories); everything in it can be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "driving-data-factory"
