"""Still pictures of parts: the solid with its keypoints, what they measure and their equivalents."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from numpy.typing import NDArray

from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry
from pnet.parts.base import ParametricPart
from pnet.parts.selection import CENTROID, Keypoint
from pnet.reporting.part_labels import DOT, HALO, write_labels
from pnet.reporting.part_view import (
    PANEL,
    VIEWS,
    View,
    equivalents,
    keypoint_places,
    look_from,
    part_views,
)
from pnet.reporting.picture import BACKGROUND, draw_image, pixel_axes, render_bodies, write_png
from pnet.reporting.scene_view import instance_colours

Points = NDArray[np.float64]

SIZE = (1600, 660)  # pixels
TILE = (390, 360)  # pixels, of the gallery
_COLUMNS = 4
_SHARP = np.radians(20)
_BODY = np.array([0.44, 0.48, 0.54])  # nearly grey, so that every keypoint's hue stands out
_TEXT, _QUIET = "#e8ecf1", "#8e98a4"


def part_picture(part: ParametricPart, parameters: Points, path: Path) -> None:
    """Write a PNG of one part object from three sides; the file appears when it is whole.

    Args:
        part: the template. parameters: (k,) metres. path: where to write; the folder must exist.
    """
    write_png(part_figure(part, parameters), path)


def gallery(parts: Sequence[ParametricPart], path: Path) -> None:
    """Write a PNG with one typical part object of each template; the file appears when it is whole.

    Args:
        parts: at least one. path: where to write; the folder must exist.
    """
    write_png(gallery_figure(parts), path)


def part_figure(part: ParametricPart, parameters: Points) -> Figure:
    """The figure that `part_picture` writes."""
    figure = _figure(*SIZE)
    for i, (caption, view) in enumerate(zip(VIEWS, part_views(part, parameters), strict=True)):
        left = 10 + i * (PANEL[0] + 10)
        _draw_part(pixel_axes(figure, (left, 104), PANEL), view, part, parameters, measures=True)
        _write(figure, left + PANEL[0] / 2, 602, caption, 13, _QUIET, ha="center")
    _write(figure, 28, 36, f"{part.name.upper()}   {part.text(parameters)}", 19, _TEXT)
    _write(figure, 28, 76, description(part, parameters), 13, _QUIET)
    foot = (
        "dots: keypoints, dimmed where the body hides them   ·   lines: to their references   ·   "
        "hollow dots and circles: equivalent keypoints   ·   +: centroid"
    )
    _write(figure, SIZE[0] / 2, 640, foot, 11.5, _QUIET, ha="center")
    return figure


def gallery_figure(parts: Sequence[ParametricPart]) -> Figure:
    """The figure that `gallery` writes."""
    if not parts:
        raise ValueError("a gallery of no parts: give at least one")
    width, height = TILE[0] + 8, TILE[1] + 64
    cells = _cells(len(parts))
    columns, rows = (round(count) for count in cells.max(0) + 1)
    figure = _figure(columns * width + 8, rows * height + 8)
    for part, (column, row) in zip(parts, cells, strict=True):
        left, top = round(8 + column * width), round(8 + row * height)
        parameters = part.part_object("L", len(part.grids["L"]) // 2)
        view = look_from(part, parameters, VIEWS["obliquely from above"], TILE, margin=(56, 44))
        _draw_part(pixel_axes(figure, (left, top), TILE), view, part, parameters, measures=False)
        middle = left + TILE[0] / 2
        _write(figure, middle, top + TILE[1] + 14, part.name.upper(), 15, _TEXT, ha="center")
        _write(figure, middle, top + TILE[1] + 40, symmetry_words(part), 11.5, _QUIET, ha="center")
    return figure


def _cells(count: int) -> Points:
    """(n, 2) column and row of every tile: rows as equal as can be, the last one in the middle."""
    rows = -(-count // _COLUMNS)
    columns = -(-count // rows)
    row, column = np.divmod(np.arange(count), columns)
    missing = np.where(row == rows - 1, rows * columns - count, 0)
    return np.stack([column + missing / 2, row], -1)


def symmetry_words(part: ParametricPart) -> str:
    """The symmetry as one would say it."""
    match part.symmetry:
        case RevolutionSymmetry(rotoreflection=True):
            return "revolution, ends equal"
        case RevolutionSymmetry():
            return "revolution"
        case FiniteSymmetry(rotations=rotations):
            return _finite_words(rotations.numpy(), None if part.mirror is None else part.mirror.numpy())
    return "spherical"


def description(part: ParametricPart, parameters: Points) -> str:
    """Symmetry and overall size."""
    size = " × ".join(f"{round(1000 * length, 1):g}" for length in part.mesh(parameters).extents)
    return f"symmetry: {symmetry_words(part)}   ·   overall size {size} mm"


def _finite_words(rotations: Points, mirror: Points | None) -> str:
    """A finite group by its kind and number; rotations: (g, 3, 3)."""
    count = len(rotations)
    if count == 1 and mirror is not None:
        return "one mirror plane" if np.trace(mirror) > 0 else "one improper rotation"
    if count == 1:
        return "none"
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1) / 2
    smallest = np.arccos(np.clip(cosine[cosine < 1 - 1e-9], -1, 1)).min()
    turns = round(2 * np.pi / smallest)  # about the axis of most turns
    kind = {count: "cyclic, ", count // 2: "dihedral, "}.get(turns, "")  # others are a cube's and the like
    return f"{kind}{count} rotations" + (", mirrored" if mirror is not None else "")


def _draw_part(axes: Axes, view: View, part: ParametricPart, parameters: Points, measures: bool) -> None:
    """The body, its keypoints and their names in one panel; measures: also the parameters."""
    image, _ = render_bodies(view.camera, view.body, _BODY[None])
    draw_image(axes, image)
    mesh = view.body.mesh
    edges = mesh.vertices[mesh.face_adjacency_edges[mesh.face_adjacency_angles > _SHARP]]
    _draw_lines(axes, view, (edges - view.t) @ view.R, np.array(BACKGROUND), 1.4, 0.1)
    places, colours = keypoint_places(part, parameters), instance_colours(len(part.chain))
    for curves, colour in zip(equivalents(part, parameters, view.R[2]), colours, strict=True):
        _draw_equivalents(axes, [view.pixels(curve) for curve in curves], colour)
    for ends, colour in zip(_lines(part, places), colours, strict=True):
        _draw_lines(axes, view, ends[None], colour, 2.2, 0.5)
    _draw_dots(axes, view, places, colours)
    _draw_labels(axes, view, part, parameters, measures)


def _lines(part: ParametricPart, places: Points) -> Points:
    """(m, 2, ...) from each keypoint's reference to it; places: (1 + m, ...) the centroid's and theirs."""
    return np.stack([places[part.chain.reference], places[1:]], 1)


def _draw_lines(axes: Axes, view: View, lines: Points, colour: Points, width: float, dimmed: float) -> None:
    """Straight lines (l, 2, 3), part frame, metres; dimmed: opacity where the body hides them."""
    pieces = [np.zeros((0, 2, 3))]
    for start, end in lines:
        count = max(1, round(60 * float(np.linalg.norm(end - start)) / view.body.mesh.scale))
        joints = start + np.linspace(0, 1, count + 1)[:, None] * (end - start)
        pieces.append(np.stack([joints[:-1], joints[1:]], 1))
    every = np.concatenate(pieces)
    seen = every[~view.hidden(every.mean(1))]
    # whole lines below the pieces that are seen: pale pieces side by side would show their joints
    pale = LineCollection(list(view.pixels(lines)), colors=[(*colour, dimmed)], linewidths=width)
    full = LineCollection(list(view.pixels(seen)), colors=[(*colour, 1.0)], linewidths=width)
    pale.set_capstyle("butt")
    full.set_capstyle("round")
    axes.add_collection(pale)
    axes.add_collection(full)


def _draw_equivalents(axes: Axes, curves: list[Points], colour: Points) -> None:
    """Circles as faint lines, single places as small hollow dots; curves: (n, 2) pixels."""
    for curve in curves:
        if len(curve) > 1:
            axes.plot(*curve.T, color=colour, alpha=0.65, linewidth=1.3)
        else:
            ring = Disc(curve[0], 0.6 * DOT, fill=False, edgecolor=colour, alpha=0.85, linewidth=1.3)
            axes.add_patch(ring)


def _draw_dots(axes: Axes, view: View, places: Points, colours: Points) -> None:
    """Keypoints over everything, hidden ones dimmed; the farther of two in one place as a wider ring."""
    pixels, hidden = view.pixels(places), view.hidden(places)
    reach = 16 + 6 * int((np.linalg.norm(pixels[1:] - pixels[0], axis=-1) < DOT).sum())
    axes.plot(*pixels[0], "+", color=_TEXT, markersize=reach, markeredgewidth=2, path_effects=HALO)
    far_to_near = 1 + np.argsort(-(places[1:] @ view.R[2]), kind="stable")
    for rank, i in enumerate(far_to_near):
        distance = np.linalg.norm(pixels[far_to_near[rank + 1 :]] - pixels[i], axis=-1)
        radius = DOT + 4 * int((distance < DOT).sum())
        share = 0.7 if hidden[i] else 1.0
        colour = share * colours[i - 1] + (1 - share) * np.array(BACKGROUND)
        axes.add_patch(
            Disc(pixels[i], radius, facecolor=colour, edgecolor=BACKGROUND, linewidth=1.2, zorder=3)
        )


def _draw_labels(axes: Axes, view: View, part: ParametricPart, parameters: Points, measures: bool) -> None:
    """Names of the centroid and the keypoints, and what each line measures."""
    pixels = view.pixels(keypoint_places(part, parameters))
    words, anchors, colours = [CENTROID, *part.chain.names], list(pixels), list(_text_colours(part))
    lines = _lines(part, pixels)
    for i, keypoint in enumerate(part.chain.keypoints):
        seen = np.linalg.norm(lines[i, 1] - lines[i, 0]) > 3 * DOT  # not where it points at the camera
        if measures and seen and keypoint.parameter is not None:
            words.append(measure(part, keypoint, parameters))
            anchors.append(lines[i].mean(0))
            colours.append(colours[i + 1])
    clear = [
        *_along(lines),
        *(view.pixels(c) for own in equivalents(part, parameters, view.R[2]) for c in own),
    ]
    write_labels(axes, words, np.stack(colours), np.stack(anchors), pixels, np.concatenate(clear))


def _text_colours(part: ParametricPart) -> Points:
    """(1 + m, 3) for the centroid and the keypoints: their dots' colours, paler, to be read on the body."""
    pale = 0.5 * instance_colours(len(part.chain)) + 0.5
    return np.concatenate([[to_rgb(_TEXT)], pale])


