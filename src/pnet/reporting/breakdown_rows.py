"""The true poses to find and the results of an evaluation as rows for a spreadsheet."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pnet.metrics.breakdown import Breakdown
from pnet.metrics.outcomes import Kind, Outcome, Reason
from pnet.metrics.pose_attributes import Blame
from pnet.metrics.score_losses import sure_and_false
from pnet.parts.base import ParametricPart

Row = dict[str, Any]
AXES = ("x", "y", "z")  # of the part


def truth_table(breakdown: Breakdown, part: ParametricPart, ids: Sequence[str]) -> list[Row]:
    """A row for every true pose to find, with everything; lengths in mm, angles in degrees."""
    truths = breakdown.truths
    fate, of, errors = truths.fate, truths.attributes, truths.errors
    wrong = fate.outcome == Outcome.WRONG_POSE
    blame = np.where(wrong, errors.blame, Blame.NONE)
    columns: dict[str, Iterable[Any]] = {
        "scene": [ids[i] for i in truths.scene],
        "body": fate.body,
        "outcome": [Outcome(o).label for o in fate.outcome],
        "blame": [Blame(b).label if b != Blame.NONE else "" for b in blame],
        "flip": (errors.flip & wrong).astype(int),
        "visibility": of.visibility,
        "occlusion": of.occlusion,
        "tilt_deg": np.degrees(of.tilt),
        "neighbour_mm": 1000 * of.neighbour,
        "points": fate.points,
        "unclustered": fate.unclustered,
        "home": fate.home,
        "points_at_home": fate.at_home,
        "home_size": fate.home_size,
        "pieces": fate.pieces,
        "result": fate.result,
        "score": truths.score,
        "distance_mm": 1000 * errors.distance,
        "threshold_mm": 1000 * errors.threshold,
        "position_error_mm": 1000 * errors.position,
        "rotation_distance_mm": 1000 * errors.rotation_distance,
        "rotation_error_deg": np.degrees(errors.rotation),
        **{f"turn_{name}_deg": np.degrees(errors.turn[:, i]) for i, name in enumerate(AXES)},
    }
    for i, name in enumerate(part.parameter_names):
        columns[f"true_{name}_mm"] = 1000 * of.parameters[:, i]
        columns[f"error_{name}_mm"] = 1000 * truths.parameter_error[:, i]
    for i, name in enumerate(part.chain.names):
        columns[f"margin_{name}_mm"] = 1000 * of.margin[:, i]
        columns[f"keypoint_error_{name}_mm"] = 1000 * truths.keypoint_error[:, i]
    return rows_of(columns)


def result_table(breakdown: Breakdown, ids: Sequence[str]) -> list[Row]:
    """A row for every result."""
    results, sure = breakdown.results, sure_and_false(breakdown)
    kinds = results.kinds
    columns: dict[str, Iterable[Any]] = {
        "scene": [ids[i] for i in results.scene],
        "result": results.result,
        "score": results.score,
        "kind": [Kind(k).label for k in kinds.kind],
        "reason": ["" if r == Reason.NONE else Reason(r).label for r in kinds.reason],
        "sure_and_false": sure.astype(int),
        "nearest_body": results.truth,
        "distance_mm": 1000 * results.distance,
        "owner": kinds.owner,
        "points": kinds.points,
        "owned": kinds.owned,
    }
    return rows_of(columns)


def csv_text(rows: Sequence[Row], columns: Sequence[str] | None = None) -> str:
    """The rows under their names; numbers with six digits, nothing where there is no number.

    Args:
        columns: names for a table without rows.
    """
    file = io.StringIO()
    writer = csv.DictWriter(file, list(rows[0]) if rows else list(columns or []), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
    return file.getvalue()


def rows_of(columns: Mapping[str, Iterable[Any]]) -> list[Row]:
    """Columns of equal length by name → a row for each place."""
    plain = [column.tolist() if isinstance(column, np.ndarray) else column for column in columns.values()]
    return [dict(zip(columns, values, strict=True)) for values in zip(*plain, strict=True)]


def _plain(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return "" if value != value else f"{value:.6g}"
