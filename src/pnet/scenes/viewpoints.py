"""Where the camera stands over the bin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pnet.scenes.limits import require_range
from pnet.scenes.pile import Points

MOST_TILT = 89.0  # degrees; beyond it the camera would look along the floor
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])  # world → camera: x stays, y and z turn round


@dataclass(frozen=True)
class Viewpoints:
    """A range of places for the camera, which always looks at the middle of the bin's floor.

    Attributes:
        distance: smallest and largest distance of the camera's centre from there, metres.
        tilt: smallest and largest angle between its axis and the vertical, degrees.
        turn: draw the direction of the tilt and the roll about the camera's axis too; else the camera is
            tilted about its own x axis, and the image's x is the world's.
    """

    distance: Sequence[float] = (0.65, 0.65)
    tilt: Sequence[float] = (0.0, 0.0)
    turn: bool = False

    def __post_init__(self) -> None:
        require_range("view.distance", self.distance, 0, above=True)
        require_range("view.tilt", self.tilt, 0, MOST_TILT)

    def draw(self, rng: np.random.Generator) -> tuple[Points, Points]:
        """A place: R (3, 3), t (3,) metres, world → camera."""
        (near, far), (upright, oblique) = self.distance, self.tilt
        distance, tilt = rng.uniform(near, far), np.deg2rad(rng.uniform(upright, oblique))
        azimuth, roll = rng.uniform(0, 2 * np.pi, 2) if self.turn else (0.0, 0.0)
        R = _about_z(roll) @ _about_x(tilt) @ LOOKING_DOWN @ _about_z(azimuth)
        return R, np.array([0.0, 0.0, distance])


def _about_z(angle: float) -> Points:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle: float) -> Points:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
