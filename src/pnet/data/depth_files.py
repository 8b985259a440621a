"""Depth images from elsewhere, in metres."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.images import read_exr, read_image
from pnet.geometry.camera import Camera
from pnet.scenes.limits import require_number

MILLIMETRE = 0.001  # metres per unit, what 16-bit depth images mostly hold
NOTHING = 1e9  # raw values from here on: renderers write 1e10 where no surface is
NEAREST, FARTHEST = 0.001, 50.0  # metres; a median depth beyond comes from a wrong scale
DEPTH_CHANNELS = ("z", "depth", "d", "y")  # of an OpenEXR file, the surest first

Depth = NDArray[np.float64]


def read_depth(
    path: Path,
    camera: Camera | None = None,
    scale: float | None = None,
    missing: Sequence[float] | None = None,
    radial: bool = False,
    offset: float = 0.0,
    of_integers: bool = False,
) -> Depth:
    """A depth image of any format that `read_image` knows, and OpenEXR files with several channels.

    Of several EXR channels the one named Z, Depth, D or Y counts, in this order, else all colours where they
    are equal.

    Args:
        path: the file. camera: whose image it is, for the size; None: any size.
        scale: metres per unit of the file. None: 0.001 where the file holds integers of 16 bits or more, the
            usual millimetres, and 1 where it holds floating point numbers; integers of 8 bits need it.
        missing: values of the file that mean "not measured", besides 0, NaN, infinity and whatever is 1e9 or
            more. None: 65535 in files of unsigned 16 bits. An empty list: none.
        radial: the file holds the distance from the camera's centre, not planar depth; needs the camera.
        offset: metres added to the file's number times `scale`, as files between two clip planes have it; a 0
            in the file is a depth then.
        of_integers: `scale`, `offset` and `missing` are those of integers; floating point numbers are metres.
    Returns:
        (height, width) planar depth, metres, more than 0; NaN where nothing was measured.
    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
        ModuleNotFoundError: OpenEXR is missing.
    """
    if scale is not None:
        require_number("scale", scale, 0, above=True)
    require_number("offset", offset, -FARTHEST)
    if radial and camera is None:
        raise ValueError(f"{path}: turning distances into planar depth needs the camera")
    raw = _read_raw(path, None if camera is None else (camera.height, camera.width))
    if of_integers and raw.dtype.kind == "f":
        scale, offset, missing = None, 0.0, None
    depth = _in_metres(raw, _scale_of(raw, scale, path), missing, path, offset)
    return depth / camera.ray_lengths() if radial and camera is not None else depth


def check_depth(depth: Depth, path: Path, camera: Camera | None = None) -> None:
    """Raise ValueError where a depth image cannot be right: nothing measured, or an unlikely scale.

    Args:
        depth: (height, width) metres, NaN where nothing was measured. path: its file, for the error.
        camera: whose range at least one pixel must lie in; None: not asked.
    """
    known = depth[np.isfinite(depth)]
    if not len(known):
        raise ValueError(f"{path}: no pixel was measured: every one holds a value that means 'missing'")
    median = float(np.median(known))
    if not NEAREST <= median <= FARTHEST:
        raise ValueError(
            f"{path}: the median depth is {median:g} m, expected {NEAREST:g} to {FARTHEST:g} m; "
            f"set depth.scale= to the metres per unit"
        )
    if camera is not None and not ((known >= camera.near) & (known <= camera.far)).any():
        raise ValueError(
            f"{path}: depths reach from {known.min():g} to {known.max():g} m, none lies within the camera's "
            f"{camera.near:g} to {camera.far:g} m; set depth.scale= to the metres per unit, or "
            f"near and far of the camera"
        )


def _read_raw(path: Path, shape: tuple[int, int] | None) -> NDArray[Any]:
    """(height, width) numbers as the file holds them."""
    if path.suffix.lower() != ".exr":
        return read_image(path, shape)
    image = _depth_channel(read_exr(path, shape), path)
    if image.ndim != 2 or (shape is not None and image.shape != shape):
        raise ValueError(f"{path}: the depth channel has shape {image.shape}, expected {shape or '(h, w)'}")
    if image.dtype.kind not in "iuf":
        raise ValueError(f"{path}: the depth channel holds {image.dtype}, expected numbers")
    return image


def _depth_channel(channels: dict[str, NDArray[Any]], path: Path) -> NDArray[Any]:
    if len(channels) == 1:
        return next(iter(channels.values()))
    for wanted in DEPTH_CHANNELS:  # the last word of a layer's channel: "view.Z"
        found = [name for name in channels if name.lower().split(".")[-1] == wanted]
        if len(found) == 1:
            return channels[found[0]]
    colours = [image for name, image in channels.items() if name.lower().split(".")[-1] != "a"]
    if colours and all(np.array_equal(colours[0], other, equal_nan=True) for other in colours[1:]):
        return colours[0]
    names = ", ".join(sorted(channels)) or "none"
    raise ValueError(
        f"{path}: has the channels {names[:200]}; expected one, or one named Z, Depth, D or Y, or equal ones"
    )


def _scale_of(raw: NDArray[Any], scale: float | None, path: Path) -> float:
    """Metres per unit."""
    if scale is not None:
        return float(scale)
    if raw.dtype.kind in "iu" and raw.dtype.itemsize == 1:
        raise ValueError(
            f"{path}: holds integers of 8 bits, which seldom are depths; set depth.scale= to metres per unit"
        )
    return 1.0 if raw.dtype.kind == "f" else MILLIMETRE


def _in_metres(
    raw: NDArray[Any], scale: float, missing: Sequence[float] | None, path: Path, offset: float
) -> Depth:
    if missing is None:
        missing = [np.iinfo(np.uint16).max] if raw.dtype == np.uint16 else []
    if not all(isinstance(value, int | float) for value in missing):
        raise ValueError(f"missing is {list(missing)!r}, expected a list of numbers")
    with np.errstate(invalid="ignore"):  # some NaN complain
        values = raw.astype(np.float64)
    nothing = (values == 0) & (offset == 0)
    lost = ~np.isfinite(values) | nothing | (values >= NOTHING) | np.isin(values, list(missing))
    values[lost] = np.nan
    if (values < 0).any():
        raise ValueError(
            f"{path}: has negative depths (lowest {np.nanmin(values):g}); "
            f"name the value in missing (depth.missing=) if it means that nothing was measured"
        )
    depth = values * scale + offset
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan  # what the scale brought out of the numbers' range
    return depth
