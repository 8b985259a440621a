"""The errors of an evaluation summed up: plain numbers for a file, and tables of them for the terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from pnet.geometry.symmetry import FiniteSymmetry
from pnet.metrics.breakdown import Breakdown, TruthRows
from pnet.metrics.outcomes import Kind, Outcome, Reason
from pnet.metrics.pose_attributes import Blame
from pnet.metrics.score_losses import Calibration, calibration, score_losses, sure_and_false
from pnet.parts.base import ParametricPart
from pnet.reporting.breakdown_bins import Bins, attribute_bins, outcome_shares, size_bins
from pnet.reporting.breakdown_rows import AXES, Row, rows_of
from pnet.reporting.tables import MISSING

Floats = NDArray[np.float64]
_LISTED = 20  # sure and false results


def summary(breakdown: Breakdown, part: ParametricPart, ids: Sequence[str]) -> dict[str, Any]:
    """All numbers as plain values; lengths in mm, angles in degrees.

    Args:
        ids: the scenes' names, in the order of the rows.
    """
    truths, results = breakdown.truths, breakdown.results
    tables = [*attribute_bins(truths), *size_bins(truths, part)]
    found = truths.fate.outcome == Outcome.FOUND
    return {
        "part": part.name,
        "scenes": len(breakdown.matches),
        "truths_to_find": len(truths),
        "results": len(results),
        "outcomes": {o.label: counted(truths.fate.outcome == o) for o in Outcome},
        "wrong_poses": wrong_poses(truths, part),
        "kinds": {k.label: int((results.kinds.kind == k).sum()) for k in Kind},
        "reasons": {r.label: int((results.kinds.reason == r).sum()) for r in Reason if r != Reason.NONE},
        "score": asdict(score_losses(breakdown)),
        "calibration": _calibration_rows(calibration(breakdown)),
        "sure_and_false": _sure_and_false(breakdown, ids),
        "errors": {"all": error_numbers(truths, part), "found": error_numbers(truths, part, found)},
        "by": {bins.name: _bin_rows(bins, truths) for bins in tables},
    }


def counted(rows: NDArray[np.bool_]) -> dict[str, float]:
    """How many rows, and their share."""
    return {"count": int(rows.sum()), "share": float(rows.mean()) if len(rows) else float("nan")}


def wrong_poses(truths: TruthRows, part: ParametricPart) -> dict[str, Any]:
    """Wrong poses by what is to blame; how many are turned far; about which axis of the part those with a
    wrong rotation are turned most (not told of a revolution: those across its own axis are any)."""
    wrong = truths.fate.outcome == Outcome.WRONG_POSE
    blame = truths.errors.blame
    turned = wrong & np.isin(blame, (Blame.ROTATION, Blame.BOTH))
    nearest = np.abs(np.nan_to_num(truths.errors.turn)).argmax(1)
    axes = AXES if isinstance(part.symmetry, FiniteSymmetry) else ()
    return {
        "blame": {b.label: int((wrong & (blame == b)).sum()) for b in Blame},
        "flips": int((wrong & truths.errors.flip).sum()),
        "turned_about": {name: int((turned & (nearest == i)).sum()) for i, name in enumerate(axes)},
    }


def error_numbers(
    truths: TruthRows, part: ParametricPart, rows: NDArray[np.bool_] | None = None
) -> dict[str, Any]:
    """Errors of the best results, of some rows or of all."""
    of = np.ones(len(truths), bool) if rows is None else rows
    sizes, places = 1000 * truths.parameter_error[of], 1000 * truths.keypoint_error[of]
    return {
        "position_mm": _spread(1000 * truths.errors.position[of]),
        "rotation_deg": _spread(np.degrees(truths.errors.rotation[of])),
        "parameters_mm": {name: _spread(sizes[:, i]) for i, name in enumerate(part.parameter_names)},
        "keypoints_mm": {name: _spread(places[:, i]) for i, name in enumerate(part.chain.names)},
    }


def outcome_table(told: Mapping[str, Any]) -> Table:
    """Outcomes, and what each takes from AP. told: of `summary`."""
    table = Table(title="what became of the true poses", title_justify="left")
    for name in ("outcome", "true poses", "share", "AP lost"):
        table.add_column(name, justify="left" if name == "outcome" else "right", no_wrap=True)
    score = told["score"]
    for name, numbers in told["outcomes"].items():
        lost = score["by_outcome"].get(name)
        share = text(100 * numbers["share"], 1, " %")
        table.add_row(name, f"{numbers['count']:,}", share, "" if lost is None else f"{lost:.3f}")
    table.add_row("false results before right ones", "", "", f"{score['by_order']:.3f}")
    table.add_row("AP", f"{told['truths_to_find']:,}", "", f"{score['ap']:.3f}")
    return table


def error_table(told: Mapping[str, Any]) -> Table:
    """Parameter and keypoint errors of the best results. told: of `summary`."""
    table = Table(title="errors of the best results, mm", title_justify="left")
    for name in ("", "mean absolute", "bias", "median", "90 %"):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    errors = told["errors"]["all"]
    for kind, group in (("parameter", errors["parameters_mm"]), ("keypoint", errors["keypoints_mm"])):
        for name, n in group.items():
            bias = text(n["bias"], 2, sign=True) if kind == "parameter" else ""
            numbers = [text(n["mean"], 2), bias, text(n["median"], 2), text(n["q90"], 2)]
            table.add_row(f"{kind} {name}", *numbers)
    return table


def text(value: float, decimals: int, unit: str = "", sign: bool = False) -> str:
    """A number for people, a dash for none."""
    if not np.isfinite(value):
        return MISSING
    return f"{value:{'+' if sign else ''}.{decimals}f}{unit}"


def wrong_pose_line(told: Mapping[str, Any]) -> str:
    """What is to blame for wrong poses, and what mending it alone would bring, in one line."""
    poses, mended = told["wrong_poses"], told["score"]["if_mended"]
    causes = [
        f"{name} {count:,} (AP {mended[f'wrong {name}']:.3f} if mended)"
        for name, count in poses["blame"].items()
        if name != "none" and count
    ]
    about = ", ".join(f"{name} {count:,}" for name, count in poses["turned_about"].items() if count)
    about = f"; wrong rotations by the part's axis: {about}" if about else ""
    flips = f"; turned by more than 60°: {poses['flips']:,}" if poses["flips"] else ""
    return f"wrong poses by what is wrong: {', '.join(causes)}{about}{flips}" if causes else "no wrong pose"


def _spread(values: Floats) -> dict[str, float]:
    """Mean and quantiles of the absolute values, the mean of the signed ones, and how many there are."""
    values = values[np.isfinite(values)]
    if not len(values):
        return {**dict.fromkeys(("mean", "bias", "median", "q90"), float("nan")), "count": 0}
    size = np.abs(values)
    q50, q90 = np.quantile(size, [0.5, 0.9]).tolist()
    mean, bias = float(size.mean()), float(values.mean())
    return {"mean": mean, "bias": bias, "median": q50, "q90": q90, "count": len(values)}


def _calibration_rows(bins: Calibration) -> list[Row]:
    columns = {"low": bins.low, "high": bins.high, "right": bins.right, "counted": bins.counted}
    return rows_of({**columns, "precision": bins.precision})


def _sure_and_false(breakdown: Breakdown, ids: Sequence[str]) -> dict[str, Any]:
    results, sure = breakdown.results, sure_and_false(breakdown)
    reason = results.kinds.reason
    by_reason = {r.label: int((sure & (reason == r)).sum()) for r in Reason if (sure & (reason == r)).any()}
    first = np.flatnonzero(sure)
    first = first[np.argsort(-results.score[first], kind="stable")][:_LISTED]
    highest = [
        {
            "scene": ids[results.scene[i]],
            "result": int(results.result[i]),
            "score": float(results.score[i]),
            "reason": Reason(reason[i]).label,
        }
        for i in first
    ]
    return {"count": int(sure.sum()), "by_reason": by_reason, "highest": highest}


def _bin_rows(bins: Bins, truths: TruthRows) -> list[Row]:
    shares = outcome_shares(bins, truths)
    columns = {"low": bins.low, "high": bins.high, "count": bins.count}
    return rows_of({**columns, **{o.label: share for o, share in shares.items()}})
