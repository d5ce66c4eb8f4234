"""What clips share: windows of one log share their scene, logs of one town its streets and light.

An interval over clips takes clips for independent, and is too narrow where they are not; one over logs, or over towns,
draws whole clusters instead (cluster bootstrap: Cameron, Gelbach & Miller 2008). Where there are few clusters, as with
six towns, such an interval is itself a rough one, rather too narrow than too wide.
"""

import re
from collections.abc import Mapping, Sequence

LEVELS = ("clip", "log", "town")
_SYNTHETIC_LOG = re.compile(r"(town-\d+)-\d{4}-")  # factory.readers.town.town.log_name


def town_of(log_id: str) -> str:
    """The town of a synthetic log; empty for logs of other data sets, whose ids name no place."""
    found = _SYNTHETIC_LOG.match(log_id)
    return found[1] if found else ""


def clusters_of(clips: Sequence[str], logs: Sequence[str]) -> Mapping[str, tuple[str, ...]]:
    """Level -> cluster of each clip, for those of LEVELS that are known of every clip; logs: empty where unknown."""
    towns = [town_of(log) for log in logs]
    known = {"clip": clips, "log": logs, "town": towns}
    return {level: tuple(names) for level, names in known.items() if all(names)}
