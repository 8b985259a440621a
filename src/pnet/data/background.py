"""What of a view is no part: the bin, its floor, whatever lies around it."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pnet.data.depth_files import check_depth, read_depth
from pnet.geometry.camera import Camera
from pnet.scenes.limits import require_number, require_range

Kept = NDArray[np.bool_]
Points = NDArray[np.floating]
Pixels = NDArray[np.int64]
Range = tuple[float, float] | None

_FARTHEST = 100.0  # metres, of a limit
_SAMPLE = 2000  # points that decide between planes
_TRIALS = 5000  # where a tenth of the points lies on the floor, it is missed once in 150 times


class Background(Protocol):
    """A way to tell parts from the rest."""

    def __call__(self, points: Points, pixels: Pixels | None, camera: Camera | None) -> Kept:
        """Which points may lie on parts.

        Args:
            points: (n, 3) camera frame, metres, finite; not changed.
            pixels: (n,) v · width + u of each point's pixel; None for a cloud that is no image.
            camera: of the image; None where it is not known.
        Returns:
            (n,) true: kept. It may be all or none.
        Raises:
            ValueError: the background cannot be told from these points; names the key or the file.
        """
        ...


@dataclass(frozen=True)
class NoBackground:
    """Every point lies on a part, as in pnet's own scenes."""

    def __call__(self, points: Points, pixels: Pixels | None, camera: Camera | None) -> Kept:
        """See `Background`."""
        return np.ones(len(points), bool)


@dataclass(frozen=True)
class Limits:
    """A box in the camera frame; what lies in it is kept.

    Attributes:
        x, y, z: smallest and largest coordinate, metres, both still inside; None: any. At least one is given.
    """

    x: Range = None
    y: Range = None
    z: Range = None

    def __post_init__(self) -> None:
        if self.x is None and self.y is None and self.z is None:
            raise ValueError(
                "background.x, background.y and background.z are all null, expected a limit, such as "
                "background.z=[0.3,0.64], nearest and farthest depth in metres"
            )
        _check_box(self.x, self.y, self.z)

    def __call__(self, points: Points, pixels: Pixels | None, camera: Camera | None) -> Kept:
        """See `Background`."""
        return _in_box(points, self.x, self.y, self.z)


def _check_box(x: Range, y: Range, z: Range) -> None:
    for name, limits, low in (("x", x, -_FARTHEST), ("y", y, -_FARTHEST), ("z", z, 0.0)):
        if limits is not None:
            require_range(f"background.{name}", limits, low, _FARTHEST)


def _in_box(points: Points, *box: Range) -> Kept:
    """(n,) which points (n, 3) lie in a box. box: smallest and largest of x, y and z; None: any."""
    inside = np.ones(len(points), bool)
    for axis, limits in enumerate(box):
        if limits is not None:
            inside &= (points[:, axis] >= limits[0]) & (points[:, axis] <= limits[1])
    return inside


