"""The Parametric data set's truth: a CSV file a scene, a row a body."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnet.data.public.labelled_image import FARTHEST, check_rotations, read_lines
from pnet.data.public.parametric_camera import check_size
from pnet.parts.base import ParametricPart

Points = NDArray[np.float64]

_LARGEST = 10.0  # metres, of a parameter; likewise
_POSE = 14  # numbers before the parameters: id, t, R, visibility


@dataclass(frozen=True, eq=False)
class Truth:
    """The bodies of a scene by segmentation id.

    Attributes:
        R: (d, 3, 3), t: (d, 3) object → camera, metres. visibility: (d,) in [0, 1].
        parameters: (k,) metres, of every body.
    """

    R: Points
    t: Points
    visibility: Points
    parameters: Points


def read_truth(path: Path, part: ParametricPart, most: int) -> Truth:
    """Read a scene's CSV: a header line, then class, id, t, R row by row, visibility, parameters.

    Args:
        path: the file. part: whose parameters it must have, in the part's order. most: bodies dropped.
    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
    """
    rows = _read_rows(path, _POSE + part.k, part)
    if not 1 <= len(rows) <= most:
        raise ValueError(
            f"{path}: has {len(rows)} rows, expected 1 to {most}, the bodies that its name tells"
        )
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    if not np.array_equal(rows[:, 0], np.arange(len(rows))):
        ids = ", ".join(f"{x:g}" for x in rows[:, 0])
        raise ValueError(f"{path}: segmentation ids are {ids}, expected 0 to {len(rows) - 1}, each once")
    R, t, visibility = rows[:, 4:13].reshape(-1, 3, 3), rows[:, 1:4], rows[:, 13]
    check_bodies(R, t, visibility, str(path))
    return Truth(R, t, visibility, _one_object(rows[:, _POSE:] / 1000, part, path))


def check_bodies(R: Points, t: Points, visibility: Points, where: str) -> None:
    """Raise ValueError where poses (d, 3, 3), (d, 3) or visibility (d,) cannot be. where: for the error."""
    check_rotations(R, where)
    if not (np.abs(t) <= FARTHEST).all() or not (t[:, 2] > 0).all():
        worst = t[np.argmin(np.where(np.abs(t).max(1) <= FARTHEST, t[:, 2], -np.inf))]
        raise ValueError(
            f"{where}: a body is at t = {worst.tolist()}, expected metres in the camera frame, z > 0"
        )
    if not ((visibility >= 0) & (visibility <= 1)).all():
        raise ValueError(
            f"{where}: visibility is {visibility.min():g} to {visibility.max():g}, expected 0 to 1"
        )


def _read_rows(path: Path, count: int, part: ParametricPart) -> Points:
    """(d, count) the numbers of every row after the class."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    check_size(path)
    lines = [(i, line.split(",")) for i, line in enumerate(read_lines(path), 1) if line.strip()]
    if not lines:
        raise ValueError(f"{path}: is empty, expected a header line and a row for each body")
    if all(_is_number(cell) for cell in lines[0][1][1:]):
        raise ValueError(f"{path}: line {lines[0][0]} holds numbers, expected a header line")
    for i, cells in lines[1:]:
        if len(cells) != 1 + count:
            raise ValueError(
                f"{path}: line {i} has {len(cells)} columns, expected {1 + count}: class, id, t, R, "
                f"visibility and the parameters {', '.join(part.parameter_names)} of {part.name}"
            )
        for column, cell in enumerate(cells[1:], 2):
            if not (_is_number(cell) and np.isfinite(float(cell))):
                raise ValueError(f"{path}: line {i}, column {column} is {cell[:40]!r}, expected a number")
    return np.array([[float(cell) for cell in cells[1:]] for _, cells in lines[1:]]).reshape(-1, count)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _one_object(parameters: Points, part: ParametricPart, path: Path) -> Points:
    """(k,) the row that all of (d, k) are, metres."""
    first = parameters[0]
    if np.abs(parameters - first).max() > 1e-9:
        body = int(np.abs(parameters - first).max(1).argmax())
        raise ValueError(
            f"{path}: bodies differ in size, 0 has {part.text(first)}, {body} has "
            f"{part.text(parameters[body])}; expected one part object a scene"
        )
    try:
        part.check_named(first)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault
    if first.max() > _LARGEST:
        raise ValueError(f"{path}: {part.text(first)}; expected parameters in mm")
    return first