def _along(lines: Points) -> Points:
    """(l, 2, 2) → (l, 25, 2) places along straight lines."""
    share = np.linspace(0, 1, 25)[:, None]
    return lines[:, None, 0] * (1 - share) + lines[:, None, 1] * share


def measure(part: ParametricPart, keypoint: Keypoint, parameters: Points) -> str:
    """The distance from a keypoint's reference to it, in terms of its parameter; parameters: (k,) metres."""
    if keypoint.parameter is None:
        return ""
    length = 1000 * keypoint.factor * parameters[part.parameter_names.index(keypoint.parameter)]
    shares = {1.0: keypoint.parameter, 0.5: f"{keypoint.parameter}/2"}
    share = shares.get(keypoint.factor, f"{keypoint.factor:g} {keypoint.parameter}")
    return f"{share} = {length:g} mm"


def _figure(width: int, height: int) -> Figure:
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)  # texts are measured before the figure is saved
    return figure


def _write(
    figure: Figure, x: float, y: float, words: str, size: float, colour: str, ha: str = "left"
) -> None:
    """A line of text; x, y: pixels from the figure's left and upper border."""
    width, height = 100 * figure.get_size_inches()
    figure.text(x / width, 1 - y / height, words, size=size, color=colour, ha=ha, va="center")
