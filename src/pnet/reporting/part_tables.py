"""What `pnet-part` prints: a part's parameters, keypoints, constants and checks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry, Symmetry
from pnet.parts.base import ParametricPart
from pnet.parts.checks import Check
from pnet.parts.primitives import Freedom
from pnet.parts.selection import Keypoint

Points = NDArray[np.float64]


def parameter_table(part: ParametricPart, parameters: Points) -> Table:
    """The chosen values and the grids, mm."""
    grids = {name: {"L": "learning grid (L)", "G": "generalization grid (G)"}[name] for name in part.grids}
    table = _table(f"{part.name}: parameters, mm", "name", "this part", *grids.values())
    for i, name in enumerate(part.parameter_names):
        values = [", ".join(f"{1000 * x:g}" for x in np.unique(part.grids[grid][:, i])) for grid in grids]
        table.add_row(name, f"{1000 * parameters[i]:g}", *values)
    counts = [f"{len(part.grids[grid])} part objects" for grid in grids]
    table.add_row("", "", *counts, style="dim")
    return table


def keypoint_table(part: ParametricPart) -> Table:
    """Every keypoint with its rule and equivalents."""
    title = f"{part.name}: keypoints; symmetry: {symmetry_text(part.symmetry, part.mirror is not None)}"
    table = _table(title, "keypoint", "from", "primitive", "measures", "equivalents", "chiralities")
    for i, keypoint in enumerate(part.chain.keypoints):
        chiralities = str(len(part.chain.chiralities)) if i == 0 else ""
        row = (keypoint.name, keypoint.reference, type(keypoint.primitive).__name__.lower())
        table.add_row(*row, _measure_text(keypoint), equivalents_text(part, i), chiralities)
    return table


def constants_table(part: ParametricPart, parameters: Points) -> Table:
    """Volume, size and the benchmark's constants of one part object."""
    mesh, space = part.mesh(parameters), part.pose_space(parameters)
    table = _table(f"{part.name}: constants of this part object", "constant", "value")
    extent = " × ".join(f"{1000 * x:.4g}" for x in mesh.extents)
    table.add_row("size", f"{extent} mm")
    table.add_row("volume", f"{1e9 * mesh.volume:.6g} mm³")
    table.add_row("surface", f"{1e6 * mesh.area:.6g} mm²")
    centre = ", ".join(f"{round(1000 * x, 4) + 0.0:g}" for x in space.centre.tolist())
    table.add_row("surface centroid from the volume's", f"{centre} mm")
    if isinstance(space.symmetry, FiniteSymmetry):
        scale = ", ".join(f"{1000 * x:.4f}" for x in space.scale.diagonal().tolist())
        table.add_row("Λ, in its eigenframe", f"diag({scale}) mm")
    elif isinstance(space.symmetry, RevolutionSymmetry):
        table.add_row("λ", f"{1000 * float(space.scale):.4f} mm")
    table.add_row("distance threshold of a match", f"{1000 * space.distance_threshold:.4f} mm")
    return table


def check_table(checks: Sequence[Check]) -> Table:
    """What was checked, and what came out."""
    table = _table("checks", "", "statement", "figure")
    for check in checks:
        failed = "[yellow]note[/]" if check.is_advice else "[bold red]FAILED[/]"
        table.add_row("[green]ok[/]" if check.passed else failed, check.name, check.detail)
    return table


def symmetry_text(symmetry: Symmetry, mirrored: bool) -> str:
    """A symmetry in words."""
    match symmetry:
        case FiniteSymmetry(rotations=G):
            count = len(G)
            text = "none" if count == 1 else f"{count} rotations"
        case RevolutionSymmetry(rotoreflection=equal_ends):
            text = "revolution, equal ends" if equal_ends else "revolution, ends differ"
        case _:
            text = "sphere"
    if not mirrored:
        return text
    return "one mirror plane, no rotation" if text == "none" else f"{text}, and a mirror plane"


def equivalents_text(part: ParametricPart, keypoint: int) -> str:
    """How many equivalents a keypoint has once its reference is chosen: the cases of Fig. 4."""
    match part.chain.keypoints[keypoint].primitive.freedom:
        case Freedom.TURN:
            return "a circle"
        case Freedom.SPHERE:
            return "a sphere"
    count = part.chain.equivalents(keypoint)
    return "only itself" if count == 1 else str(count)


def _measure_text(keypoint: Keypoint) -> str:
    if keypoint.parameter is None:
        return "nothing, a reference"
    return (
        keypoint.parameter
        if keypoint.factor == 1
        else f"{keypoint.parameter} (distance {keypoint.factor:g} of it)"
    )


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    for column in columns:
        table.add_column(column)
    return table
