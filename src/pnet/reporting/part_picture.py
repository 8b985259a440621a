"""Still pictures of parts: the solid with its keypoints, what they measure and their equivalents."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from numpy.typing import NDArray

from pnet.geometry.camera import Camera
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry
from pnet.parts.base import ParametricPart
from pnet.parts.keypoints import CENTROID, Keypoint
from pnet.parts.primitives import Freedom
from pnet.reporting.picture import BACKGROUND, draw_image, pixel_axes, render_bodies, write_png
from pnet.reporting.scene_view import Bodies, instance_colours, pose_bodies

Points = NDArray[np.float64]

SIZE = (1600, 660)  # pixels
PANEL = (520, 480)  # pixels
VIEWS = {  # caption → from where the camera looks, part frame
    "obliquely from above": (0.62, 0.70, 0.55),
    "from the side": (0.0, 1.0, 0.0),
    "from above, along z": (0.0, 0.0, 1.0),
}
TILE = (390, 360)  # pixels, of the gallery
_COLUMNS = 4
_DISTANCE = 40.0  # sizes of the part: so far away that the view is nearly orthographic
_SECTIONS = 240  # polygon sides of a circle: no facets are seen
_TURNS = 72  # places on a circle of equivalents
_SHARP = np.radians(20)
DOT = 7.0  # pixels, radius
_BODY = np.array([0.44, 0.48, 0.54])  # nearly grey, so that every keypoint's hue stands out
_TEXT, _QUIET = "#e8ecf1", "#8e98a4"
_GAPS = (6.0, 11.0, 18.0, 28.0, 40.0, 54.0, 70.0, 90.0)  # pixels between a label and what it names
_APART = np.array([9.0, 3.0])  # pixels between two labels, beside and above each other
_ROUNDS = 3
_FORBIDDEN = 1e4  # cost, in pixels of distance
_HALO = [withStroke(linewidth=3, foreground=(*BACKGROUND, 0.8))]


@dataclass(frozen=True, eq=False)
class View:
    """One part as the camera of one panel sees it.

    Attributes:
        camera: the panel's. R: (3, 3), t: (3,) part → camera, metres. body: the part alone, camera frame.
    """

    camera: Camera
    R: Points
    t: Points
    body: Bodies

    def pixels(self, places: Points) -> Points:
        """(..., 3) part frame, metres → (..., 2) pixels of the panel."""
        return self.camera.project(places @ self.R.T + self.t)

    def hidden(self, places: Points) -> NDArray[np.bool_]:
        """Whether the body lies before places (n, 3), part frame, metres: (n,)."""
        seen = places @ self.R.T + self.t
        towards = -seen / np.linalg.norm(seen, axis=-1, keepdims=True)
        # from a little off the surface, so that a place on it does not hide itself
        start = seen + 0.005 * self.body.mesh.scale * towards
        return np.asarray(self.body.mesh.ray.intersects_first(start, towards) >= 0)


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
    columns = min(_COLUMNS, len(parts))
    rows = -(-len(parts) // columns)
    width, height = TILE[0] + 8, TILE[1] + 64
    figure = _figure(columns * width + 8, rows * height + 8)
    for i, part in enumerate(parts):
        left, top = 8 + i % columns * width, 8 + i // columns * height
        parameters = part.part_object("L", len(part.grids["L"]) // 2)
        view = look_from(part, parameters, VIEWS["obliquely from above"], TILE, margin=(56, 44))
        _draw_part(pixel_axes(figure, (left, top), TILE), view, part, parameters, measures=False)
        middle = left + TILE[0] / 2
        _write(figure, middle, top + TILE[1] + 14, part.name.upper(), 15, _TEXT, ha="center")
        _write(figure, middle, top + TILE[1] + 40, symmetry_words(part), 11.5, _QUIET, ha="center")
    return figure


def part_views(part: ParametricPart, parameters: Points) -> list[View]:
    """The three views of `part_picture`, in the order of VIEWS; parameters: (k,) metres."""
    return [look_from(part, parameters, side, PANEL, margin=(80, 54)) for side in VIEWS.values()]


def look_from(
    part: ParametricPart,
    parameters: Points,
    side: tuple[float, float, float],
    size: tuple[int, int],
    margin: tuple[int, int],
) -> View:
    """A far camera that frames the part, its keypoints and their equivalents.

    Args:
        parameters: (k,) metres. side: from the part to the camera, part frame.
        size: width and height of the panel. margin: what is kept free for labels left and right, and above
            and below; pixels.
    """
    part.check_named(parameters)
    R = _facing(np.array(side))
    curves = [curve for curves in equivalents(part, parameters, R[2]) for curve in curves]
    content = (
        np.concatenate([part.mesh(parameters).vertices, keypoint_places(part, parameters), *curves]) @ R.T
    )
    low, high = content.min(0), content.max(0)
    distance = _DISTANCE * float(np.linalg.norm(high - low))
    width, height = size
    fill = np.array([width - 2 * margin[0], height - 2 * margin[1]]) / (high - low)[:2]
    focal = distance * float(fill.min())
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    t = np.array([0, 0, distance]) - (low + high) / 2
    return View(camera, R, t, pose_bodies(part, _SECTIONS, R[None], t[None], parameters[None]))


def keypoint_places(part: ParametricPart, parameters: Points) -> Points:
    """(1 + m, 3) the centroid and the template's keypoints, part frame, metres; parameters: (k,) metres."""
    keypoints = part.chain.canonical(torch.from_numpy(parameters)).numpy()
    return np.concatenate([np.zeros((1, 3)), keypoints])


