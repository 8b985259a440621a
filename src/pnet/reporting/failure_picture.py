"""A picture of what failed in one scene: clusters with the outcomes of bodies, poses by their kind."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from pnet.geometry.camera import Camera
from pnet.metrics.breakdown import ResultRows, TruthRows
from pnet.metrics.outcomes import Kind, Outcome
from pnet.metrics.pose_attributes import Blame
from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene
from pnet.reporting.picture import (
    BACKGROUND,
    PANEL,
    SIZE,
    draw_axes,
    draw_image,
    first_hits,
    outlines,
    oversampled,
    pixel_rays,
    surface_light,
    two_panels,
    write_png,
)
from pnet.reporting.scene_view import Bodies, detected_bodies, estimated_axes, pose_bodies

Points = NDArray[np.float64]

_SECTIONS = 48  # polygon sides of a circle
_HALO = [withStroke(linewidth=2.5, foreground=(*BACKGROUND, 0.9))]
_TEXT, _QUIET = "#e8ecf1", "#8e98a4"
KIND_COLOURS = {
    Kind.RIGHT: "#4c9fd4",
    Kind.DUPLICATE: "#cc79a7",
    Kind.HIDDEN: "#8e98a4",
    Kind.FALSE: "#e8703a",
}
# lighter than those of the figure, to stand out on black
MARK_COLOURS = {
    Outcome.MISSED: "#ffffff",
    Outcome.MERGED: "#f2c14e",
    Outcome.SPLIT: "#e79cc9",
    Outcome.WRONG_POSE: "#ff9466",
}


def failure_picture(
    scene: Scene,
    detections: Detections,
    truths: TruthRows,
    results: ResultRows,
    part: ParametricPart,
    path: Path,
) -> None:
    """Write a PNG of two panels; the file appears when it is whole.

    Args:
        detections: what was found in the scene's first points. truths, results: the rows of this scene.
        path: where to write; the folder must exist.
    """
    write_png(failure_figure(scene, detections, truths, results, part), path)


def failure_figure(
    scene: Scene, detections: Detections, truths: TruthRows, results: ResultRows, part: ParametricPart
) -> Figure:
    """The figure that `failure_picture` writes."""
    found = detected_bodies(part, _SECTIONS, detections)
    figure, left, right, camera, _ = two_panels(scene, detections, found)
    colours = np.array([to_rgb(KIND_COLOURS[Kind(kind)]) for kind in results.kinds.kind]).reshape(-1, 3)
    draw_image(right, plain_image(camera, found, colours))
    draw_axes(right, camera, estimated_axes(part, detections))
    lost = np.flatnonzero(truths.fate.outcome != Outcome.FOUND)
    for row in lost:
        _mark(left, right, camera, scene, truths, int(row), part)
    _caption(figure, scene, truths, results)
    return figure


def plain_image(camera: Camera, bodies: Bodies, colours: Points) -> Points:
    """Image (h, w, 3) in [0, 1] of bodies under an open sky: without shadows, which take most of the time.

    Args:
        camera: the view. bodies: camera frame. colours: (d, 3) in [0, 1], of the bodies' owners.
    """
    camera = oversampled(camera)
    rays = pixel_rays(camera)
    image, body = np.tile(BACKGROUND, (len(rays), 1)), np.full(len(rays), -1)
    hits = first_hits(bodies, rays)
    if len(hits.ray):
        light = surface_light(hits.normal, hits.depth)
        image[hits.ray] = np.clip(colours[hits.body] * light[:, None], 0, 1)
        body[hits.ray] = hits.body
    image = image.reshape(camera.height, camera.width, 3)
    image[outlines(body.reshape(image.shape[:2]))] *= 0.35
    return image


def outline(camera: Camera, vertices: Points) -> Points:
    """(c, 2) pixels of the convex outline of a body's vertices (v, 3), closed; (0, 2) where there is none."""
    before = vertices[vertices[:, 2] > 0]
    if len(before) < 3:
        return np.zeros((0, 2))
    pixels = camera.project(before)
    try:
        corners = ConvexHull(pixels).vertices
    except QhullError:  # on a line
        return np.zeros((0, 2))
    return np.asarray(pixels[np.append(corners, corners[0])])


def outcome_word(truths: TruthRows, row: int) -> str:
    """What is written at a body that was not found."""
    outcome = Outcome(truths.fate.outcome[row])
    if outcome is not Outcome.WRONG_POSE:
        return outcome.label
    turned = f" {np.degrees(truths.errors.rotation[row]):.0f}°"
    match Blame(truths.errors.blame[row]):
        case Blame.POSITION:
            return "position"
        case Blame.ROTATION:
            return f"rotation{turned}"
        case Blame.BOTH:
            return f"position, rotation{turned}"
    return "wrong pose"


def _mark(
    left: Axes, right: Axes, camera: Camera, scene: Scene, truths: TruthRows, row: int, part: ParametricPart
) -> None:
    """The true outline of a body in both panels, and in the left one what became of it."""
    body = int(truths.fate.body[row])
    colour = MARK_COLOURS[Outcome(truths.fate.outcome[row])]
    pose = (part, _SECTIONS, scene.R[[body]], scene.t[[body]], scene.parameters[[body]])
    line = outline(camera, np.asarray(pose_bodies(*pose).mesh.vertices))
    for axes in (left, right):
        axes.plot(*line.T, color=colour, linewidth=1.6, linestyle=(0, (4, 2)), path_effects=_HALO, zorder=4)
    if scene.t[body, 2] > 0:
        u, v = camera.project(scene.t[body]).tolist()
        style: dict[str, Any] = {"size": 10, "weight": "bold", "ha": "center", "va": "center"}
        text = left.text(u, v, outcome_word(truths, row), color=colour, path_effects=_HALO, **style)
        text.set(clip_on=True, zorder=5)


def _caption(figure: Figure, scene: Scene, truths: TruthRows, results: ResultRows) -> None:
    lost = int((truths.fate.outcome != Outcome.FOUND).sum())
    cloud = "Points by cluster; outlined: bodies not found"
    for x, heading in zip((28, SIZE[0] - PANEL + 12), (cloud, "Results by kind"), strict=True):
        figure.text(x / SIZE[0], 1 - 40 / SIZE[1], heading, color=_TEXT, size=15, va="center")
    hidden = len(scene.R) - len(truths)
    told = f"{scene.part.upper()}   ·   {scene.id}   ·   {lost} of {len(truths)} bodies to find not found"
    told += f"   ·   {hidden} too occluded to count" if hidden else ""
    figure.text(28 / SIZE[0], 26 / SIZE[1], told, color=_QUIET, size=11.5, va="center")
    kinds = [(kind, int((results.kinds.kind == kind).sum())) for kind in Kind]
    handles = [Patch(facecolor=KIND_COLOURS[kind], label=f"{kind.label} ({n})") for kind, n in kinds]
    place: dict[str, Any] = {"loc": "center right", "bbox_to_anchor": (1 - 8 / SIZE[0], 1 - 40 / SIZE[1])}
    figure.legend(
        handles=handles, ncols=4, frameon=False, fontsize=10.5, columnspacing=1.4, labelcolor=_TEXT, **place
    )
