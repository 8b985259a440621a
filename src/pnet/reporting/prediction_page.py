"""What was found in one image as a page: picture, 3D view and table; it needs nothing but a browser."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene
from pnet.reporting.data_page import SHEET_STYLE
from pnet.reporting.data_tables import html_table
from pnet.reporting.page import Figures, document
from pnet.reporting.prediction_tables import detection_sheet, stage_text
from pnet.reporting.scene_view import scene_figure
from pnet.scenes.record_file import write_atomically

_STYLE = """
.facts { margin-top: 16px; }
.overlay img { display: block; max-width: 100%; max-height: 92vh; margin: 0 auto; border-radius: 6px; }
.hints { background: var(--card); border: 1px solid var(--line); border-left: 4px solid var(--accent);
  border-radius: 10px; padding: 6px 22px 10px; margin: 20px 0; }
.hints h2 { margin-top: 10px; }
.hints li { margin: 4px 0; max-width: 95ch; }
.found { overflow-x: auto; }
.numbers th + th, .numbers td { padding: 3px 0 3px 18px; }
"""


@dataclass(frozen=True, eq=False)
class PredictionPage:
    """What the page shows; text is plain, the page escapes it.

    Attributes:
        title: the head. facts: name and value: run, input, camera, what else is known.
        seconds: by stage, in order; empty where nobody knows them.
        picture: a PNG, see `overlay_picture`; empty: none.
        scene: the points that were predicted on; its truth may be empty. detections: what was found in them.
        part: the template of both.
    """

    title: str
    facts: Sequence[tuple[str, str]]
    seconds: Mapping[str, float]
    picture: bytes
    scene: Scene
    detections: Detections
    part: ParametricPart


def write_prediction_page(path: Path, content: PredictionPage) -> None:
    """Write the page; the file appears when it is whole, its folder must exist."""
    write_atomically(path, prediction_page_html(content).encode())


def prediction_page_html(content: PredictionPage) -> str:
    """The whole page."""
    figures = Figures()
    body = "\n".join((_head(content), _picture(content), _view(content, figures), _table(content)))
    return document(content.title, body, figures, SHEET_STYLE + _STYLE)


def camera_text(camera: Camera | None) -> str:
    """A camera as a fact of the page."""
    if camera is None:
        return "none: a cloud"
    names = ("fx", "fy", "cx", "cy")
    values = ", ".join(f"{name} {getattr(camera, name):.6g}" for name in names)
    return f"{camera.width} × {camera.height} pixels, {values}"


def hints(scene: Scene, part: ParametricPart) -> list[str]:
    """What to look at where nothing was found, with the numbers that tell.

    Args:
        scene: the points that were predicted on. part: the template that was looked for.
    """
    ends = [part.part_object("L", i) for i in (0, len(part.grids["L"]) - 1)]
    sizes = [1000 * float(part.mesh(parameters).extents.max()) for parameters in ends]
    looked_for = f"{part.name.upper()} measures {min(sizes):.0f} to {max(sizes):.0f} mm, its longest side"
    points = 1000 * scene.points[np.isfinite(scene.points).all(1)].astype(np.float64)
    if not len(points):
        return [
            "There are no points: is there depth between the camera's near and far "
            f"({scene.camera.near:g} and {scene.camera.far:g} m), and did the background leave any?"
        ]
    low, high = points.min(0), points.max(0)
    size = " × ".join(f"{side:.0f}" for side in high - low)
    return [
        f"Scale: the points span {size} mm, z from {low[2]:.0f} to {high[2]:.0f} mm; {looked_for}. Where "
        "these do not go together, the depth's unit is wrong.",
        "Camera: focal lengths and principal point must be those of this image, at its size. In the picture "
        "and in the 3D view below, parts must look undistorted.",
        f"Background: {len(points):,} points were looked at. Floor, bin and whatever else is no part take "
        "points from the parts; the training may never have seen them.",
        "Post-processing: a threshold of visibility, or a cluster's least number of points, may ask too much "
        "of this image.",
    ]


def _head(content: PredictionPage) -> str:
    found, points = len(content.detections.score), len(content.detections.instance)
    count = f"{found:,} found" if found else "nothing was found"
    facts = [*content.facts]
    if content.seconds:
        facts.append(("time", stage_text(content.seconds)))
    rows = "\n".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts)
    table = f'\n<table class="facts">{rows}</table>' if facts else ""
    return (
        f'<header><h1>{escape(content.title)}</h1>\n<p class="quiet">{escape(content.part.name.upper())}: '
        f"{count} in {points:,} points</p></header>{table}{'' if found else _hints(content)}"
    )


def _hints(content: PredictionPage) -> str:
    items = "\n".join(f"<li>{escape(hint)}</li>" for hint in hints(content.scene, content.part))
    return f'\n<section class="hints"><h2>Nothing was found</h2>\n<ul>\n{items}\n</ul></section>'


def _picture(content: PredictionPage) -> str:
    if not content.picture:
        return ""
    data = b64encode(content.picture).decode()
    return (
        "<h2>As the camera sees it</h2>\n"
        '<p class="quiet">In grey what was measured, in colour the estimated parts, numbered by score; pale '
        "where something was measured before them.</p>\n"
        '<figure class="overlay"><img alt="the estimated parts over what was measured" '
        f'src="data:image/png;base64,{data}"></figure>'
    )


def _view(content: PredictionPage, figures: Figures) -> str:
    figure = scene_figure(content.scene, content.detections, content.part)
    return (
        "<h2>In three dimensions</h2>\n"
        "<p class=\"quiet\">Seen from the camera's side, in the camera's frame. Drag to turn, scroll to "
        "zoom, point at a part for its score, dimensions and place. Points and estimate of one detection "
        "have one colour; grey points belong to none. Click a name above the scene to show or hide it.</p>\n"
        f'<figure class="scene">{figures.place(figure)}</figure>'
    )


def _table(content: PredictionPage) -> str:
    if not len(content.detections.score):
        return ""
    table = html_table(detection_sheet(content.detections, content.part))
    return f'<section class="found">{table}</section>'
