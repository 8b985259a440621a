"""Planar depth as public data sets code it: 16 bits from one clip plane to the other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.images import read_image
from pnet.geometry.camera import Camera

FARTHEST = 65535


def read_coded_depth(path: Path, camera: Camera, missing: Sequence[int]) -> NDArray[np.float64]:
    """z = near + (far − near) code / 65535.

    Args:
        path: of a 16-bit image. camera: of the image; near and far are the clip planes.
        missing: codes of pixels without a measurement.
    Returns:
        (h, w) metres, NaN where missing.
    Raises:
        FileNotFoundError, ValueError: names the file.
    """
    code = read_codes(path, camera, np.uint16)
    depth = camera.near + (camera.far - camera.near) * (code / FARTHEST)
    depth[np.isin(code, missing)] = np.nan
    return depth


def read_codes(
    path: Path, camera: Camera, kind: type[np.uint8] | type[np.uint16]
) -> NDArray[np.unsignedinteger[Any]]:
    """An image (h, w) of the camera's size whose pixels have the type `kind`; errors name the file."""
    code = read_image(path, (camera.height, camera.width))
    if code.dtype != kind:
        raise ValueError(f"{path}: has pixels of type {code.dtype}, expected {np.dtype(kind)}")
    return code
