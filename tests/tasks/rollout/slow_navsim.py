"""Slow twin of the public traffic: every shape of everybody, simplified before every look, in two trees each.

What NAVSIM's `NavsimIDMAgentManager` and nuplan-devkit's `IDMAgent` do, as they do it, from the agents as they start:
nothing is left out because it cannot matter.
"""

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.rollout.navsim import IdmAgent, NavsimAgents, box_polygons
from tasks.settings import TrafficSettings
from tasks.world.frames import PACIFICA

Array = NDArray[np.float64]


class Driver:
    """One agent."""

    def __init__(self, about: IdmAgent) -> None:
        self.about, self.path = about, about.path
        self.progress, self.speed = about.progress, about.speed

    def clamp(self, progress: float) -> float:
        return max(self.path.at[0], min(progress, self.path.at[-1]))

    def pose_at(self, progress: float) -> Array:
        return np.array([np.interp(progress, self.path.at, column) for column in self.path.rows.T])

    @property
    def pose(self) -> Array:
        x, y, heading = self.pose_at(self.clamp(self.progress))
        return np.array([x, y, (heading + np.pi) % (2 * np.pi) - np.pi])

    @property
    def body(self) -> shapely.Polygon:
        return box_polygons(np.array([[*self.pose, self.about.length, self.about.width]]))[0]

    def strip(self, start: float, stop: float) -> shapely.Geometry:
        """Along the path between two clamped path lengths; where nothing lies between, at the end they are at."""
        at, xy = self.path.at, self.path.rows[:, :2]
        inside = (at > start) & (at < stop)
        if not (at > start).any():
            points = xy[-2:]
        elif not (at < stop).any():
            points = xy[:2]
        else:
            points = np.concatenate([[self.pose_at(start)[:2]], xy[inside], [self.pose_at(stop)[:2]]])
        return shapely.LineString(points).buffer(self.about.width / 2, cap_style="flat")

    @property
    def ahead(self) -> shapely.Geometry:
        start = self.clamp(self.progress)
        after = self.path.at > start
        xy = self.path.rows[:, :2]
        points = np.concatenate([[self.pose_at(start)[:2]], xy[after]]) if after.any() else xy[-2:]
        return shapely.LineString(points).buffer(self.about.width / 2, cap_style="flat")

    def footprint(self, headway: float) -> shapely.Geometry:
        half = self.about.length / 2
        stop = self.clamp(self.progress + half + self.speed * headway)
        return shapely.unary_union([self.strip(self.clamp(self.progress - half), stop), self.body])


def drive(agents: NavsimAgents, settings: TrafficSettings, ego_states: Array) -> tuple[Array, Array]:
    """Boxes (41, A, 5) of the agents and whether each staying vehicle is there (41, F); row 0 is not filled."""
    drivers = {k: Driver(about) for k, about in enumerate(agents.driven)}
    shapes = {k: about.body for k, about in enumerate(agents.driven)}
    boxes = np.full((len(ego_states), len(drivers), 5), np.nan)
    stay = np.zeros((len(ego_states), len(agents.staying)), dtype=bool)
    ego_number = len(agents.driven)
    for t, ego in enumerate(ego_states[:-1], start=1):
        shapes[ego_number] = box_polygons(np.array([[*ego[:3], PACIFICA.length, PACIFICA.width]]))[0]
        for k, driver in list(drivers.items()):
            if np.hypot(*(driver.pose[:2] - ego[:2])) > 100.0:
                del drivers[k], shapes[k]
        for k, driver in drivers.items():
            shapes = {j: shape.simplify(1e-5, preserve_topology=True) for j, shape in shapes.items()}
            _move(k, driver, drivers, shapes, ego, ego_number, settings)
            shapes[k] = driver.footprint(settings.headway_s)
        here = []
        for k, driver in drivers.items():
            boxes[t, k] = *driver.pose, driver.about.length, driver.about.width
            here.append(driver.body)
        for i, body in enumerate(agents.staying_bodies):
            if not any(body.intersects(other) for other in here):
                stay[t, i] = True
                here.append(body)
    return boxes, stay


def _move(
    k: int, driver: Driver, drivers: dict[int, Driver], shapes: dict[int, shapely.Geometry], ego: Array,
    ego_number: int, settings: TrafficSettings,
) -> None:  # fmt: skip
    numbers = list(shapes)
    way = driver.ahead
    seen = [numbers[i] for i in shapely.STRtree(list(shapes.values())).query(way)]
    seen = [j for j in seen if shapes[j].intersects(way)]
    if k not in seen:
        raise ValueError("the agent is not in its own way")
    others = [j for j in seen if j != k]
    gap, lead_speed, rear = driver.path.at[-1] - driver.progress, 0.0, driver.about.length / 2
    if others:
        j = others[shapely.STRtree([shapes[j] for j in others]).nearest(shapes[k])]
        gap, rear = shapely.shortest_line(shapes[k], shapes[j]).length, 0.0
        speed, heading = (
            (np.hypot(ego[3], ego[4]), ego[2]) if j == ego_number else (drivers[j].speed, drivers[j].pose[2])
        )  # fmt: skip
        lead_speed = speed * np.cos(heading - driver.pose[2])
    v, of = driver.speed, settings
    wanted = of.min_gap_m + v * of.headway_s + v * (v - lead_speed) / (2 * np.sqrt(of.accel_max * of.decel_max))
    accel = of.accel_max * (1 - (v / driver.about.target_speed) ** 4 - (wanted / max(gap - rear, of.min_gap_m)) ** 2)
    driver.progress += 0.1 * v
    driver.speed = max(v + 0.1 * float(np.clip(accel, -of.decel_max, of.accel_max)), 0.0)
