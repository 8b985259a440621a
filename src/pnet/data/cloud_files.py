"""Point clouds from elsewhere, in metres.

Nothing in a file is ever run, and memory stays in proportion to the file's size, whatever a header claims.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnet.data.depth_files import FARTHEST, NEAREST
from pnet.data.pcd_files import read_pcd
from pnet.data.ply_files import read_ply
from pnet.data.point_records import read_rows

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # metres
MOST_BYTES = 4 << 30
MOST_COLUMNS = 16  # of an array; more: its axes are the wrong way round

Points = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud as it was read.

    Attributes:
        points: (n, 3) float32 metres, finite, n at least 1.
        missing: points of the file that were left out because they are not finite or (0, 0, 0), which sensors
            write where they measured nothing.
    """

    points: NDArray[np.float32]
    missing: int


def read_cloud(path: Path, unit: str = "m") -> Cloud:
    """The points of a cloud file.

    Args:
        path: .ply (text, binary of either byte order), .pcd (text, binary, compressed), .npy ((n, 3 or more)
            or (height, width, 3)), .xyz or .txt (x y z in each line, between blanks, commas or semicolons; #
            and // start comments); columns, properties and fields beyond the coordinates are left out.
        unit: of the file's numbers, "m", "cm" or "mm".
    Returns:
        The points with at least one that was measured, in the file's order and frame.
    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
        ModuleNotFoundError: a compressed .pcd file needs the extra [formats].
    """
    if unit not in UNITS:
        raise ValueError(f"unit is {unit!r}, expected one of {', '.join(UNITS)}")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: ends in {path.suffix or 'nothing'}, expected one of {', '.join(_READERS)}")
    _check_file(path)
    raw = reader(path)
    with np.errstate(over="ignore", invalid="ignore"):
        points = (raw * UNITS[unit]).astype(np.float32)
    measured = np.isfinite(points).all(1) & (points != 0).any(1)
    if not measured.any():
        raise ValueError(f"{path}: has no finite point ({len(raw):,} in all)")
    return Cloud(points[measured], int((~measured).sum()))


def check_cloud(points: NDArray[np.floating], path: Path) -> None:
    """Raise ValueError where points cannot be metres in a camera's frame.

    Args:
        points: (n, 3). path: their file, for the error.
    """
    z = points[:, 2]
    if np.mean(z <= 0) > 0.5:
        raise ValueError(
            f"{path}: most points lie behind the camera (z from {z.min():g} to {z.max():g} m); expected the "
            f"camera's frame: x right, y down, z forward"
        )
    median = float(np.median(z))
    if not NEAREST <= median <= FARTHEST:
        raise ValueError(
            f"{path}: the median depth is {median:g} m, expected {NEAREST:g} to {FARTHEST:g} m; "
            f"set cloud.unit= to the file's ({', '.join(UNITS)})"
        )


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such cloud file")
    size = path.stat().st_size
    if not 0 < size <= MOST_BYTES:
        raise ValueError(f"{path}: has {size:,} bytes, expected 1 to {MOST_BYTES:,}")


def _read_npy(path: Path) -> Points:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped: what it claims costs nothing
    except Exception as fault:  # its header is parsed as Python literals
        raise ValueError(
            f"{path}: not readable as an array ({' '.join(str(fault).split())[:200]})"
        ) from fault
    shape: tuple[int, ...] = getattr(array, "shape", ())
    rows = len(shape) == 2 and 3 <= shape[1] <= MOST_COLUMNS
    image = len(shape) == 3 and shape[2] == 3
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf" or not (rows or image):
        what = f"{shape or '?'} of type {getattr(array, 'dtype', '?')}"
        raise ValueError(
            f"{path}: holds {what}, expected numbers (n, 3 to {MOST_COLUMNS}) or (height, width, 3)"
        )
    return np.array(array[..., :3], np.float64).reshape(-1, 3)


def _read_text(path: Path) -> Points:
    def lines() -> Iterator[str]:
        with path.open(encoding="utf-8-sig", errors="replace") as file:  # comments: any encoding
            for line in file:
                yield line.replace(",", " ").replace(";", " ")

    return read_rows(path, lines(), (0, 1, 2), comments=["#", "//"])


_READERS: dict[str, Callable[[Path], Points]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".npy": _read_npy,
    ".xyz": _read_text,
    ".txt": _read_text,
}
