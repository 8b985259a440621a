"""The Fraunhofer IPA data set's `gt/*.csv`: the true poses of one scene."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnet.data.public.labelled_image import check_rotations, read_lines

Points = NDArray[np.float64]
COLUMNS = 16  # id, class, x, y, z, nine of the rotation, visibility_score_o, visibility_score_p
BIN = 0
HIGHEST_ID = 255
# Their camera frame has x left and y up: half a turn about the viewing axis.
TO_CAMERA = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Truth:
    """What is true of a scene of d bodies.

    Attributes:
        ids: (d,) int64 value of the body's pixels in the segmentation.
        R: (d, 3, 3), t: (d, 3) object → camera, x right, y down, z forward, metres.
        occlusion: (d,) 1 − visible share, in [0, 1].
    """

    ids: NDArray[np.int64]
    R: Points
    t: Points
    occlusion: Points


def read_truth(path: Path) -> Truth:
    """Read the truth of a scene: a header line, then a line for the bin (id 0) and each body.

    Poses are taken to be relative to the camera, rotations column by column. Occlusion is one minus
    visibility_score_p, which may exceed 1 a little and is then 1.

    Raises:
        FileNotFoundError, ValueError: names the file and the line.
    """
    rows = _read_rows(path)
    ids = [_whole(row[0], where) for where, row in rows]
    bodies = [(where, row) for (where, row), number in zip(rows, ids, strict=True) if number != BIN]
    if len(rows) - len(bodies) > 1:
        raise ValueError(f"{path}: the bin's id {BIN} comes twice")
    values = np.reshape([_numbers(row[2:], where) for where, row in bodies], (-1, COLUMNS - 2))
    R = values[:, 3:12].reshape(-1, 3, 3).swapaxes(1, 2)  # the file has columns one after the other
    check_rotations(R, str(path))
    visible = values[:, 13]
    if (visible < 0).any():
        raise ValueError(f"{path}: a visibility_score_p is {visible.min():g}, expected 0 to 1")
    numbers = np.array([number for number in ids if number != BIN], np.int64)
    return Truth(numbers, TO_CAMERA @ R, values[:, :3] @ TO_CAMERA, 1 - np.minimum(visible, 1))


def _read_rows(path: Path) -> list[tuple[str, list[str]]]:
    """Where each row stands, for errors, and its fields; without the header."""
    lines = read_lines(path)
    try:
        rows = [(f"{path}: line {i}", row) for i, row in enumerate(csv.reader(lines), 1) if row]
    except csv.Error as fault:
        raise ValueError(f"{path}: not a table with commas ({fault})") from fault
    for where, row in rows:
        if len(row) != COLUMNS:
            raise ValueError(f"{where} has {len(row)} fields, expected {COLUMNS}: id, class, x, y, z, …")
    if not rows or rows[0][1][0].strip().lower() != "id":
        raise ValueError(f"{path}: does not begin with a header line id,class,x,y,z,…")
    if len(rows) - 1 > HIGHEST_ID + 1:
        raise ValueError(f"{path}: has {len(rows) - 1} rows, more than an 8-bit segmentation can tell apart")
    return rows[1:]


def _whole(text: str, where: str) -> int:
    (value,) = _numbers([text], where)
    if value % 1 or not 0 <= value <= HIGHEST_ID:
        raise ValueError(f"{where}: the id is {text!r}, expected a whole number, 0 to {HIGHEST_ID}")
    return int(value)


def _numbers(words: Sequence[str], where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as fault:
        raise ValueError(f"{where}: {fault}") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{where}: holds NaN or infinity")
    return values