def equivalents(part: ParametricPart, parameters: Points, forward: Points) -> list[list[Points]]:
    """Where else each keypoint could be: R(kp) of Fig. 4.

    Args:
        parameters: (k,) metres. forward: (3,) the view's direction, about which a sphere has its outline.
    Returns:
        For each keypoint its places: (1, 3) single ones, (73, 3) closed circles, part frame, metres.
    """
    group = part.chain.group.numpy()
    size = float(np.abs(keypoint_places(part, parameters)).max())
    owns = [_own_places(part, parameters, i, forward) for i in range(len(part.chain))]
    return [_distinct([own @ element.T for element in group], size) for own in owns]


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


def _own_places(part: ParametricPart, parameters: Points, i: int, forward: Points) -> Points:
    """The places that a keypoint has by its own freedom, or by that of a keypoint that it hangs on."""
    places, free = keypoint_places(part, parameters), i
    while part.chain.keypoints[free].primitive.freedom is Freedom.NONE:
        if part.chain.reference[free] == 0:
            return places[i + 1 : i + 2]
        free = part.chain.reference[free] - 1
    centre = places[part.chain.reference[free]]
    primitive, step = part.chain.keypoints[free].primitive, places[i + 1] - centre
    if primitive.freedom is Freedom.TURN:
        return centre + _turned(step, primitive.axis.numpy())
    across = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    return centre + _turned(np.linalg.norm(step) * across / np.linalg.norm(across), forward)


def _turned(step: Points, axis: Points) -> Points:
    """A vector (3,) turned about a unit axis (3,) all the way round: (73, 3), the last one the first."""
    angle = np.linspace(0, 2 * np.pi, _TURNS + 1)[:, None]
    along = (step @ axis) * axis
    return along + np.cos(angle) * (step - along) + np.sin(angle) * np.cross(axis, step)


def _distinct(curves: list[Points], size: float) -> list[Points]:
    """Those that lie elsewhere than all before; a circle that starts at another of its points is the same."""
    kept: dict[tuple[float, ...], Points] = {}
    for curve in curves:
        places = curve[:_TURNS] / size
        mark = np.r_[places.mean(0), (places.T @ places).ravel() / len(places)]
        kept.setdefault(tuple(np.round(mark + 1e-9, 5).tolist()), curve)
    return list(kept.values())


def _facing(side: Points) -> Points:
    """(3, 3) part → camera: looks against a direction, with z upwards, or y where it looks along z."""
    forward = -side / np.linalg.norm(side)
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 0.99 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


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
    axes.plot(*pixels[0], "+", color=_TEXT, markersize=reach, markeredgewidth=2, path_effects=_HALO)
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
    texts = [axes.text(0, 0, text, color=colour) for text, colour in zip(words, colours, strict=True)]
    for text in texts:
        text.set(size=12.5, ha="center", va="center", path_effects=_HALO, zorder=5)
    _place(axes, texts, np.stack(anchors), pixels, np.concatenate(clear))


def _text_colours(part: ParametricPart) -> Points:
    """(1 + m, 3) for the centroid and the keypoints: their dots' colours, paler, to be read on the body."""
    pale = 0.5 * instance_colours(len(part.chain)) + 0.5
    return np.concatenate([[to_rgb(_TEXT)], pale])


def _along(lines: Points) -> Points:
    """(l, 2, 2) → (l, 25, 2) places along straight lines."""
    share = np.linspace(0, 1, 25)[:, None]
    return lines[:, None, 0] * (1 - share) + lines[:, None, 1] * share


