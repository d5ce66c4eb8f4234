"""A planner that goes where its front camera's picture tells it: the brighter, the faster."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np


class Bright:
    """Straight on at up to 10 m/s."""

    digest = "bright-1"

    def plan(self, sample: Mapping[str, Any]) -> np.ndarray:
        now = [image for image in sample["images"] if image["time_s"] == 0.0]
        assert len(now) == len(sample["cameras"]) and sample["image_source"] in ("photo", "render")
        front = next(image for image in now if image["camera"] == "ring_front_center")
        grey = cv2.imdecode(np.frombuffer(front["jpeg"], np.uint8), cv2.IMREAD_GRAYSCALE).mean()
        return np.column_stack([10.0 * grey / 255.0 * np.arange(0.5, 4.1, 0.5), np.zeros((8, 2))])
