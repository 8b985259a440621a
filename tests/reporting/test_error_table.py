"""Parameter errors beside a table of the paper."""

import csv
import io
import math

import pytest
from rich.console import Console

from pnet.reporting.error_table import cell_errors, errors_csv, errors_markdown, errors_rich
from pnet.reporting.paper_table import Cell, Column, PaperTable, Row, markdown

ROW, COLUMN = Row("TN42", ()), Column("Ours", "Learn all")
TABLE = PaperTable(
    "IV", "Generalization", "mAP on G", "small", "Object", (COLUMN,), (Row("TN42", (Cell((0.5,)),)),)
)
SCORES = {
    "mAP": 0.5,
    "parameter_error_mm": 0.38,
    "parameter_error_mm/a": 0.2,
    "parameter_error_mm/l": 0.434,
    "parameter_error_mm/w": 0.5,
    "position_error_mm": 0.61,
    "axis_error_deg": 2.5,
}
OLD = {key: value for key, value in SCORES.items() if "/" not in key}
ORDER = ("l", "a", "w")


def errors(*scores, row=ROW, column=COLUMN, order=ORDER):
    return cell_errors(row, column, "mAP", scores, order)


def lines(text):
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if "|" in line]


def records(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_a_cell_shows_each_parameter_in_the_parts_order():
    headings, _, row = lines(errors_markdown([errors(SCORES)]))
    assert headings == ["cell", "mAP", "mean", "each", "position, mm", "axis, °"]
    assert row == ["TN42 / Learn all: Ours", "0.500", "0.38", "l 0.43, a 0.20, w 0.50", "0.61", "2.50"]


def test_parameters_that_the_part_does_not_name_come_last():
    assert errors(SCORES, order=("w",)).parameters == ("w", "a", "l")


def test_errors_are_means_over_seeds():
    second = {**SCORES, "mAP": 0.7, "parameter_error_mm/l": 0.634, "axis_error_deg": 3.5}
    found = errors(SCORES, second)
    assert found.seeds == 2 and found.parameters == ORDER
    assert found.means["parameter_error_mm/l"] == pytest.approx(0.534)
    assert (found.means["mAP"], found.means["axis_error_deg"]) == pytest.approx((0.6, 3.0))
    assert found.means["parameter_error_mm/w"] == 0.5


@pytest.mark.parametrize("lost", [None, math.nan])
def test_what_one_seed_lacks_has_no_mean(lost):
    """A mean over the others would pass for one over all."""
    found = errors(SCORES, {**SCORES, "parameter_error_mm/l": lost})
    assert found.means["parameter_error_mm/l"] is None and found.means["parameter_error_mm/a"] == 0.2
    assert lines(errors_markdown([found]))[2][3] == "l –, a 0.20, w 0.50"


def test_an_evaluation_of_before_shows_what_it_has():
    assert lines(errors_markdown([errors(OLD)]))[2] == [
        *("TN42 / Learn all: Ours", "0.500", "0.38", "–", "0.61", "2.50")
    ]
    assert errors(OLD, SCORES).means["parameter_error_mm/a"] is None


@pytest.mark.parametrize("value", [None, math.nan])
def test_a_method_that_knows_no_sizes_has_no_row(value):
    assert errors({**OLD, "parameter_error_mm": value}) is None and errors() is None
    assert errors({"mAP": 0.5}) is None and errors_markdown([]) == ""


def test_the_csv_has_a_column_for_each_parameter_of_any_part():
    other = {key: value for key, value in SCORES.items() if "/" not in key}
    flange = errors({**other, "parameter_error_mm/r": 0.25}, row=Row("TN34", (), "ours"), column=Column("L"))
    first, second = records(errors_csv(TABLE, [errors(SCORES), flange]))
    assert list(first)[8:13] == ["parameter_error_mm", *(f"parameter_error_mm/{name}" for name in "lawr")]
    assert (first["parameter_error_mm/l"], first["parameter_error_mm/r"]) == ("0.434", "")
    assert (second["parameter_error_mm/l"], second["parameter_error_mm/r"]) == ("", "0.25")
    assert (first["row"], first["column_group"], first["column"]) == ("TN42", "Learn all", "Ours")
    assert (second["row"], second["column_group"]) == ("TN34 (ours, not in the paper)", "")
    assert (first["ours_mean"], first["seeds"], first["metric"]) == ("0.5", "1", "mAP on G")


def test_the_section_stands_between_the_caption_and_what_is_missing():
    whole = PaperTable(**{**vars(TABLE), "missing": ("TN06: no run",)})
    text = markdown(whole, errors_markdown([errors(SCORES)]))
    places = [text.index(word) for word in ("no brackets:", "### Parameter errors, mm", "### Missing")]
    assert places == sorted(places)
    assert "Parameter errors" not in markdown(whole)


def test_the_table_is_printed_without_breaking_words():
    console = Console(width=80, file=io.StringIO())
    console.print(errors_rich(TABLE, [errors(SCORES, row=Row("ParametricNet (w/o M_V)", ()))]))
    text = console.file.getvalue()
    assert "Table IV: Parameter errors, mm" in text
    assert all(word in text for word in ("ParametricNet", "Learn", "0.38", "0.43", "2.50"))
