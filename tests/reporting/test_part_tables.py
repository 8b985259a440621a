"""The tables of `pnet-part`."""

import numpy as np
import pytest
from rich.console import Console

from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, cyclic, dihedral
from pnet.parts.checks import Check
from pnet.parts.primitives import Corner
from pnet.reporting.part_tables import (
    check_table,
    constants_table,
    equivalents_text,
    keypoint_table,
    parameter_table,
    symmetry_text,
)


def rows(table) -> list[list[str]]:
    """The texts of a table's cells."""
    return [list(row) for row in zip(*(column.cells for column in table.columns), strict=True)]


def test_parameters_stand_beside_the_grids(tn06):
    table = parameter_table(tn06, np.array([0.004, 0.0115, 0.014]))
    assert [column.header for column in table.columns][2:] == ["learning grid (L)", "generalization grid (G)"]
    found = rows(table)
    assert [row[:2] for row in found] == [["r", "4"], ["h", "11.5"], ["d", "14"], ["", ""]]
    assert found[0][2] == ", ".join(f"{1000 * r:g}" for r in np.unique(tn06.grids["L"][:, 0]))
    assert found[3][2:] == ["64 part objects", "64 part objects"]


def test_a_part_without_a_second_grid_has_one_column_less(bar):
    assert len(parameter_table(bar, bar.part_object("L", 0)).columns) == 3


def test_every_keypoint_has_its_rule(bar):
    table = keypoint_table(bar)
    assert table.title == "tn42: keypoints; symmetry: one mirror plane, no rotation"
    assert rows(table) == [
        ["foot", "centroid", "corner", "nothing, a reference", "only itself", "2"],
        ["side", "centroid", "plane", "w (distance 0.5 of it)", "2", ""],
        ["toe", "foot", "plane", "l", "only itself", ""],
        ["head", "foot", "plane", "a", "only itself", ""],
        ["tip", "toe", "plane", "nothing, a reference", "only itself", ""],
    ]


def test_equivalents_in_words(tn06, marble, bar):
    assert [equivalents_text(tn06, i) for i in range(3)] == ["2", "a circle", "6"]
    assert equivalents_text(marble, 0) == "a sphere"
    assert isinstance(bar.keypoints[0].primitive, Corner) and equivalents_text(bar, 0) == "only itself"


@pytest.mark.parametrize(
    ("symmetry", "mirrored", "text"),
    [
        (cyclic(1), False, "none"),
        (cyclic(1), True, "one mirror plane, no rotation"),
        (cyclic(4), False, "4 rotations"),
        (cyclic(4), True, "4 rotations, and a mirror plane"),
        (dihedral(6), False, "12 rotations"),
        (RevolutionSymmetry(), False, "revolution, ends differ"),
        (RevolutionSymmetry(rotoreflection=True), False, "revolution, equal ends"),
        (SphericalSymmetry(), False, "sphere"),
    ],
)
def test_symmetries_in_words(symmetry, mirrored, text):
    assert symmetry_text(symmetry, mirrored) == text


def test_constants_of_a_ball_are_its_polyhedrons(marble):
    found = dict(rows(constants_table(marble, np.array([0.01]))))
    mesh = marble.mesh(np.array([0.01]))
    assert float(found["volume"].removesuffix(" mm³")) == pytest.approx(1e9 * mesh.volume, rel=1e-5)
    assert float(found["volume"].removesuffix(" mm³")) == pytest.approx(4 / 3 * np.pi * 1000, rel=0.02)
    assert found["surface centroid from the volume's"] == "0, 0, 0 mm"
    threshold = float(found["distance threshold of a match"].removesuffix(" mm"))
    assert threshold == pytest.approx(2, rel=0.01)  # a tenth of the diameter
    assert "λ" not in found and "Λ, in its eigenframe" not in found


def test_constants_of_a_disc_and_a_bar(disc, bar):
    found = dict(rows(constants_table(disc, np.array([0.012]))))
    assert found["size"] == "20 × 20 × 12 mm"
    assert float(found["λ"].removesuffix(" mm")) == pytest.approx(
        1000 * float(disc.pose_space(np.array([0.012])).scale), abs=1e-4
    )
    found = dict(rows(constants_table(bar, bar.part_object("L", 0))))
    assert found["Λ, in its eigenframe"].startswith("diag(")
    assert found["surface centroid from the volume's"].split(", ")[1] == "0"


def test_a_failed_check_is_marked():
    checks = [Check("one", True, "0 mm"), Check("other", False, "9 mm")]
    console = Console(width=60)
    with console.capture() as capture:
        console.print(check_table(checks))
    lines = capture.get().splitlines()
    assert [line.split() for line in lines if "one" in line or "other" in line] == [
        ["│", "ok", "│", "one", "│", "0", "mm", "│"],
        ["│", "FAILED", "│", "other", "│", "9", "mm", "│"],
    ]


def test_advice_is_no_failure():
    checks = [Check("a", True, "1"), Check("b", False, "2", is_advice=True), Check("c", False, "3")]
    column = list(check_table(checks).columns[0].cells)
    assert column == ["[green]ok[/]", "[yellow]note[/]", "[bold red]FAILED[/]"]
