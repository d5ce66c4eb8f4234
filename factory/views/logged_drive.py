"""A sample's episode with the log's own drive beside it; what makes it is imported where one is made."""

from collections.abc import Mapping
from typing import Any

from factory.graph.work import PreparedClip


def prepared_episode(row: Mapping[str, Any], prepared: PreparedClip) -> bytes:
    """The sample as one MCAP file, with the log's drive from its prepared clip."""
    from factory.stages.pipeline import logged_poses
    from factory.views.episode_messages import episode_of

    return episode_of(row, logged_poses(prepared))
