"""What each metric is called, in which unit it is shown and what it means; and the table of a run."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rich.table import Table

MISSING = "–"


@dataclass(frozen=True)
class Metric:
    """How a number is shown.

    Attributes:
        label: its name for people. explanation: one plain sentence.
        unit: printed after the value, with its space. decimals: digits after the point.
        scale: the value is multiplied by it before printing.
    """

    label: str
    explanation: str
    unit: str = ""
    decimals: int = 3
    scale: float = 1.0

    def text(self, value: float | None) -> str:
        """The value with its unit; a dash where there is none."""
        if value is None or not math.isfinite(value):
            return MISSING
        return f"{self.scale * value:,.{self.decimals}f}{self.unit}"


METRICS = {
    "AP": Metric("AP", "Area under the precision-recall curve, averaged over scenes; 1 is perfect."),
    "MAP": Metric("MAP", "Mean of the AP that each scene has by itself; 1 is perfect."),
    "mAP": Metric("mAP", "Mean of the AP of each part object (the paper's number); 1 is perfect."),
    "F1": Metric("Best F1", "Balance of precision and recall at the best score threshold; 1 is perfect."),
    "recall_at_precision_99": Metric(
        "Recall at precision 0.99",
        "Share of the bodies to find that are found while 99 of 100 results are right.",
    ),
    "position_error_mm": Metric(
        "Position error", "Mean distance between true and estimated centre of found bodies.", " mm", 2
    ),
    "axis_error_deg": Metric(
        "Axis error", "Mean angle between true and estimated axis of found bodies.", "°", 2
    ),
    "parameter_error_mm": Metric(
        "Parameter error", "Mean error of the estimated dimensions of found bodies.", " mm", 2
    ),
    "seconds": Metric("Time per scene", "Network and post-processing together.", " ms", 0, 1000),
    "network_seconds": Metric(
        "Network time per scene", "From the points to the point-wise predictions.", " ms", 0, 1000
    ),
    "postprocess_seconds": Metric(
        "Post-processing time per scene", "From the predictions to the poses.", " ms", 0, 1000
    ),
    "true_positives": Metric(
        "Right results", "Results that match a body to find, whatever their score.", decimals=0
    ),
    "false_positives": Metric(
        "Wrong results", "Results that match no body, or one already found.", decimals=0
    ),
    "truths_to_find": Metric("Bodies to find", "Bodies of which at least half can be seen.", decimals=0),
    "results": Metric("Results", "Poses that were estimated.", decimals=0),
    "scenes": Metric("Scenes", "Views that were scored.", decimals=0),
}
HEADLINE = (
    "AP",
    "MAP",
    "F1",
    "recall_at_precision_99",
    "position_error_mm",
    "axis_error_deg",
    "parameter_error_mm",
    "seconds",
)
_ONE = "parameter_error_mm/"  # before the name of a parameter: the error of it alone


def metrics_table(metrics: Mapping[str, float | None]) -> Table:
    """The metrics that are given, in a fixed order; unknown ones last, under their own name.

    Args:
        metrics: values by key of `METRICS`; None or NaN is shown as a dash, what is no number is left out.
    """
    metrics = {key: value for key, value in metrics.items() if not isinstance(value, str)}
    table = Table()
    table.add_column("metric", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("meaning", style="dim")
    known = [key for key in _with_each(METRICS, metrics) if key in metrics]
    for key in dict.fromkeys([*known, *metrics]):
        label, value, explanation = metric_row(key, metrics[key])
        table.add_row(label, value, explanation)
    return table


def headline_rows(metrics: Mapping[str, float | None]) -> list[tuple[str, str, str]]:
    """The numbers that a report begins with: name, value text, explanation."""
    return [metric_row(key, value) for key, value in _headline(metrics).items()]


def metric_row(key: str, value: float | None) -> tuple[str, str, str]:
    """Name, value text and explanation of one metric."""
    metric = METRICS.get(key) or (_one_parameter(key) if key.startswith(_ONE) else Metric(key, ""))
    return metric.label, metric.text(value), metric.explanation


def _one_parameter(key: str) -> Metric:
    name = key.removeprefix(_ONE)
    return Metric(f"Parameter error, {name}", f"Mean error of dimension {name} of found bodies.", " mm", 2)


def _with_each(keys: Iterable[str], metrics: Iterable[str]) -> list[str]:
    """Keys, those of each parameter that are given after the one of all."""
    each = [key for key in metrics if key.startswith(_ONE)]
    return [k for key in keys for k in (key, *(each if key == "parameter_error_mm" else ()))]


def _headline(metrics: Mapping[str, float | None]) -> dict[str, float | None]:
    parts = [metrics.get("network_seconds"), metrics.get("postprocess_seconds")]
    given = [part for part in parts if part is not None]
    together = {"seconds": sum(given) if len(given) == len(parts) else None}
    return {key: {**metrics, **together}.get(key) for key in _with_each(HEADLINE, metrics)}