@dataclass(frozen=True)
class PlaneBackground:
    """The floor: of the planes with hardly anything behind them the one that most points lie on.

    What lies on it or behind it is removed; the walls of a bin are not. A layer of parts is not taken for the
    floor, even where more points lie on it, as long as the floor or deeper parts are seen behind it. A closed
    layer with nothing behind it is: nobody can tell them apart, and it is removed. Where the bin is so full
    that less than `min_share` of the points lies on its floor, there is an error. What the camera sees past
    the bin, such as a table below its floor, must be cut off by x, y and z, or that is the floor.

    Attributes:
        distance: points so near the plane still count as the plane, metres; some four times the depth noise.
            A part that lies on the floor loses as much.
        max_tilt_deg: largest angle between the plane's normal and the viewing axis, degrees.
        min_share: share of the points that must lie on the plane at least, beyond those just beside it.
        max_behind: share of the points that may lie behind it, as stray ones do.
        x, y, z: a box outside which everything is removed before, as of `Limits`; None: any.
        seed: of the random choices.
    """

    distance: float = 0.003
    max_tilt_deg: float = 30.0
    min_share: float = 0.05
    max_behind: float = 0.02
    x: Range = None
    y: Range = None
    z: Range = None
    seed: int = 0

    def __post_init__(self) -> None:
        require_number("background.distance", self.distance, 0, above=True)
        require_number("background.max_tilt_deg", self.max_tilt_deg, 0, 80)
        require_number("background.min_share", self.min_share, 0, 1)
        require_number("background.max_behind", self.max_behind, 0, 1)
        _check_box(self.x, self.y, self.z)
        require_number("background.seed", self.seed, 0, 2**32 - 1)

    def __call__(self, points: Points, pixels: Pixels | None, camera: Camera | None) -> Kept:
        """See `Background`."""
        kept = _in_box(points, self.x, self.y, self.z)
        cloud = points[kept].astype(np.float64)
        plane = self._fit(cloud, self._search(cloud, np.random.default_rng(self.seed)))
        kept[kept] = _height(cloud, plane) > self.distance
        return kept

    def _search(self, points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """(3,) a, b, c of the best of many planes z = a x + b y + c through three points each.

        RANSAC (Fischler and Bolles 1981) with a score of its own. That of scikit-learn takes seconds where
        little of the floor is seen.
        """
        if len(points) < 3:
            raise self._no_plane()
        some = rng.permutation(points)[:_SAMPLE]
        best, most = None, self.min_share
        for plane in self._candidates(points[rng.integers(len(points), size=(_TRIALS, 3))]):
            share = self._share(_height(some, plane))
            if share >= most:
                best, most = plane, share
        if best is None:
            raise self._no_plane()
        return np.asarray(best)

    def _share(self, height: NDArray[np.float64]) -> float:
        """How much a plane looks like a floor: the share of points on it; −1: too much lies behind it.

        Points at less than half the distance count for the plane, the others up to the distance against it:
        points crowd at a floor; where a plane cuts a heap or a slope, as many lie beside it as on it.
        """
        if np.count_nonzero(height < -self.distance) > self.max_behind * len(height):
            return -1.0
        away = np.abs(height)
        on, near = (np.count_nonzero(away <= limit) for limit in (self.distance / 2, self.distance))
        return (2 * on - near) / len(height)

    def _candidates(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """(m, 3) planes through triples of points (n, 3, 3), those that are flat enough."""
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        across = np.hypot(normal[:, 0], normal[:, 1])
        flat = across <= math.tan(math.radians(self.max_tilt_deg)) * np.abs(normal[:, 2])
        flat &= normal[:, 2] != 0  # the corners are no line
        slope = -normal[flat, :2] / normal[flat, 2:]
        offset = corners[flat, 0, 2] - (slope * corners[flat, 0, :2]).sum(1)
        return np.column_stack([slope, offset])

    def _fit(self, points: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
        """Least squares through the points that count as the plane."""
        on = points[np.abs(_height(points, plane)) <= self.distance]
        rows = np.column_stack([on[:, :2], np.ones(len(on))])
        return np.asarray(np.linalg.lstsq(rows, on[:, 2], rcond=None)[0])

    def _no_plane(self) -> ValueError:
        return ValueError(
            f"background=plane found no floor: no plane with at least {self.min_share:.0%} of the points on "
            f"it, {self.max_behind:.0%} at most behind it, tilted by {self.max_tilt_deg:g} degrees at most; "
            f"use background=limits or background=empty_bin, or change background.min_share, "
            f"background.max_behind, background.max_tilt_deg or background.distance"
        )


def _height(points: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) distance from the plane z = a x + b y + c, towards the camera, metres."""
    a, b, c = plane
    above = points[:, 0] * a + points[:, 1] * b + c - points[:, 2]
    return np.asarray(above / math.sqrt(1 + a * a + b * b))


@dataclass(frozen=True)
class EmptyBin:
    """A depth image of the empty bin, from the same place with the same camera.

    A pixel is kept where it is nearer to the camera than the empty bin, by more than `distance`; of the empty
    bin the nearest depth within `reach` pixels counts, because steep walls jitter sideways. Where nothing was
    measured there within `reach` pixels, a pixel is kept: dark and shiny floors are not seen, parts on them
    are.

    Attributes:
        image: file of the depth image, any that `read_depth` reads; read once.
        distance: so much nearer than the empty bin, metres.
        scale: metres per unit of the file; None: see `read_depth`.
        offset, radial, of_integers: see `read_depth`.
        reach: pixels, to each side.
    """

    image: str
    distance: float = 0.003
    scale: float | None = None
    offset: float = 0.0
    radial: bool = False
    reach: int = 1
    of_integers: bool = False
    _read: dict[Camera, NDArray[np.float64]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        require_number("background.distance", self.distance, 0)
        if self.scale is not None:
            require_number("background.scale", self.scale, 0, above=True)
        require_number("background.offset", self.offset, -_FARTHEST)
        require_number("background.reach", self.reach, 0, 100)

    def __call__(self, points: Points, pixels: Pixels | None, camera: Camera | None) -> Kept:
        """See `Background`."""
        if pixels is None or camera is None:
            raise ValueError(
                "background=empty_bin compares pixels: it needs a depth image and its camera, not a cloud; "
                "use background=limits or background=plane"
            )
        if camera not in self._read:
            self._read[camera] = self._nearest(camera)
        return np.asarray(self._read[camera][pixels] - points[:, 2] > self.distance)

    def _nearest(self, camera: Camera) -> NDArray[np.float64]:
        """(height · width) least depth of the empty bin around each pixel; infinite where none is known."""
        from scipy.ndimage import minimum_filter

        depth = read_depth(
            Path(self.image),
            camera,
            self.scale,
            radial=self.radial,
            offset=self.offset,
            of_integers=self.of_integers,
        )
        try:
            check_depth(depth, Path(self.image), camera)
        except ValueError as fault:
            raise ValueError(f"background.image: {fault} (of the empty bin: background.scale)") from None
        known = np.where(np.isfinite(depth), depth, np.inf)
        return np.asarray(minimum_filter(known, 2 * int(self.reach) + 1, mode="nearest")).reshape(-1)
