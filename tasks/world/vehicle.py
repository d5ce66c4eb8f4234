"""The ego vehicle's body and the columns of its state."""

import math
from dataclasses import dataclass, fields

# Columns of an ego state row (docs/reward.md 0). The pose is the REAR AXLE in the world frame;
# velocity and acceleration are in the ego body frame.
X, Y, HEADING, VX, VY, AX, AY, STEERING, STEERING_RATE, YAW_RATE, YAW_ACCEL = range(11)
EGO_STATE_SIZE = 11


@dataclass(frozen=True)
class Vehicle:
    """Body of a car; lengths in metres. Defaults: Chrysler Pacifica, docs/reward.md 0.

    It is used on every data set by default, so that scores are comparable. Raises ValueError for a length that is not
    finite and positive, naming the field.
    """

    width: float = 2.297
    front_length: float = 4.049  # rear axle to front bumper
    rear_length: float = 1.127  # rear axle to rear bumper
    rear_axle_to_center: float = 1.461
    wheel_base: float = 3.089

    def __post_init__(self) -> None:
        for field in fields(self):
            length_m = getattr(self, field.name)
            if not (math.isfinite(length_m) and length_m > 0.0):
                raise ValueError(f"vehicle.{field.name} must be finite and positive [m], got {length_m}")

    @property
    def length(self) -> float:
        return self.front_length + self.rear_length

    @property
    def half_length(self) -> float:
        return self.length / 2.0

    @property
    def half_width(self) -> float:
        return self.width / 2.0


PACIFICA = Vehicle()
