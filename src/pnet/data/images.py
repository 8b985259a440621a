"""Images from elsewhere as arrays: depth and instance ids, in PNG, TIFF, EXR or NPY files.

Nothing in a file is ever run. The size is known before pixels are read, so that a wrong or hostile header
costs no memory.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

MOST_PIXELS = 64_000_000  # of an image whose size nobody knows beforehand
BITMAPS = (".png", ".tif", ".tiff")
ENDINGS = (*BITMAPS, ".exr", ".npy")
_MODES = {"L": np.uint8, "I;16": np.uint16, "I;16B": np.uint16, "I": np.int32, "F": np.float32}

Shape = tuple[int, int]  # (height, width)


def read_image(path: Path, shape: Shape | None = None) -> NDArray[Any]:
    """An image of one channel, with the numbers that the file holds.

    Args:
        path: ends in one of `ENDINGS`, in small or capital letters; an .exr needs the extra [formats].
        shape: height and width that it must have; None: any.
    Returns:
        (height, width) uint8, uint16, int32, uint32, float16, float32; of an .npy any real numbers.
    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
    """
    match path.suffix.lower():
        case ".npy":
            image = _read_npy(path, shape)
        case ".exr":
            channels = read_exr(path, shape)
            if len(channels) != 1:
                raise ValueError(f"{path}: has the channels {', '.join(sorted(channels))}, expected one")
            (image,) = channels.values()
        case ending if ending in BITMAPS:
            image = _read_bitmap(path, shape)
        case ending:
            raise ValueError(f"{path}: ends in {ending or 'nothing'}, expected one of {', '.join(ENDINGS)}")
    return image


def read_exr(path: Path, shape: Shape | None = None) -> dict[str, NDArray[Any]]:
    """Every channel of an OpenEXR file by its name, (height, width) each. Arguments and errors as of
    `read_image`; of a file of several images the first."""
    _check_file(path)
    try:
        import OpenEXR
    except ModuleNotFoundError as fault:
        raise ModuleNotFoundError(
            f'{path}: OpenEXR files need the package OpenEXR: pip install "pnet[formats]"'
        ) from fault
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            (left, top), (right, bottom) = file.header()["dataWindow"]
            count = len(file.header()["channels"])
        size = int(bottom) - int(top) + 1, int(right) - int(left) + 1
        _check_shape(path, size, shape)
        if count * size[0] * size[1] > MOST_PIXELS:
            raise _MismatchError(f"{path}: claims {count} channels, at most {MOST_PIXELS:,} numbers are read")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            found = {str(name): np.array(channel.pixels) for name, channel in file.channels().items()}
    except _MismatchError as fault:
        raise ValueError(str(fault)) from None
    except Exception as fault:  # the library raises classes of its own
        raise _unreadable(path, fault) from fault
    for name, pixels in found.items():
        if pixels.shape != size or pixels.dtype.kind not in "iuf":  # reduced, or many depths a pixel
            what = f"{pixels.shape[::-1]} pixels of type {pixels.dtype}"
            raise ValueError(f"{path}: channel {name!r} has {what}, expected a number for each pixel")
    return found


def npy_shape(path: Path) -> tuple[int, ...]:
    """The shape of the array in a .npy file, which is not read. Errors as of `read_image`."""
    return _map_npy(path).shape


class _MismatchError(ValueError):
    """A size that is not the expected one."""


def _map_npy(path: Path) -> NDArray[Any]:
    _check_file(path)
    try:
        found = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped: its size costs nothing
    except Exception as fault:
        raise _unreadable(path, fault) from fault
    if not isinstance(found, np.ndarray):
        raise ValueError(f"{path}: holds several arrays, expected one")
    return found


def _read_npy(path: Path, shape: Shape | None) -> NDArray[Any]:
    image = _map_npy(path)
    if image.ndim != 2 or image.dtype.kind not in "iuf":
        what = f"{image.shape} of type {image.dtype}"
        raise ValueError(f"{path}: holds {what}, expected numbers (height, width)")
    _check_shape(path, (image.shape[0], image.shape[1]), shape)
    return np.array(image, image.dtype.newbyteorder("="))  # torch reads no other order


def _read_bitmap(path: Path, shape: Shape | None) -> NDArray[Any]:
    _check_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PillowImage.DecompressionBombWarning)  # sizes are checked here
            with PillowImage.open(path, formats=("PNG", "TIFF")) as image:
                _check_shape(path, (image.height, image.width), shape)
                if image.mode not in _MODES:
                    raise _MismatchError(
                        f"{path}: has pixels of mode {image.mode}, expected one channel of 8 or 16 bits"
                    )
                return np.array(image, _MODES[image.mode])
    except _MismatchError as fault:
        raise ValueError(str(fault)) from None
    except Exception as fault:
        raise _unreadable(path, fault) from fault


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: the image file is empty")


def _check_shape(path: Path, found: Shape, expected: Shape | None) -> None:
    if expected is not None and found != expected:
        raise _MismatchError(
            f"{path}: has {found[1]} x {found[0]} pixels, the camera {expected[1]} x {expected[0]}"
        )
    if min(found) < 1 or found[0] * found[1] > MOST_PIXELS:
        raise _MismatchError(f"{path}: claims {found[1]} x {found[0]} pixels, expected 1 to {MOST_PIXELS:,}")


def _unreadable(path: Path, fault: Exception) -> ValueError:
    return ValueError(f"{path}: not readable as an image ({' '.join(str(fault).split())[:200]})")
