"""The Fraunhofer IPA data set's `parameter.json`: a window of a square image of a pinhole camera."""

from math import pi, radians, tan
from pathlib import Path

from pnet.data.json_files import read_numbers, read_object
from pnet.data.public.checks import checked_camera
from pnet.geometry.camera import Camera

MOST_RADIANS = 3.2  # a larger angle of view can only be in degrees
_SIZE = ("resolutionX", "resolutionY")
_OFFSET = ("pixelOffset_X_KoSyTopLeft", "pixelOffset_Y_KoSyTopLeft")


def read_camera(path: Path) -> Camera:
    """Read a `parameter.json`.

    The camera sees a square of resolution_big pixels under perspectiveAngle; images are its window of
    resolutionX x resolutionY pixels whose top left corner is at the pixel offsets. Pixel centres are at
    u + 0.5 there, the axis goes through the middle of the square.

    Note:
        The unit of perspectiveAngle is not documented: it is taken for degrees where it is above 3.2.
    Raises:
        FileNotFoundError, ValueError: names the file and the key.
    """
    fields = read_object(path)

    def number(key: str) -> float:
        return float(read_numbers(fields, key, str(path), ()))

    square, angle = number("resolution_big"), number("perspectiveAngle")
    size, offset = [number(key) for key in _SIZE], [number(key) for key in _OFFSET]
    radian = radians(angle) if angle > MOST_RADIANS else angle
    if not 0 < radian < pi:
        raise ValueError(
            f"{path}: key 'perspectiveAngle' is {angle:g}, expected less than 180 degrees, above 0"
        )
    for axis, pixels, first in zip(_SIZE, size, offset, strict=True):
        if first < 0 or first + pixels > square:
            raise ValueError(
                f"{path}: a window of {axis} {pixels:g} pixels from {first:g} on does not lie in an image of "
                f"resolution_big {square:g}"
            )
    focal = square / (2 * tan(radian / 2))
    cx, cy = (square / 2 - 0.5 - first for first in offset)
    clip = number("clip_start"), number("clip_end")
    return checked_camera(str(path), (size[0], size[1]), (focal, focal), (cx, cy), clip)
