"""A page of sample scenes of a data set, with its numbers; it needs nothing but a browser."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import plotly.graph_objects as go
import torch

from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene
from pnet.reporting.data_tables import Sheet, html_table
from pnet.reporting.page import Figures, document
from pnet.reporting.scene_view import scene_figure
from pnet.scenes.inspection import MOST_OCCLUDED, DataSet, whole_cycle
from pnet.scenes.protocol import CycleTask
from pnet.scenes.record_file import write_atomically

MOST_SCENES = 12  # browsers keep some sixteen 3D views alive, then blank the oldest
_STEP_BACK = 1.15  # of the camera, against a report's larger figures
SHEET_STYLE = """
.sheets { display: flex; flex-wrap: wrap; gap: 0 48px; align-items: start; }
.sheets section { min-width: 0; max-width: 100%; overflow-x: auto; }
.sheet tr:first-child th { border-bottom: 1px solid var(--line); }
.sheet p { max-width: 60ch; }
.numbers td, .bars td { white-space: pre; font-size: .86rem;
  font-family: ui-monospace, "DejaVu Sans Mono", "Liberation Mono", monospace; }
.numbers td, .numbers th + th { text-align: right; }
"""
_SCENES = """
.scenes { display: grid; gap: 20px; grid-template-columns: repeat(auto-fit, minmax(min(100%, 520px), 1fr)); }
.scenes figure { margin: 0; }
.scenes .plot { height: 520px; }
"""


@dataclass(frozen=True, eq=False)
class DataPage:
    """What the page shows; text is plain, the page escapes it.

    Attributes:
        title, subtitle: the head. sheets: tables. scenes: caption and 3D figure of each.
    """

    title: str
    subtitle: str
    sheets: Sequence[Sheet]
    scenes: Sequence[tuple[str, go.Figure]]


def write_data_page(path: Path, content: DataPage) -> None:
    """Write the page; the file appears when it is whole, its folder must exist."""
    write_atomically(path, data_page_html(content).encode())


def data_page_html(content: DataPage) -> str:
    """The whole page."""
    figures = Figures()
    scenes = "\n".join(
        f'<figure class="scene"><figcaption>{escape(caption)}</figcaption>{figures.place(figure)}</figure>'
        for caption, figure in content.scenes
    )
    sheets = "\n".join(f"<section>{html_table(sheet)}</section>" for sheet in content.sheets)
    body = f"""<header><h1>{escape(content.title)}</h1>
<p class="quiet">{escape(content.subtitle)}</p></header>
<div class="sheets">
{sheets}
</div>
<h2>Sample scenes</h2>
<p class="quiet">Seen from the camera's side, in the camera's frame. Every body has its colour. Drag to turn,
scroll to zoom, point at a body for its visibility, dimensions and place; click a name above the scene to show
or hide it.</p>
<div class="scenes">
{scenes}
</div>"""
    return document(content.title, body, figures, SHEET_STYLE + _SCENES)


def sample_scenes(data: DataSet, splits: Sequence[str], count: int) -> list[Scene]:
    """Scenes spread over splits, kinds and part objects, each the fullest bin of its cycle.

    Args:
        data: the set; only whole cycles count. splits: to choose from. count: how many; fewer where fewer
            cycles hold a scene.
    """
    groups: dict[tuple[str, str], list[CycleTask]] = {}
    for task in data.tasks:
        if task.split in splits and (file := whole_cycle(data, task)) is not None and len(file):
            groups.setdefault((task.split, task.kind), []).append(task)
    places = sorted(groups, key=lambda place: (data.splits.index(place[0]), place[1] != "pile"))
    chosen: list[CycleTask] = []
    while len(chosen) < count and any(groups.values()):
        for place in places:
            if groups[place] and len(chosen) < count:
                chosen.append(_least_like(groups[place], chosen))
                groups[place].remove(chosen[-1])
    chosen.sort(key=lambda task: places.index((task.split, task.kind)))
    files = [whole_cycle(data, task) for task in chosen]
    return [file.scene(len(file) - 1) for file in files if file is not None]


def truth_figure(scene: Scene, part: ParametricPart) -> go.Figure:
    """Interactive view of a scene: its points and its bodies, each switched in the legend."""
    truth = Detections(
        R=torch.from_numpy(scene.R),
        t=torch.from_numpy(scene.t),
        parameters=torch.from_numpy(scene.parameters),
        score=torch.from_numpy(scene.visibility),
        keypoints=torch.full((len(scene.R), len(part.keypoints), 3), math.nan, dtype=torch.float64),
        instance=torch.from_numpy(scene.instance),
    )
    nobody = {name: getattr(scene, name)[:0] for name in ("R", "t", "parameters", "visibility", "occlusion")}
    figure = scene_figure(replace(scene, **nobody), truth, part)  # as estimates bodies have colours
    for trace in figure.data:
        if trace.hovertemplate:
            text = trace.hovertemplate.replace("<b>detection ", "<b>body ")
            trace.hovertemplate = text.replace("<br>score ", "<br>visibility ")
        if trace.name == "estimates":
            trace.name = "bodies"
    # two figures stand beside each other: a step back, and fewer numbers along the short axis
    eye = {axis: _STEP_BACK * figure.layout.scene.camera.eye[axis] for axis in "xyz"}
    figure.update_layout(scene={"camera": {"eye": eye}, "zaxis": {"nticks": 4}})
    return figure


def scene_caption(scene: Scene, part: ParametricPart) -> str:
    """Where the scene comes from and what it holds."""
    to_find = int((scene.occlusion <= MOST_OCCLUDED).sum())
    sizes = part.text(scene.parameters[0])
    return f"{scene.id}: {len(scene.R)} bodies, {to_find} at most half occluded; {sizes}"


def _least_like(tasks: Sequence[CycleTask], chosen: Sequence[CycleTask]) -> CycleTask:
    """The task whose part object was shown least often, then the one farthest from those shown."""

    def rank(task: CycleTask) -> tuple[int, int]:
        shown = [other.part_index for other in chosen if other.grid == task.grid]
        distance = min((abs(task.part_index - index) for index in shown), default=0)
        return shown.count(task.part_index), -distance

    return min(tasks, key=rank)
