"""Rows of an evaluation gathered in bins of what may make a pose hard to find."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnet.metrics.breakdown import TruthRows
from pnet.metrics.outcomes import Outcome
from pnet.parts.base import ParametricPart

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
FEW = 20  # a share of fewer rows says little
_DISTINCT = 8  # more values than these are gathered


@dataclass(frozen=True, eq=False)
class Bins:
    """n rows in b bins.

    Attributes:
        name: of the quantity, with its unit. low, high: (b,) borders, in that unit. labels: (b) for an axis.
        member: (b, n) which rows are in each; rows without a finite value are in none.
    """

    name: str
    low: Floats
    high: Floats
    labels: list[str]
    member: Bools

    @property
    def count(self) -> NDArray[np.int64]:
        """(b,) rows in each."""
        return self.member.sum(1)


def fixed_bins(name: str, values: Floats, edges: Floats) -> Bins:
    """Bins between given borders; the lower one belongs to a bin, the last upper one too. Empty ones go."""
    of = np.digitize(values, edges) - 1
    of[values == edges[-1]] = len(edges) - 2
    member = (of[None] == np.arange(len(edges) - 1)[:, None]) & np.isfinite(values)
    used = member.any(1)
    low, high = edges[:-1][used], edges[1:][used]
    labels = [f"{a:g}–{b:g}" for a, b in zip(low, high, strict=True)]
    return Bins(name, low, high, labels, member[used])


def quantile_bins(name: str, values: Floats, count: int) -> Bins:
    """Bins of about as many finite values each; equal values are never divided."""
    finite = np.isfinite(values)
    if not finite.any():
        return Bins(name, np.zeros(0), np.zeros(0), [], np.zeros((0, len(values)), bool))
    inner = np.quantile(values[finite], np.linspace(0, 1, count + 1)[1:-1], method="lower")
    of = np.searchsorted(np.unique(inner), np.where(finite, values, np.inf), side="left")
    member = np.array([(of == i) & finite for i in np.unique(of[finite])])
    low = np.array([values[rows].min() for rows in member])
    high = np.array([values[rows].max() for rows in member])
    labels = [f"{a:.3g}–{b:.3g}" if b > a else f"{a:.3g}" for a, b in zip(low, high, strict=True)]
    return Bins(name, low, high, labels, member)


def value_bins(name: str, values: Floats) -> Bins:
    """A bin for every value, where there are few; else quantiles."""
    distinct = np.unique(values[np.isfinite(values)])
    if len(distinct) > _DISTINCT:
        return quantile_bins(name, values, _DISTINCT)
    member = values[None] == distinct[:, None]
    return Bins(name, distinct, distinct, [f"{value:g}" for value in distinct], member)


def attribute_bins(truths: TruthRows) -> list[Bins]:
    """Visibility, tilt and the distance to the nearest neighbour."""
    of = truths.attributes
    return [
        fixed_bins("visibility", of.visibility, np.linspace(0, 1, 11).round(1)),
        fixed_bins("tilt, °", np.degrees(of.tilt), np.arange(0.0, 91, 10)),
        quantile_bins("distance to the nearest body, mm", 1000 * of.neighbour, 8),
    ]


def size_bins(truths: TruthRows, part: ParametricPart) -> list[Bins]:
    """One for each parameter."""
    columns = (1000 * truths.attributes.parameters).round(6).T
    named = zip(part.parameter_names, columns, strict=True)
    return [value_bins(f"{name}, mm", column) for name, column in named]


def outcome_shares(bins: Bins, truths: TruthRows) -> dict[Outcome, Floats]:
    """(b,) share of each outcome in every bin."""
    return {o: (bins.member & (truths.fate.outcome == o)).sum(1) / np.maximum(bins.count, 1) for o in Outcome}
