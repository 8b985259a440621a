"""Detections as rows, as a file and as a table."""

import csv
import math
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation

from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.base import ParametricPart
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import cylinder
from pnet.records import Detections
from pnet.reporting.prediction_tables import (
    MATRIX,
    POSITION,
    TURN,
    csv_columns,
    detection_rows,
    detection_sheet,
    detections_table,
    rotation_vectors,
    stage_text,
    time_text,
    write_detections_csv,
)


class Clash(ParametricPart):
    """Its parameter is called like a coordinate."""

    name = "clash"
    parameter_names = ("x",)
    symmetry = RevolutionSymmetry(rotoreflection=True)
    keypoints = (Keypoint("face", "centroid", Plane("z"), "x", factor=0.5),)

    def solid(self, parameters):
        (x,) = self.split(parameters)
        return cylinder(0.01 + 0 * x, -x / 2, x / 2)


@pytest.fixture
def many():
    """25 random detections of a flange, the worst first, each with as many points as its index."""
    rng = np.random.default_rng(0)
    return Detections(
        R=torch.from_numpy(Rotation.random(25, rng=rng).as_matrix()),
        t=torch.from_numpy(rng.normal(0, 0.3, (25, 3))),
        parameters=torch.from_numpy(rng.uniform(0.01, 0.02, (25, 2))),
        score=torch.linspace(0.04, 1, 25, dtype=torch.float64),
        keypoints=torch.zeros(25, 3, 3, dtype=torch.float64),
        instance=torch.from_numpy(np.r_[np.repeat(np.arange(25), np.arange(25)), [-1, -1]]),
    )


def printed(table, width=80):
    out = Console(width=width, file=StringIO())
    out.print(table)
    return out.file.getvalue()


def read(path):
    with open(path, newline="") as file:
        return [{name: float(text) for name, text in row.items()} for row in csv.DictReader(file)]


def test_rows_begin_with_the_best_score(many, flange):
    rows = detection_rows(many, flange)
    assert [row["rank"] for row in rows] == list(range(1, 26))
    assert [row["points"] for row in rows] == list(range(24, -1, -1))
    np.testing.assert_allclose([row["score"] for row in rows], np.linspace(1, 0.04, 25))
    assert rows[0]["x_mm"] == pytest.approx(1000 * float(many.t[24, 0]), abs=1e-12)
    assert rows[0]["h_mm"] == pytest.approx(1000 * float(many.parameters[24, 1]), abs=1e-12)
    assert type(rows[0]["rank"]) is int and type(rows[0]["points"]) is int


def test_the_file_keeps_every_digit(many, flange, tmp_path):
    write_detections_csv(tmp_path / "found.csv", many, flange)
    rows = read(tmp_path / "found.csv")
    assert list(rows[0]) == [
        *("rank", "score", "x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg", "r_mm", "h_mm", "points"),
        *("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"),
    ]
    order = np.arange(24, -1, -1)
    R = np.array([[row[name] for name in MATRIX] for row in rows]).reshape(-1, 3, 3)
    np.testing.assert_array_equal(R, many.R.numpy()[order])
    t = np.array([[row[name] for name in POSITION] for row in rows]) / 1000
    np.testing.assert_allclose(t, many.t.numpy()[order], rtol=0, atol=1e-12)
    turn = np.radians([[row[name] for name in TURN] for row in rows])
    np.testing.assert_allclose(Rotation.from_rotvec(turn).as_matrix(), R, atol=1e-12)
    assert [path.name for path in tmp_path.iterdir()] == ["found.csv"]


def test_nothing_found_gives_a_file_with_a_header_only(detect, flange, tmp_path):
    write_detections_csv(tmp_path / "found.csv", detect([]), flange)
    assert (tmp_path / "found.csv").read_text() == ",".join(csv_columns(flange)) + "\n"
    assert detection_rows(detect([]), flange) == []


