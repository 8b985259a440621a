"""What readers of public data check before they hand anything on: settings, views, poses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnet.data.images import MOST_PIXELS
from pnet.data.json_files import read_json, read_numbers
from pnet.data.public.labelled_image import check_depth_range
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene

MOST_POINTS = 1_000_000
PARAMETERS = "parameters.json"  # sizes of the bodies by name, metres, as pnet exports them
STEEPEST = float(np.tan(np.deg2rad(85)))  # beyond it, an angle of view is a mistake


@dataclass(frozen=True, eq=False)
class FixedPart:
    """The part object of a data set in which all bodies have the same size.

    Attributes:
        name: the template's. parameters: (k,) metres. radius: of the sphere about the part frame's origin
            that holds it, metres.
    """

    name: str
    parameters: NDArray[np.float64]
    radius: float


def fixed_part(part: ParametricPart, data_set: Path) -> FixedPart:
    """The part object that all bodies of a data set are, by its `PARAMETERS` or as the template has one only.

    Args:
        part: the template. data_set: its folder.
    Raises:
        ValueError: where the template has several and no file says which; names the folder or the file.
    """
    objects, file = len(part.grids["L"]), data_set / PARAMETERS
    if file.is_file():
        parameters = _read_parameters(file, part)
    elif objects == 1:
        parameters = part.part_object("L", 0)
    else:
        raise ValueError(
            f"{data_set}: its objects have one size each, but part {part.name} has {objects} part objects; "
            "choose the part that this object is, with one value for each parameter (part.learning)"
        )
    radius = float(np.linalg.norm(part.mesh(parameters).vertices, axis=1).max())
    return FixedPart(part.name, parameters, radius)


def _read_parameters(path: Path, part: ParametricPart) -> NDArray[np.float64]:
    """(k,) metres."""
    fields = read_json(path)
    if not isinstance(fields, dict) or set(fields) != set(part.parameter_names):
        raise ValueError(f"{path}: expected the sizes {', '.join(part.parameter_names)} of part {part.name}")
    values = [float(read_numbers(fields, name, str(path), ())) for name in part.parameter_names]
    try:
        part.check_named(np.array(values))
        part.mesh(np.array(values))
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault
    return np.array(values)


def check_points(points: int) -> None:
    """Raise ValueError where N, the points of a scene, is no sensible number."""
    if isinstance(points, bool) or not isinstance(points, int) or not 1 <= points <= MOST_POINTS:
        raise ValueError(f"data.source.points is {points!r}, expected 1 to {MOST_POINTS:,}")


def checked_camera(
    where: str,
    size: tuple[float, float],
    focal: tuple[float, float],
    centre: tuple[float, float],
    clip: tuple[float, float],
) -> Camera:
    """A camera out of a file's finite numbers.

    Args:
        where: the file, for errors. size: width, height; focal: fx, fy; centre: cx, cy; all pixels.
        clip: planar depth of the clip planes, metres.
    Raises:
        ValueError: names the file and what no camera has.
    """
    width, height = size
    if not (width % 1 == 0 and height % 1 == 0 and min(size) >= 1 and width * height <= MOST_PIXELS):
        raise ValueError(f"{where}: an image of {width:g} x {height:g} pixels, expected whole numbers")
    if min(focal) <= 0:
        raise ValueError(f"{where}: the focal lengths {focal[0]:g} and {focal[1]:g} must be positive")
    check_depth_range(*clip, where)
    camera = Camera(int(width), int(height), *focal, *centre, near=clip[0], far=clip[1])
    steepest = np.abs(camera.rays(np.array([0, width - 1]), np.array([0, height - 1]))[:, :2]).max()
    if steepest > STEEPEST:
        raise ValueError(
            f"{where}: the image's border would be seen at {np.rad2deg(np.arctan(steepest)):.2f} degrees off "
            f"the axis, expected at most 85 (focal lengths {focal[0]:g}, {focal[1]:g}, principal point "
            f"{centre[0]:g}, {centre[1]:g})"
        )
    return camera


def check_poses_fit(scene: Scene, radius: float, where: str) -> None:
    """Raise ValueError where the bodies' points do not lie about their poses.

    A body's surface is within `radius` of its pose's origin, so the mean of its points is too. Poses in
    another unit or frame, or of another part, put it elsewhere. Some freedom is left for an origin that is
    not the centroid, and the median over the bodies for a few false annotations.

    Args:
        scene: the finished scene. radius: of `FixedPart`, metres. where: the file of poses, for the error.
    """
    if not (np.isfinite(scene.R).all() and np.isfinite(scene.t).all()):
        raise ValueError(f"{where}: a pose is too far away to be told in numbers")
    gap, _ = distances_from_poses(scene)
    if not len(gap):
        return
    if not np.median(gap) <= 2 * radius:
        raise ValueError(
            f"{where}: the poses do not fit the depth image: the points of the bodies lie "
            f"{np.median(gap):.3g} m from their origins (median of {len(gap)}), but part {scene.part} "
            f"reaches {radius:.3g} m from its own; are unit, frame (data.source.frame) and part right?"
        )


def distances_from_poses(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """How far the mean of a body's points is from its pose's origin.

    Returns:
        (s,) metres of the bodies that have points, and (s,) which these are.
    """
    count = np.bincount(scene.instance, minlength=len(scene.t))
    sums = [np.bincount(scene.instance, x, minlength=len(scene.t)) for x in scene.points.T]
    seen = np.flatnonzero(count)
    return np.linalg.norm(np.stack(sums, -1)[seen] / count[seen, None] - scene.t[seen], axis=1), seen