def _place(axes: Axes, texts: Sequence[Text], anchors: Points, dots: Points, clear: Points) -> None:
    """Move texts to free places, with leaders to what they name where that is not beside them."""
    sizes = np.array([text.get_window_extent().size for text in texts])
    panel = (round(np.ptp(axes.get_xlim())), round(np.ptp(axes.get_ylim())))
    centres = place_labels(anchors, sizes, dots, clear, panel)
    for text, anchor, size, centre in zip(texts, anchors, sizes, centres, strict=True):
        text.set_position((centre[0], centre[1]))
        leader = _leaders(anchor, centre[None], size)[0]
        if np.linalg.norm(leader[-1] - anchor) > 2.2 * DOT:
            axes.plot(*leader.T, color=text.get_color(), linewidth=0.9, alpha=0.8)


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


def place_labels(
    anchors: Points, sizes: Points, dots: Points, clear: Points, panel: tuple[int, int]
) -> Points:
    """Where texts go so that they cover neither each other nor a dot, and stay near what they name.

    Args:
        anchors: (n, 2) what each text names. sizes: (n, 2) width and height of the texts.
        dots: (d, 2) centres of dots. clear: (p, 2) what had better not be covered either.
        panel: width and height. All in pixels.
    Returns:
        (n, 2) the texts' centres.
    """
    centres = np.full_like(anchors, np.nan)  # NaN: not placed yet, in nobody's way
    # the first texts are placed without knowing of the last: more rounds move them out of their way
    for i in [*range(len(anchors))] * _ROUNDS:
        candidates = _candidates(anchors[i], sizes[i])
        cost = _own_cost(candidates, anchors[i], sizes[i], dots, panel)
        cost += 4 * _inside(clear, candidates, sizes[i] / 2 + 3).sum(0)
        for j in range(len(anchors)):
            if j != i:
                cost += _cost_beside(candidates, anchors[i], sizes[i], centres[j], anchors[j], sizes[j])
        centres[i] = candidates[cost.argmin()]
    return centres


def _candidates(anchor: Points, size: Points) -> Points:
    """(c, 2) centres of a text about its anchor, the nearest ones first."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([anchor + direction * (size / 2 + gap) for gap in _GAPS])


def _own_cost(
    candidates: Points, anchor: Points, size: Points, dots: Points, panel: tuple[int, int]
) -> Points:
    """(c,) what speaks against each place of a text by itself."""
    outside = (np.abs(candidates - np.array(panel) / 2) > np.array(panel) / 2 - size / 2 - 3).any(-1)
    away, outward = candidates - anchor, anchor - dots.mean(0)
    length = np.linalg.norm(away, axis=-1) * np.linalg.norm(outward)
    leaders = _leaders(anchor, candidates, size)
    elsewhere = dots[np.linalg.norm(dots - anchor, axis=-1) > DOT]
    return (
        _FORBIDDEN * outside
        + _FORBIDDEN * _inside(dots, candidates, size / 2 + DOT + 3).sum(0)
        + np.linalg.norm(leaders[:, -1] - anchor, axis=-1)
        - 8 * (away @ outward) / np.maximum(length, 1.0)
        + 15 * _inside(leaders, elsewhere, np.full(2, DOT)).sum((1, 2))
    )


def _cost_beside(
    candidates: Points, anchor: Points, size: Points, centre: Points, other_anchor: Points, other_size: Points
) -> Points:
    """(c,) what speaks against each place of a text beside another text that has its centre."""
    leaders = _leaders(anchor, candidates, size)
    other = _leaders(other_anchor, centre[None], other_size)[0]
    return (
        _FORBIDDEN * _inside(centre, candidates, (size + other_size) / 2 + _APART)
        + 8 * _inside(other, candidates, size / 2).sum(0)
        + 15 * _inside(leaders, centre[None], other_size / 2).sum((1, 2))
        + 15 * _inside(leaders, other, np.full(2, 3.0)).sum((1, 2))
    )


def _leaders(anchor: Points, centres: Points, size: Points) -> Points:
    """(c, 12, 2) places along the straight lines from an anchor to texts about centres (c, 2)."""
    end = np.clip(anchor, centres - size / 2, centres + size / 2)
    return anchor + np.linspace(0, 1, 12)[:, None] * (end - anchor)[:, None]


def _inside(places: Points, centres: Points, half: Points) -> NDArray[np.bool_]:
    """Whether places (..., 2) lie in boxes about centres (c, 2): (..., c); half: (2,) of width and height."""
    return np.asarray((np.abs(places[..., None, :] - centres) < half).all(-1))