def test_what_is_not_known_is_nan_in_the_file_and_a_dash_for_people(detect, sizeless, flange, tmp_path):
    found = sizeless(detect([0, 1]))
    write_detections_csv(tmp_path / "found.csv", found, flange)
    row = read(tmp_path / "found.csv")[0]
    assert math.isnan(row["r_mm"]) and math.isnan(row["h_mm"]) and not math.isnan(row["x_mm"])
    sheet = detection_sheet(found, flange)
    assert sheet.rows[0][list(sheet.columns).index("h")] == "–"


def test_a_parameter_called_like_another_column_has_a_column_of_its_own(detect):
    part = Clash({"x": [12]})
    found = detect([0])
    found = replace(found, parameters=found.parameters[:, :1])
    (row,) = detection_rows(found, part)
    assert row["x_mm"] == pytest.approx(-60) and row["parameter_x_mm"] == pytest.approx(18)
    assert detection_sheet(found, part).rows[0][2] == "-60.00"
    assert detection_sheet(found, part).rows[0][8] == "18.00"


def test_rotation_vectors_are_axis_times_degrees_and_nan_of_no_rotation():
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    facing = np.diag([1.0, -1.0, -1.0])
    broken = [np.full((3, 3), np.nan), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3))]
    vectors = rotation_vectors(np.stack([quarter, facing, np.eye(3), *broken]))
    expected = [[0, 0, 90], [180, 0, 0], [0, 0, 0], *[[np.nan] * 3] * 3]
    np.testing.assert_allclose(vectors, expected, atol=1e-9)
    assert rotation_vectors(np.zeros((0, 3, 3))).shape == (0, 3)


def test_single_precision_and_a_pose_that_is_nan_are_told(detect, flange):
    found = detect([0, 1])
    found = replace(found, R=found.R.float(), t=torch.full((2, 3), torch.nan), score=found.score.float())
    rows = detection_rows(found, flange)
    assert rows[0]["rx_deg"] == pytest.approx(180) and math.isnan(rows[0]["z_mm"])


def test_the_table_shows_the_best_and_counts_the_rest(many, flange):
    text = printed(detections_table(many, flange, 3))
    assert "TN34: 25 found" in text and "and 22 more with lower scores" in text
    lines = [line.split() for line in text.splitlines()]
    body = [words for words in lines if len(words) == 11 and words[0] in {"1", "2", "3", "4"}]
    assert [words[:2] for words in body] == [["1", "1.000"], ["2", "0.960"], ["3", "0.920"]]
    assert [words[-1] for words in body] == ["24", "23", "22"]
    x = 1000 * many.t[24].numpy()
    np.testing.assert_allclose([float(word) for word in body[0][2:5]], x, atol=0.005)
    assert "more" not in printed(detections_table(many, flange, 25))


def test_the_table_fits_a_terminal_of_80_characters(tn06, many):
    far = replace(many, t=many.t - 1.1, parameters=torch.full((25, 3), 0.012345, dtype=torch.float64))
    text = printed(detections_table(far, tn06, 30))
    assert "…" not in text and max(map(len, text.splitlines())) <= 80
    assert "12.35" in text or "12.34" in text


def test_an_empty_table_says_so(detect, flange):
    assert "TN34: nothing was found" in printed(detections_table(detect([]), flange))


def test_times_of_stages_and_together_stand_in_one_line():
    seconds = {"reading": 0.0123, "sampling": 0.0042, "network": 1.234, "poses": 12.34}
    assert (
        stage_text(seconds) == "reading 12 ms, sampling 4.2 ms, network 1.23 s, poses 12.3 s, together 13.6 s"
    )
    assert stage_text({"network": 0.5}) == "network 500 ms"
    assert stage_text({}) == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((0.0, "0.0 ms"), (0.0042, "4.2 ms"), (0.00999, "10 ms"), (0.9994, "999 ms"), (0.9999, "1.00 s")),
        *((9.996, "10.0 s"), (75.0, "75.0 s"), (math.nan, "–")),
    ],
)
def test_a_time_has_about_three_digits(seconds, text):
    assert time_text(seconds) == text
