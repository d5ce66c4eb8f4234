"""One item of a command's work: a clip in which a planner is let drive in every way."""

from collections import Counter
from dataclasses import asdict, dataclass

from factory.readers.base import BadClip, ClipReader, ClipRef
from factory.readers.validate import read_clip
from factory.setup.settings import cache_folder
from factory.stages.painted import town_lights
from factory.stages.rows import scene_tags
from factory.store.explored.table import DriftRow, ExploredClip
from factory.store.location import Location
from factory.store.schema import canonical_json
from planners.drive.eyes import Eyes
from planners.drive.starts import lengthened
from planners.drive.work import DrivingPlanner, NotDriven, eyes_of, kept_driver, reads_towns
from planners.explore.drift import CLIP_STEPS, Drifted, drift, from_the_log
from planners.explore.settings import ExploreSettings
from tasks.rollout.policy import traffic_record
from tasks.stages import stage_versions
from tasks.world.clip import NOW, Clip, scene_of_clip
from tasks.world.command import driving_command
from tasks.world.vehicle import HEADING, VX

EXPLORE_VERSION = 1  # raised by hand whenever the same planner in the same clip drives otherwise


@dataclass(frozen=True)
class ExploreWork:
    """What makes rows of clips; picklable."""

    reader: ClipReader
    settings: ExploreSettings
    planner: DrivingPlanner
    looks: bool
    out: Location

    @property
    def depends_on(self) -> str:
        """All that a row depends on beside clip and planner, canonical JSON."""
        s = self.settings
        known: dict[str, object] = {
            "explore": EXPLORE_VERSION,
            "stages": stage_versions(),
            "ways": [str(way) for way in s.ways],
            "gates": {name: value for name, value in asdict(s.perturb).items() if name.startswith("max_")},
            "traffic": traffic_record(s.traffic),
            "pdm": asdict(s.pdm),
            "reward": asdict(s.reward),
        }
        if self.looks:
            known |= {"pictures": s.pictures, "render": asdict(s.render)}
        return canonical_json(known)

    def __call__(self, ref: ClipRef) -> ExploredClip | NotDriven:
        """What is wrong with a clip, its pictures or the planner's answers is told of it."""
        try:
            return self._explored(ref)
        except (BadClip, ValueError) as error:
            return NotDriven(ref.clip_id, str(error))

    def _explored(self, ref: ClipRef) -> ExploredClip:
        s, clip = self.settings, self._clip(ref)
        driver = kept_driver(self.planner, canonical_json(s.settings), s.pdm, s.device)
        eyes = self._eyes(clip)
        log = from_the_log(clip, driver, eyes, s.judging)
        found = [drift(clip, way, driver, eyes, s.judging) for way in s.ways]
        return ExploredClip(
            clip_id=clip.clip_id,
            dataset=clip.dataset,
            log_id=clip.log_id,
            content_digest=clip.content_digest,
            licence=clip.licence,
            tags=tags_at_now(clip),
            planner=self.planner.label,
            planner_digest=self.planner.digest,
            settings=self.depends_on,
            score=0.0 if isinstance(log, str) else log.score,
            fails=log if isinstance(log, str) else log.fails,
            dropped=dict(sorted(Counter(one for one in found if isinstance(one, str)).items())),
            drifts=tuple(drift_row(i, one) for i, one in enumerate(found) if isinstance(one, Drifted)),
        )

    def _clip(self, ref: ClipRef) -> Clip:
        clip = read_clip(self.reader, ref)
        return lengthened(clip, CLIP_STEPS, town_lights(clip, CLIP_STEPS) if reads_towns(self.reader) else None)

    def _eyes(self, clip: Clip) -> Eyes:
        s = self.settings
        return eyes_of(clip, s.pictures if self.looks else "none", s.render, s.cache or cache_folder(self.out.uri))


def tags_at_now(clip: Clip) -> tuple[str, ...]:
    """As a sample's that begins with the log at T."""
    command = driving_command(clip.centerline, clip.ego_states[NOW, : HEADING + 1])
    return tuple(scene_tags(scene_of_clip(clip), command))


def drift_row(number: int, one: Drifted) -> DriftRow:
    """As the table has it."""
    x, y, heading = (float(value) for value in one.end_pose)
    return DriftRow(
        number=number,
        way=str(one.way),
        end_x=x,
        end_y=y,
        end_heading=heading,
        end_speed=float(one.ego_states[-1, VX]),
        score=one.there.score,
        fails=one.there.fails,
        subscores=dict(one.there.subscores),
        ego_states=tuple(map(tuple, one.ego_states.tolist())),
    )
