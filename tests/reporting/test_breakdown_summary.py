"""Numbers and rows of an evaluation's errors."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console

from pnet.metrics.breakdown import break_down
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.reporting.breakdown_rows import csv_text, result_table, truth_table
from pnet.reporting.breakdown_summary import error_table, outcome_table, summary, wrong_pose_line

CHOICE = KeypointChoice(KeypointRule.POINT)


@pytest.fixture
def rows(scene, detect, flange):
    """Of three bodies one is found, one upside down, one missed."""
    found = detect([0, 1])
    turned = found.R.clone()
    turned[1] = turned[1] @ torch.diag(torch.tensor([1.0, -1, -1])).double()
    sizes = found.parameters + torch.tensor([0.001, -0.002])
    return break_down(flange, CHOICE, [scene], [replace(found, R=turned, parameters=sizes)])


def test_the_summary_counts_outcomes_blame_and_losses(rows, flange):
    told = summary(rows, flange, ["test_l/a/003"])
    counts = {name: numbers["count"] for name, numbers in told["outcomes"].items()}
    assert counts == {"found": 1, "missed": 1, "merged": 0, "split": 0, "wrong pose": 1}
    assert told["wrong_poses"]["blame"]["rotation"] == 1 and told["wrong_poses"]["flips"] == 1
    assert told["wrong_poses"]["turned_about"] == {}  # a revolution
    assert told["score"]["ap"] == pytest.approx(1 / 3)
    assert told["score"]["if_mended"]["wrong rotation"] == pytest.approx(2 / 3)
    assert told["kinds"] == {"right": 1, "duplicate": 0, "hidden": 0, "false": 1}
    assert told["reasons"]["wrong pose"] == 1 and told["sure_and_false"]["count"] == 0
    h = told["errors"]["all"]["parameters_mm"]["h"]
    assert (h["mean"], h["bias"], h["count"]) == (pytest.approx(2), pytest.approx(-2), 2)
    assert told["errors"]["found"]["rotation_deg"]["count"] == 1
    assert [row["count"] for row in told["by"]["r, mm"]] == [3]
    assert sum(row["wrong pose"] * row["count"] for row in told["by"]["visibility"]) == pytest.approx(1)


def test_a_finite_parts_wrong_rotations_are_told_by_axis(scene, detect, bar):
    found, size = detect([0, 1, 2]), torch.from_numpy(bar.part_object("L", 0)).expand(3, -1)
    parts = replace(scene, parameters=size.numpy().copy())
    turned = found.R @ torch.diag(torch.tensor([-1.0, 1, -1])).double()
    found = replace(found, R=turned, parameters=size, keypoints=torch.zeros(3, 4, 3))
    told = summary(break_down(bar, CHOICE, [parts], [found]), bar, ["a/1"])
    assert told["wrong_poses"]["turned_about"] == {"x": 0, "y": 3, "z": 0}
    assert "wrong rotations by the part's axis: y 3" in wrong_pose_line(told)


def test_tables_show_the_numbers(rows, flange):
    told = summary(rows, flange, ["a/1"])
    console = Console(file=io.StringIO(), width=100)
    console.print(outcome_table(told))
    console.print(error_table(told))
    text = console.file.getvalue()
    assert "wrong pose" in text and "33.3 %" in text and "0.333" in text
    assert "parameter h" in text and "-2.00" in text and "keypoint rim" in text
    assert wrong_pose_line(told).startswith("wrong poses by what is wrong: rotation 1 (AP 0.667 if mended)")


def test_rows_have_everything_of_a_true_pose(rows, flange):
    table = list(csv.DictReader(io.StringIO(csv_text(truth_table(rows, flange, ["test_l/a/003"])))))
    assert [row["outcome"] for row in table] == ["found", "wrong pose", "missed"]
    assert [row["blame"] for row in table] == ["", "rotation", ""]
    assert [row["result"] for row in table] == ["0", "1", "-1"] and table[2]["score"] == ""
    assert table[0]["scene"] == "test_l/a/003" and table[1]["flip"] == "1"
    assert float(table[1]["error_h_mm"]) == pytest.approx(-2) and float(table[0]["true_r_mm"]) == 18
    assert table[0]["margin_base_mm"] == "inf" and float(table[0]["neighbour_mm"]) == pytest.approx(60)
    results = list(csv.DictReader(io.StringIO(csv_text(result_table(rows, ["test_l/a/003"])))))
    assert [row["kind"] for row in results] == ["right", "false"]
    assert [row["reason"] for row in results] == ["", "wrong pose"]


def test_an_empty_evaluation_has_a_summary_and_files(empty_scene, nothing, flange):
    rows = break_down(flange, CHOICE, [empty_scene], [nothing])
    told = summary(rows, flange, ["a/1"])
    assert told["score"]["ap"] == 1 and told["truths_to_find"] == 0 and told["calibration"] == []
    assert np.isnan(told["outcomes"]["found"]["share"])
    assert csv_text(truth_table(rows, flange, ["a/1"]), ["scene"]) == "scene\n"
    assert wrong_pose_line(told) == "no wrong pose"


def test_the_summary_is_plain(rows, flange):
    assert json.loads(json.dumps(summary(rows, flange, ["a/1"])))["scenes"] == 1
