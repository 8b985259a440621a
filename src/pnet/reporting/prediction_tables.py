"""Detections as rows: for a file, a page and the terminal."""

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table
from scipy.spatial.transform import Rotation

from pnet.parts.base import ParametricPart
from pnet.records import Detections
from pnet.reporting.data_tables import Sheet, rich_table
from pnet.reporting.tables import MISSING
from pnet.scenes.record_file import write_atomically

Points = NDArray[np.float64]
Row = dict[str, float]

POSITION = ("x_mm", "y_mm", "z_mm")
TURN = ("rx_deg", "ry_deg", "rz_deg")
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
NOTE = (
    "Poses are part → camera: x right, y down, z forward; x, y, z and sizes in mm. rx, ry, rz is the "
    "rotation vector: its direction is the axis, its length the angle in degrees."
)
_DECIMALS = {"score": 3, **dict.fromkeys(POSITION, 2), **dict.fromkeys(TURN, 1)}


def by_score(detections: Detections) -> NDArray[np.int64]:
    """(d,) indices of the detections, the highest score first, NaN last; rank 1 is the first."""
    return np.argsort(-detections.score.detach().double().cpu().numpy(), kind="stable")


def csv_columns(part: ParametricPart) -> list[str]:
    """The names in `detection_rows`, with their units, in order."""
    sizes = parameter_columns(part).values()
    return ["rank", "score", *POSITION, *TURN, *sizes, "points", *MATRIX]


def parameter_columns(part: ParametricPart) -> dict[str, str]:
    """Name of each parameter → name of its column."""
    taken = {"rank", "score", "points", *POSITION, *TURN, *MATRIX}
    names = {name: f"{name}_mm" for name in part.parameter_names}
    return {name: f"parameter_{column}" if column in taken else column for name, column in names.items()}


def detection_rows(detections: Detections, part: ParametricPart) -> list[Row]:
    """The detections as plain numbers, best score first.

    Args:
        part: the template, whose parameters have names.
    Returns:
        For each detection a number by the names of `csv_columns`: its rank from 1; its score; position of the
        part's centroid, mm; rotation vector, degrees (NaN where R is no rotation); parameters, mm (NaN where
        they are not estimated); how many points were clustered to it; R row by row.
    """
    tensors = (detections.score, detections.t, detections.R, detections.parameters)
    score, t, R, parameters = (tensor.detach().double().cpu().numpy() for tensor in tensors)
    instance = detections.instance.cpu().numpy()
    points = np.bincount(instance[instance >= 0], minlength=len(score))
    turn = rotation_vectors(R)
    rows, columns = [], csv_columns(part)
    for rank, i in enumerate(by_score(detections).tolist(), 1):
        lengths = [*(1000 * t[i]), *turn[i], *(1000 * parameters[i])]
        values = [rank, float(score[i]), *map(float, lengths), int(points[i]), *R[i].ravel().tolist()]
        rows.append(dict(zip(columns, values, strict=True)))
    return rows


def rotation_vectors(R: Points) -> Points:
    """(d, 3) axis times angle in degrees of rotations (d, 3, 3); NaN where one is none."""
    vectors = np.full((len(R), 3), np.nan)
    valid = np.flatnonzero(np.isfinite(R).all((1, 2)))
    valid = valid[np.linalg.det(R[valid]) > 0.5]
    if len(valid):
        vectors[valid] = Rotation.from_matrix(R[valid]).as_rotvec(degrees=True)
    return vectors


def write_detections_csv(path: Path, detections: Detections, part: ParametricPart) -> None:
    """Write `detection_rows` under `csv_columns`, every digit of them; the file appears when it is whole.

    Args:
        path: where to write; the folder must exist.
    """
    file = io.StringIO()
    writer = csv.DictWriter(file, csv_columns(part), lineterminator="\n")
    writer.writeheader()
    writer.writerows(detection_rows(detections, part))
    write_atomically(path, file.getvalue().encode())


def detection_sheet(detections: Detections, part: ParametricPart, most: int | None = None) -> Sheet:
    """The detections for people.

    Args:
        most: how many are shown, the best ones; None: all.
    """
    rows = detection_rows(detections, part)
    names = parameter_columns(part)
    columns = {"rank": "#", "score": "score"}
    columns |= {name: name.split("_")[0] for name in (*POSITION, *TURN)}
    columns |= {column: name for name, column in names.items()} | {"points": "points"}
    shown = [[_text(name, row[name]) for name in columns] for row in rows[:most]]
    more = len(rows) - len(shown)
    note = f"and {more:,} more with lower scores. {NOTE}" if more else NOTE
    count = f"{len(rows):,} found" if rows else "nothing was found"
    return Sheet(f"{part.name.upper()}: {count}", list(columns.values()), shown, note if rows else "")


def detections_table(detections: Detections, part: ParametricPart, most: int = 20) -> Table:
    """The best detections, for the terminal; a note says how many more there are."""
    table = rich_table(detection_sheet(detections, part, most))
    table.box, table.padding, table.pad_edge = box.SIMPLE_HEAD, (0, 0), False  # fits into 80 characters
    return table


def stage_text(seconds: Mapping[str, float]) -> str:
    """Time of each stage and of all together, in one line.

    Args:
        seconds: by stage, in order; NaN where a time is not known.
    """
    stages = [f"{stage} {time_text(value)}" for stage, value in seconds.items()]
    if len(stages) > 1:
        stages.append(f"together {time_text(math.fsum(seconds.values()))}")
    return ", ".join(stages)


def time_text(seconds: float) -> str:
    """A time with about three digits."""
    if not math.isfinite(seconds):
        return MISSING
    if seconds >= 0.9995:
        return f"{seconds:.1f} s" if seconds >= 9.995 else f"{seconds:.2f} s"
    return f"{1000 * seconds:.0f} ms" if seconds >= 0.00995 else f"{1000 * seconds:.1f} ms"


def _text(name: str, value: float) -> str:
    if not math.isfinite(value):
        return MISSING
    decimals = 0 if name in ("rank", "points") else _DECIMALS.get(name, 2)
    return f"{value + 0.0:.{decimals}f}"
