"""The Siléane data set's `camera_params.txt`: a pinhole camera and its place in the world."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnet.data.public.checks import checked_camera
from pnet.data.public.labelled_image import read_lines
from pnet.geometry.camera import Camera

Points = NDArray[np.float64]
UNIT_TOLERANCE = 1e-3
_LENGTHS = {key: 1 for key in ("width", "height", "fu", "fv", "cu", "cv", "clip_start", "clip_end")}
_LENGTHS |= {"location": 3, "rotation": 4}


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera at a place in the world.

    Attributes:
        camera: the pinhole model. R: (3, 3), t: (3,) camera → world, metres.
    """

    camera: Camera
    R: Points
    t: Points

    def from_world(self, R: Points, t: Points) -> tuple[Points, Points]:
        """Poses (d, 3, 3), (d, 3) relative to the camera, given those relative to the world, metres."""
        return self.R.T @ R, (t - self.t) @ self.R


def read_camera(path: Path) -> PlacedCamera:
    """Read a `camera_params.txt`: a key and its values a line, # starts a comment, other keys are ignored.

    Pixels and metres; the rotation is a unit quaternion w x y z.

    Raises:
        FileNotFoundError, ValueError: names the file and the key.
    """
    values = _read_values(path)
    scalar = {key: value[0] for key, value in values.items()}
    camera = checked_camera(
        str(path),
        (scalar["width"], scalar["height"]),
        (scalar["fu"], scalar["fv"]),
        (scalar["cu"], scalar["cv"]),
        (scalar["clip_start"], scalar["clip_end"]),
    )
    norm = float(np.linalg.norm(values["rotation"]))
    if not abs(norm - 1) <= UNIT_TOLERANCE:
        raise ValueError(f"{path}: key 'rotation' is a quaternion of norm {norm:.4g}, expected 1")
    R = Rotation.from_quat(values["rotation"], scalar_first=True).as_matrix()
    return PlacedCamera(camera, R, np.array(values["location"]))


def _read_values(path: Path) -> dict[str, list[float]]:
    """The numbers of every key in `_LENGTHS`."""
    found: dict[str, list[float]] = {}
    for number, line in enumerate(read_lines(path), 1):
        words = line.split("#")[0].split()
        if not words or words[0] not in _LENGTHS:
            continue
        key, where = words[0], f"{path}: line {number}"
        if key in found:
            raise ValueError(f"{where}: key {key!r} comes twice")
        found[key] = _numbers(words[1:], _LENGTHS[key], f"{where}: key {key!r}")
    missing = [key for key in _LENGTHS if key not in found]
    if missing:
        raise ValueError(f"{path}: key {missing[0]!r} is missing; expected {', '.join(_LENGTHS)}")
    return found


def _numbers(words: Sequence[str], count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{where} has {' '.join(words)[:80]!r}, expected {count} finite numbers")
    return values
