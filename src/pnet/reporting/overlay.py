"""One picture of what was found in an image: the depth or the cloud in grey, the estimated bodies over it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Detections
from pnet.reporting.body_layer import body_layer
from pnet.reporting.picture import (
    BACKGROUND,
    crop,
    draw_axes,
    draw_cloud,
    draw_image,
    pixel_axes,
    write_png,
)
from pnet.reporting.prediction_tables import by_score
from pnet.reporting.relief import SURFACE, measured_surface, surface_image, with_size
from pnet.reporting.scene_view import detected_bodies, instance_colours, pose_axes

Points = NDArray[np.float64]

LONG_SIDE = (1280, 1600)  # pixels: smaller images are enlarged, larger ones reduced
CAPTION = 44  # pixels below the image
_SECTIONS = 72  # polygon sides of a circle
_NUMBER = (11.0, 22.0)  # pixels, smallest and largest
_PLAIN = Camera(1024, 1024, 1e3, 1e3, 511.5, 511.5)  # of clouds without a camera, before it frames them
_TITLE = 60  # characters
_HALO = [withStroke(linewidth=2.5, foreground=(*BACKGROUND, 0.85))]
_TEXT, _QUIET = "#e8ecf1", "#8e98a4"


def overlay_picture(
    depth: NDArray[np.floating] | None,
    camera: Camera | None,
    cloud: NDArray[np.floating],
    detections: Detections,
    part: ParametricPart,
    path: Path,
    title: str = "",
) -> None:
    """Write a PNG in the camera's own view; the file appears when it is whole.

    Args:
        depth: (h, w) planar depth, metres, 0 or NaN where nothing was measured; None: the cloud is drawn.
        camera: of the image, or of the cloud; None: one that frames the cloud.
        cloud: (N, 3) the points that were predicted on, camera frame, metres.
        detections: what was found. part: the template. title: of the caption, a file's name.
        path: where to write; the folder must exist.
    Raises:
        ValueError: where a depth image has no camera, or one of another size.
    """
    write_png(overlay_figure(depth, camera, cloud, detections, part, title), path)


def overlay_figure(
    depth: NDArray[np.floating] | None,
    camera: Camera | None,
    cloud: NDArray[np.floating],
    detections: Detections,
    part: ParametricPart,
    title: str = "",
) -> Figure:
    """The figure that `overlay_picture` writes."""
    _check(depth, camera)
    points = np.asarray(cloud, np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(1)]
    if camera is not None:
        view = resized(camera)
    else:
        t = detections.t.detach().double().cpu()
        view, shift = framing(points, t.numpy())
        points, detections = points + shift, replace(detections, t=t + torch.from_numpy(shift))
    surface = None if depth is None else measured_surface(depth, view)
    size = (view.width / 100, (view.height + CAPTION) / 100)
    figure = Figure(figsize=size, dpi=100, facecolor=BACKGROUND)
    axes = pixel_axes(figure, (0, 0), (view.width, view.height))
    if surface is None:
        draw_cloud(axes, view, points, np.tile(SURFACE, (len(points), 1)))
    else:
        draw_image(axes, surface_image(surface, view))
    notes = _draw_detections(axes, view, detections, part, surface)
    _write_caption(figure, caption(title, part, detections, notes))
    return figure


def resized(camera: Camera) -> Camera:
    """The same view with a long side of `LONG_SIDE` pixels."""
    long = max(camera.width, camera.height)
    scale = float(np.clip(long, *LONG_SIDE)) / long
    return with_size(camera, *(max(round(scale * side), 1) for side in (camera.width, camera.height)))


def framing(points: Points, places: Points) -> tuple[Camera, Points]:
    """A camera that looks along z at a cloud, stray points aside.

    Args:
        points: (n, 3) metres. places: (d, 3) of the detections, for a cloud without points.
    Returns:
        The camera, and the shift (3,) of everything that puts it into its place: none where the cloud can
        be seen from the origin.
    """
    content = points if len(points) else places[np.isfinite(places).all(1)]
    if not len(content):
        return _PLAIN, np.zeros(3)
    low, high = np.quantile(content, [0.005, 0.995], axis=0)
    margin = 0.05 * (high - low).max() + 1e-3
    inner = content[((content >= low - margin) & (content <= high + margin)).all(1)]
    shift = np.zeros(3)
    if (np.abs(inner[:, :2]).max(1) > 1.5 * inner[:, 2]).any():
        shift = np.r_[-(low + high)[:2] / 2, 1.5 * (high - low).max() + 0.1 - low[2]]
    return with_size(crop(_PLAIN, inner + shift, places[:0]), _PLAIN.width, _PLAIN.height), shift


def _check(depth: NDArray[np.floating] | None, camera: Camera | None) -> None:
    if depth is not None and camera is None:
        raise ValueError("a depth image is drawn in its camera's view: give its camera")
    if depth is not None and camera is not None and depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"depth image has shape {depth.shape}, the camera expects {(camera.height, camera.width)}"
        )


def _draw_detections(
    axes: Axes, view: Camera, detections: Detections, part: ParametricPart, surface: Points | None
) -> list[str]:
    """Bodies, axes of those that have none, and ranks; what the caption has to say of them."""
    R, t = (tensor.detach().double().cpu().numpy() for tensor in (detections.R, detections.t))
    bodies = detected_bodies(part, _SECTIONS, detections)
    layer = body_layer(view, bodies, instance_colours(len(t)), surface)
    draw_image(axes, layer.image, above=True)
    bare = np.setdiff1d(np.arange(len(t)), bodies.owner)
    placed = bare[np.isfinite(R[bare]).all((1, 2)) & np.isfinite(t[bare]).all(1)]
    draw_axes(axes, view, pose_axes(part, R[placed], t[placed]))
    order = by_score(detections)
    anchors = rank_anchors(view, layer.owner, t, bodies.owner, order)
    left_out = write_ranks(axes, anchors, _number_size(layer.owner, view))
    sizeless = int(detections.parameters[torch.from_numpy(placed)].isnan().all(1).sum())
    if not len(t):
        _write_nothing(axes, view)
    notes = {
        "sizes are not estimated: axes stand for the bodies": sizeless,
        f"{len(placed) - sizeless} of impossible sizes: axes": len(placed) - sizeless,
        f"{len(bare) - len(placed)} without a pose": len(bare) - len(placed),
        f"crowded: {left_out} without a number": left_out,
    }
    return [note for note, count in notes.items() if count]


def rank_anchors(
    view: Camera, owner: NDArray[np.int64], t: Points, solid: NDArray[np.int64], order: NDArray[np.int64]
) -> dict[int, Points]:
    """Where the numbers of the detections go: rank from 1 → (2,) pixel, the best first.

    That is the body's centroid; where another body lies before it, the place farthest inside what is seen
    of its own. What is not seen gets no number.

    Args:
        owner: (h, w) see `Layer`. t: (d, 3) metres. solid: indices of the detections that have a body.
        order: (d,) indices by score.
    """
    anchors = {}
    (h, w), has_body, seen = owner.shape, np.isin(np.arange(len(t)), solid), np.isin(np.arange(len(t)), owner)
    for rank, i in enumerate(order.tolist(), 1):
        ahead = np.isfinite(t[i]).all() and t[i, 2] > 0
        centre = view.project(t[i]) if ahead else np.full(2, -1.0)
        inside = ((centre > -0.5) & (centre < [w - 0.5, h - 0.5])).all()
        u, v = centre.round().astype(int) if inside else (0, 0)
        if inside and (owner[v, u] in (i, -1) if seen[i] else not has_body[i]):
            anchors[rank] = centre
        elif seen[i]:
            anchors[rank] = _deepest(owner == i)
    return anchors


def _deepest(body: NDArray[np.bool_]) -> Points:
    """(2,) the pixel of a body that is farthest from its border; (h, w), at least one pixel."""
    rows, columns = (np.flatnonzero(body.any(axis)) for axis in (1, 0))
    top, left = rows[0], columns[0]
    inner = np.pad(body[top : rows[-1] + 1, left : columns[-1] + 1], 1)
    v, u = np.unravel_index(distance_transform_edt(inner).argmax(), inner.shape)
    return np.array([left + u - 1.0, top + v - 1.0])


def _number_size(owner: NDArray[np.int64], view: Camera) -> float:
    """Height of the numbers in pixels, by that of the bodies in view."""
    seen = np.bincount(owner[owner >= 0])
    return float(np.clip(0.3 * np.sqrt(np.median(seen[seen > 0])), *_NUMBER)) if seen.any() else _NUMBER[1]


def write_ranks(axes: Axes, anchors: dict[int, Points], size: float) -> int:
    """Write numbers that do not cover each other: smaller where it is crowded, then none; how many are none.

    Args:
        axes: a panel in pixels. anchors: of `rank_anchors`. size: pixels, of numbers that have room.
    """
    boxes, left_out = np.zeros((0, 4)), 0
    for rank, anchor in anchors.items():
        for height in (size, _NUMBER[0]):
            half = np.array([0.37 * len(str(rank)) * height + 2, 0.55 * height])
            box = np.r_[anchor - half, anchor + half]
            if not ((box[:2] < boxes[:, 2:]) & (box[2:] > boxes[:, :2])).all(1).any():
                text = axes.text(float(anchor[0]), float(anchor[1]), str(rank), color="white", weight="bold")
                text.set(size=0.72 * height, ha="center", va="center", path_effects=_HALO, clip_on=True)
                boxes = np.concatenate([boxes, box[None]])
                break
        else:
            left_out += 1
    return left_out


def _write_nothing(axes: Axes, view: Camera) -> None:
    text = axes.text(view.width / 2, 48, "nothing was found", color=_TEXT, size=24)
    text.set(ha="center", va="center", bbox={"facecolor": (*BACKGROUND, 0.8), "linewidth": 0, "pad": 12})


def caption(title: str, part: ParametricPart, detections: Detections, notes: Sequence[str] = ()) -> str:
    """The line below the picture; of a long title the end, which tells files apart."""
    title = title if len(title) <= _TITLE else "…" + title[1 - _TITLE :]
    told = ["nothing was found"]
    if len(detections.score):
        best = float(detections.score[by_score(detections)[0]])
        told = [f"{len(detections.score)} found, best score {best:.2f}", "numbers: ranks by score"]
    return "   ·   ".join(filter(None, (title, part.name.upper(), *told, *notes)))


def _write_caption(figure: Figure, words: str) -> None:
    """In one line, smaller where it would not fit."""
    width, height = figure.get_size_inches() * figure.dpi
    text = figure.text(16 / width, CAPTION / 2 / height, words, color=_TEXT, size=12, va="center")
    FigureCanvasAgg(figure)
    needed = text.get_window_extent().width / (width - 32)
    if needed > 1:
        text.set_fontsize(0.95 * 12 / needed)  # small letters are a little wider than in proportion
