"""Names, units and the table of metrics."""

import math
from io import StringIO

import pytest
import torch
from rich.console import Console

from pnet.metrics.matching import ScoredPoses, TruePoses
from pnet.metrics.pose_metric import PoseMetrics
from pnet.reporting.tables import HEADLINE, METRICS, headline_rows, metric_row, metrics_table


def cells(table):
    return list(zip(*(list(column.cells) for column in table.columns), strict=True))


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("AP", 0.81249, "0.812"),
        ("position_error_mm", 1.236, "1.24 mm"),
        ("axis_error_deg", 2.0, "2.00°"),
        ("network_seconds", 0.0524, "52 ms"),
        ("results", 12345, "12,345"),
        ("AP", None, "–"),
        ("parameter_error_mm", math.nan, "–"),
        ("true_positives", None, "–"),
    ],
)
def test_values_have_their_unit_and_missing_ones_are_a_dash(key, value, text):
    assert metric_row(key, value)[1] == text


def test_every_metric_is_named_and_explained():
    assert all(metric.label and metric.explanation.endswith(".") for metric in METRICS.values())
    assert len({metric.label for metric in METRICS.values()}) == len(METRICS)
    assert set(HEADLINE) <= set(METRICS)


def test_all_that_scoring_gives_is_known(flange):
    none = torch.zeros(0, 3, 3), torch.zeros(0, 3), torch.zeros(0)
    metrics = PoseMetrics()
    metrics.update(flange.pose_space(flange.part_object("L", 0)), TruePoses(*none), ScoredPoses(*none))
    given = metrics.compute()
    assert set(given) <= set(METRICS)
    rows = cells(metrics_table(given))
    assert [row[1] for row in rows if row[0].endswith("error")] == ["–", "–", "–"]


def test_the_table_is_in_a_fixed_order_with_unknown_metrics_last():
    rows = cells(metrics_table({"own": 0.5, "scenes": 3, "AP": math.nan}))
    assert [row[:2] for row in rows] == [("AP", "–"), ("Scenes", "3"), ("own", "0.500")]


def test_each_parameter_stands_after_the_error_of_all():
    given = {
        "scenes": 3,
        "parameter_error_mm/l": 0.434,
        "parameter_error_mm/a": None,
        "parameter_error_mm": 0.3,
    }
    assert [row[:2] for row in cells(metrics_table(given))] == [
        ("Parameter error", "0.30 mm"),
        ("Parameter error, l", "0.43 mm"),
        ("Parameter error, a", "–"),
        ("Scenes", "3"),
    ]
    rows = headline_rows({**given, "AP": 0.5})
    assert [row[0] for row in rows[6:]] == [
        *("Parameter error", "Parameter error, l", "Parameter error, a", "Time per scene")
    ]
    assert rows[7][2] == "Mean error of dimension l of found bodies."


def test_the_error_of_a_parameter_alone_is_shown_too():
    assert [row[:2] for row in cells(metrics_table({"AP": 0.5, "parameter_error_mm/r": 1.0}))] == [
        ("AP", "0.500"),
        ("Parameter error, r", "1.00 mm"),
    ]


def test_the_table_is_printed():
    console = Console(width=100, file=StringIO())
    console.print(metrics_table({"AP": 0.5}))
    assert "0.500" in console.file.getvalue()


def test_the_headline_adds_up_the_time_of_a_scene():
    rows = headline_rows({"AP": 0.5, "network_seconds": 0.05, "postprocess_seconds": 0.1})
    values = {name: value for name, value, _ in rows}
    assert len(rows) == 8
    assert values["Time per scene"] == "150 ms"
    assert values["AP"] == "0.500"
    assert values["Position error"] == "–"


@pytest.mark.parametrize("metrics", [{}, {"network_seconds": 0.05}, {"postprocess_seconds": None}])
def test_half_a_time_is_no_time(metrics):
    assert headline_rows(metrics)[-1][:2] == ("Time per scene", "–")
