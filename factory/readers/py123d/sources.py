"""The data sets that 123D converts and that are read: licences, classes of their boxes, what their maps hold."""

from dataclasses import dataclass

from factory.readers.av2.log import KIND_OF_CATEGORY
from tasks.world.agents import AgentKind


@dataclass(frozen=True)
class ConvertedSet:
    """What differs between the data sets."""

    licence: str
    has_lanes: bool = True
    own_roadblocks: bool = False  # its lane groups are roadblocks; elsewhere 123D made them from neighbours
    own_intersections: bool = False  # polygons of its own; elsewhere 123D joined connectors
    own_centerlines: bool = True  # else 123D made them from the boundaries, as we do


AV2 = "CC BY-NC-SA 4.0 (Argoverse 2 via 123D)"
WAYMO = "Waymo Open Dataset licence, non-commercial (via 123D)"
SOURCES = {  # by the data set's name in a log's metadata
    "av2-sensor": ConvertedSet(AV2, own_centerlines=False),
    "nuplan": ConvertedSet("CC BY-NC-SA 4.0 (nuPlan via 123D)", own_roadblocks=True, own_intersections=True),
    "nuscenes": ConvertedSet("CC BY-NC-SA 4.0 (nuScenes via 123D)", own_intersections=True),
    "wod-perception": ConvertedSet(WAYMO),
    "wod-motion": ConvertedSet(WAYMO),
    "kitti360": ConvertedSet("CC BY-NC-SA 3.0 (KITTI-360 via 123D)", has_lanes=False),
}

_CAR, _WALKER, _BICYCLE, _THING = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE, AgentKind.GENERIC_OBJECT
_AV2 = (
    "ANIMAL ARTICULATED_BUS BICYCLE BICYCLIST BOLLARD BOX_TRUCK BUS CONSTRUCTION_BARREL CONSTRUCTION_CONE DOG "
    "LARGE_VEHICLE MESSAGE_BOARD_TRAILER MOBILE_PEDESTRIAN_CROSSING_SIGN MOTORCYCLE MOTORCYCLIST OFFICIAL_SIGNALER "
    "PEDESTRIAN RAILED_VEHICLE REGULAR_VEHICLE SCHOOL_BUS SIGN STOP_SIGN STROLLER TRAFFIC_LIGHT_TRAILER TRUCK "
    "TRUCK_CAB VEHICULAR_TRAILER WHEELCHAIR WHEELED_DEVICE WHEELED_RIDER"
)
# Kind by label number, of the classes in py123d/parser/registry.py.
KINDS_OF_LABELS: dict[str, tuple[AgentKind, ...]] = {
    "AV2SensorBoxDetectionLabel": tuple(KIND_OF_CATEGORY[name] for name in _AV2.split()),
    "NuPlanBoxDetectionLabel": tuple(
        AgentKind[name]
        for name in ["VEHICLE", "BICYCLE", "PEDESTRIAN", "TRAFFIC_CONE", "BARRIER", "CZONE_SIGN", "GENERIC_OBJECT"]
    ),
    "NuScenesBoxDetectionLabel": (
        *(_CAR,) * 8,  # car, truck, two buses, construction, ambulance, police, trailer
        *(_BICYCLE,) * 2,  # bicycle, motorcycle
        *(_WALKER,) * 7,  # adult, child, worker, personal mobility, police officer, stroller, wheelchair
        *(AgentKind.TRAFFIC_CONE, AgentKind.BARRIER),
        *(_THING,) * 4,  # pushable, debris, bicycle rack, animal
    ),
    "WODPerceptionBoxDetectionLabel": (_THING, _CAR, _WALKER, AgentKind.CZONE_SIGN, _BICYCLE),
    "WODMotionBoxDetectionLabel": (_THING, _CAR, _WALKER, _BICYCLE, _THING),
}
