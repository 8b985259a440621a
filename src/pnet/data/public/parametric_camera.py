"""The Parametric data set's parameter.json: intrinsics, and how depth is coded."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.json_files import read_numbers, read_object
from pnet.data.public.checks import checked_camera
from pnet.geometry.camera import Camera

Points = NDArray[np.float64]

CAMERA_FILE = "parameter.json"
MOST_BYTES = 1_000_000  # of a text file


@dataclass(frozen=True)
class RadialDepth:
    """A camera that writes distances along its rays as whole numbers.

    Attributes:
        camera: its `near` is the smallest planar depth of any pixel: clip_start on the longest ray.
        clip_start, clip_end: distances from the camera's centre that 0 and largest stand for, metres.
        largest: the largest number.
    """

    camera: Camera
    clip_start: float
    clip_end: float
    largest: float

    def planar(self, values: NDArray[Any], where: str) -> Points:
        """Planar depth of an image.

        Args:
            values: (height, width) whole numbers as the file has them. where: the file, for the error.
        Returns:
            (height, width) metres, 0 where `values` are.
        Raises:
            ValueError: values are larger than the largest, or their type is too small for it.
        """
        if values.dtype.kind not in "iu" or self.largest > np.iinfo(values.dtype).max + 1:
            raise ValueError(
                f"{where}: has pixels of type {values.dtype}, expected whole numbers up to {self.largest:g} "
                f"(max_val_in_depth of {CAMERA_FILE})"
            )
        if values.max() > self.largest or values.min() < 0:
            raise ValueError(
                f"{where}: holds {values.min()} to {values.max()}, expected 0 to {self.largest:g} "
                f"(max_val_in_depth of {CAMERA_FILE})"
            )
        distance = self.clip_start + values / self.largest * (self.clip_end - self.clip_start)
        return np.where(values > 0, distance / self.camera.ray_lengths(), 0.0)


def find_camera(root: Path, folder: Path) -> RadialDepth | None:
    """What the nearest parameter.json in `folder` or above it up to `root` says; None where there is none."""
    for place in (folder, *folder.parents):
        if (place / CAMERA_FILE).is_file():
            return read_camera(place / CAMERA_FILE)
        if place == root:
            break
    return None


def read_camera(path: Path) -> RadialDepth:
    """Read a parameter.json; ValueError names the file and the key."""
    check_size(path)
    fields = read_object(path)

    def number(key: str) -> float:
        return float(read_numbers(fields, key, str(path), ()))

    size, focal = (number("resolutionX"), number("resolutionY")), (number("fu"), number("fv"))
    clip, largest = (number("clip_start"), number("clip_end")), number("max_val_in_depth")
    camera = checked_camera(str(path), size, focal, (number("cu"), number("cv")), clip)
    if largest <= 0:
        raise ValueError(f"{path}: key 'max_val_in_depth' is {largest:g}, expected more than 0")
    near = clip[0] / float(camera.ray_lengths().max())
    if near <= 0:
        raise ValueError(f"{path}: key 'clip_start' is {clip[0]:g}, expected metres")
    return RadialDepth(replace(camera, near=near), *clip, largest)


def check_size(path: Path) -> None:
    """Raise ValueError where a text file is too large to be one."""
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"{path}: has {size:,} bytes, expected at most {MOST_BYTES:,}")
