"""A reader of one clip, the hand-made street: clips=custom clips._target_=tests.factory.street_reader.StreetReader."""

from dataclasses import replace

from factory.readers.base import ClipIndex, ClipRef
from tasks.world.clip import Clip
from tests.tasks.streets import street_clip


class StreetReader:
    """Needs no file."""

    name = "street"

    def index(self) -> ClipIndex:
        return ClipIndex((ClipRef(self.name, "street", 0),))

    def read(self, ref: ClipRef) -> Clip:
        return replace(street_clip(), clip_id=ref.clip_id, dataset=self.name)
