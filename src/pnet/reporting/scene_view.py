"""One scene in 3D: the points, the estimates over them, and the truth to switch on."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
import trimesh
from numpy.typing import NDArray

from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene

Points = NDArray[np.float64]

GREY = (0.56, 0.59, 0.63)  # what belongs to no instance
AXIS_COLOURS = ("#e5484d", "#46a758", "#4c8dff")  # x, y, z
_SECTIONS = 24  # polygon sides of a circle: enough to recognise a part, and the page stays small
_MOST_POINTS = 8192  # the first of the farthest-point order: an even sample
_SHARP = np.radians(30)
_GRID = "#a4acb6"  # WebGL grids take no transparency
_LIGHT = np.array([-0.32, -0.48, -0.82])  # towards the light: from behind the camera, above left
# plotly's own light goes astray where axes are reversed, so the faces come shaded
_UNLIT = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}


@dataclass(frozen=True, eq=False)
class Bodies:
    """Several bodies as one mesh.

    Attributes:
        mesh: all of them, camera frame, metres, its faces body by body.
        owner: (v,) int64 which body each vertex belongs to; bodies without a solid own none.
        missing: how many of the bodies have no valid solid or pose.
    """

    mesh: trimesh.Trimesh
    owner: NDArray[np.int64]
    missing: int

    @property
    def face_owner(self) -> NDArray[np.int64]:
        """(f,) int64 which body each face belongs to."""
        return self.owner[self.mesh.faces[:, 0]]


def pose_bodies(part: ParametricPart, sections: int, R: Points, t: Points, parameters: Points) -> Bodies:
    """The solids of one part in their poses; what cannot be built is left out and counted.

    Args:
        part: the template. sections: polygon sides that stand for a circle.
        R: (d, 3, 3), t: (d, 3) part → camera, metres. parameters: (d, k) metres.
    """
    part = copy.copy(part)
    part.sections = sections
    solids = {row.tobytes(): _solid(part, row) for row in parameters}
    vertices, faces, owner = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    missing = first = 0
    for i in range(len(R)):
        solid = solids[parameters[i].tobytes()]
        if solid is None or not (np.isfinite(R[i]).all() and np.isfinite(t[i]).all()):
            missing += 1
            continue
        vertices.append(solid.vertices @ R[i].T + t[i])
        faces.append(solid.faces + first)
        owner.append(np.full(len(solid.vertices), i))
        first += len(solid.vertices)
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    return Bodies(mesh, np.concatenate(owner), missing)


def detected_bodies(part: ParametricPart, sections: int, detections: Detections) -> Bodies:
    """`pose_bodies` of the estimates."""
    poses = (detections.R, detections.t, detections.parameters)
    R, t, parameters = (tensor.detach().double().cpu().numpy() for tensor in poses)
    return pose_bodies(part, sections, R, t, parameters)


def estimated_axes(part: ParametricPart, detections: Detections) -> Points:
    """Axes of the estimates whose size the method does not know; what stands for a solid then.

    Returns:
        (a, 3, 2, 3) origin and end of x, y and z, as long as the part's largest parameter is on average;
        camera frame, metres.
    """
    poses = (detections.R, detections.t, detections.parameters)
    R, t, parameters = (tensor.detach().double().cpu().numpy() for tensor in poses)
    shown = np.isnan(parameters).all(1) & np.isfinite(R).all((1, 2)) & np.isfinite(t).all(1)
    return pose_axes(part, R[shown], t[shown])


def pose_axes(part: ParametricPart, R: Points, t: Points) -> Points:
    """(a, 3, 2, 3) lines as of `estimated_axes` for poses R (a, 3, 3), t (a, 3)."""
    origin = np.repeat(t[:, None], 3, 1)
    return np.stack([origin, origin + part.grids["L"].mean(0).max() * R.swapaxes(1, 2)], 2)


def instance_colours(count: int) -> Points:
    """(count, 3) in [0, 1]: told apart well, of like brightness; a larger count keeps the first ones."""
    i = np.arange(count)
    hue = 2 * np.pi * np.mod(0.07 + i * 0.6180339887, 1.0)
    lightness = np.array([0.72, 0.62, 0.82, 0.67])[i % 4]
    a, b = 0.135 * np.cos(hue), 0.135 * np.sin(hue)
    # Oklab → linear sRGB (Ottosson 2020)
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    red = 4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short
    green = -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short
    blue = -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short
    linear = np.clip(np.stack([red, green, blue], -1), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def point_colours(instance: NDArray[np.int64], count: int) -> Points:
    """(n, 3) colour of each point's instance, grey for −1."""
    return np.concatenate([instance_colours(count), [GREY]])[instance]


def scene_figure(scene: Scene, detections: Detections, part: ParametricPart) -> go.Figure:
    """Interactive view; each of the layers "points", "estimates" and "truth" is switched in the legend.

    Args:
        scene: what was seen; its truth may be empty. detections: what was found in its first points.
        part: the template of both.
    """
    sections = min(_SECTIONS, part.sections)
    found = detected_bodies(part, sections, detections)
    axes = estimated_axes(part, detections)
    truth = pose_bodies(part, sections, scene.R, scene.t, scene.parameters)
    instance = detections.instance.cpu().numpy()
    points = _millimetres(scene.points[: len(instance)][:_MOST_POINTS])
    traces = [
        *_point_traces(points, instance[:_MOST_POINTS], detections, part),
        _estimate_trace(found, detections, part),
        _axes_trace(axes),
        *_truth_traces(truth),
    ]
    # plotly.js stops at a mesh without corners, and makes a flat figure of no traces at all
    figure = go.Figure([trace for trace in traces if len(trace.x) or trace.type == "scatter3d"])
    clouds = [points, *map(_millimetres, (found.mesh.vertices, axes, truth.mesh.vertices))]
    notes = _notes(len(points), detections, found.missing, len(axes))
    figure.update_layout(_layout(np.concatenate(clouds), notes))
    return figure


def _point_traces(
    points: NDArray[np.float32],
    instance: NDArray[np.int64],
    detections: Detections,
    part: ParametricPart,
) -> list[go.Scatter3d]:
    """The points of detections and those of none."""
    colours = np.array([_hex(colour) for colour in instance_colours(len(detections.score))], object)
    of, common = instance[instance >= 0], {"mode": "markers", "legendgroup": "points"}
    clustered = go.Scatter3d(
        **_columns(points[instance >= 0]),
        **common,
        name="points",
        showlegend=len(of) > 0,
        marker={"size": 2.2, "color": colours[of].tolist()},
        customdata=_hover_rows(detections)[of],
        hovertemplate=_hover_template(part, detections),
    )
    others = go.Scatter3d(
        **_columns(points[instance < 0]),
        **common,
        name="points of no instance",
        showlegend=not len(of) and len(points) > 0,
        marker={"size": 2.2, "color": _hex(np.array(GREY))},
        hoverinfo="skip",
    )
    return [clustered, others]


def _estimate_trace(found: Bodies, detections: Detections, part: ParametricPart) -> go.Mesh3d:
    """One mesh of all; with colours by face plotly numbers what is hovered by face too."""
    faces = _far_to_near(found.mesh)
    owner = found.face_owner[faces]
    shade = 0.55 + 0.5 * np.clip(found.mesh.face_normals[faces] @ _LIGHT, 0, 1)
    colours = np.clip(instance_colours(len(detections.score))[owner] * shade[:, None], 0, 1)
    return go.Mesh3d(
        **_columns(_millimetres(found.mesh.vertices)),
        **_corners(found.mesh, faces),
        name="estimates",
        legendgroup="estimates",
        showlegend=True,
        color="#4c8dff",
        facecolor=[_hex(colour) for colour in colours],
        opacity=0.7,
        lighting=_UNLIT,
        customdata=_hover_rows(detections)[owner],
        hovertemplate=_hover_template(part, detections),
    )


def _axes_trace(axes: Points) -> go.Scatter3d:
    """Lines (a, 3, 2, 3) of the estimates that have no solid; they belong to the same layer."""
    return go.Scatter3d(
        **_columns(_with_gaps(_millimetres(axes).reshape(-1, 2, 3))),
        name="axes of estimates",
        legendgroup="estimates",
        showlegend=len(axes) > 0,
        mode="lines",
        line={"color": [c for c in AXIS_COLOURS for _ in range(3)] * len(axes), "width": 5},
        hoverinfo="skip",
    )


def _truth_traces(truth: Bodies) -> list[go.Mesh3d | go.Scatter3d]:
    """Pale solids and their sharp edges, hidden at first."""
    common = {"legendgroup": "truth", "visible": "legendonly", "hoverinfo": "skip"}
    solids = go.Mesh3d(
        **_columns(_millimetres(truth.mesh.vertices)),
        **_corners(truth.mesh, _far_to_near(truth.mesh)),
        name="truth",
        showlegend=True,
        color="#9aa3ad",
        opacity=0.25,
        lighting=_UNLIT,
        **common,
    )
    edges = go.Scatter3d(
        **_columns(_edge_lines(truth.mesh)),
        name="truth edges",
        showlegend=False,
        mode="lines",
        line={"color": "#808894", "width": 3},
        **common,
    )
    return [solids, edges]


def _edge_lines(mesh: trimesh.Trimesh) -> NDArray[np.float32]:
    """(3e, 3) start and end of every sharp edge and a gap, mm."""
    sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > _SHARP] if len(mesh.faces) else []
    return _with_gaps(_millimetres(mesh.vertices)[np.asarray(sharp, np.int64).reshape(-1, 2)])


def _with_gaps(ends: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, 2, 3) starts and ends of lines → (3n, 3) with a gap after each."""
    return np.concatenate([ends, np.full_like(ends[:, :1], np.nan)], 1).reshape(-1, 3)


def _hover_rows(detections: Detections) -> NDArray[np.float32]:
    """(d, 5 + k) number, score, position and parameters in mm."""
    d = len(detections.score)
    columns = (
        np.arange(1, d + 1)[:, None],
        detections.score.detach().cpu().numpy()[:, None],
        1000 * detections.t.detach().cpu().numpy(),
        1000 * detections.parameters.detach().cpu().numpy(),
    )
    return np.concatenate(columns, 1).astype(np.float32)


def _hover_template(part: ParametricPart, detections: Detections) -> str:
    values = "".join(
        f"<br>{name} %{{customdata[{5 + i}]:.2f}} mm"
        for i, name in enumerate(part.parameter_names)
        if not bool(detections.parameters[:, i].isnan().all())
    )
    place = ", ".join(f"%{{customdata[{i}]:.1f}}" for i in (2, 3, 4))
    return (
        f"<b>detection %{{customdata[0]}}</b><br>score %{{customdata[1]:.3f}}{values}"
        f"<br>at ({place}) mm<extra></extra>"
    )


def _far_to_near(mesh: trimesh.Trimesh) -> NDArray[np.int64]:
    """Order of the faces in which transparent ones blend rightly, seen from the camera's side."""
    return np.argsort(-mesh.triangles[:, :, 2].mean(1), kind="stable")


def _corners(mesh: trimesh.Trimesh, faces: NDArray[np.int64]) -> dict[str, NDArray[np.integer]]:
    small = np.uint16 if len(mesh.vertices) <= 2**16 else np.uint32
    return dict(zip("ijk", mesh.faces[faces].astype(small).T, strict=True))


def _layout(cloud: NDArray[np.float32], notes: Sequence[str]) -> go.Layout:
    cloud = cloud if len(cloud) else np.array([[-50, -50, 450], [50, 50, 550]], np.float32)
    low, high = cloud.min(0) - 2.0, cloud.max(0) + 2.0
    ratio = (high - low) / (high - low)[:2].max()
    axes = {
        f"{name}axis": {
            "title": {"text": f"{name} (mm)"},
            # y and z reversed: up on the screen is towards the camera, so dragging keeps the pile upright
            "range": [low[i], high[i]] if name == "x" else [high[i], low[i]],
            "showbackground": False,
            "gridcolor": _GRID,
            "zeroline": False,
            "showspikes": False,
        }
        for i, name in enumerate("xyz")
    }
    return go.Layout(
        scene={
            **axes,
            "aspectmode": "manual",
            "aspectratio": dict(zip("xyz", ratio.tolist(), strict=True)),
            "camera": {"eye": {"x": 0, "y": -0.83, "z": 1.36}, "center": {"x": 0, "y": 0, "z": -0.09}},
            "dragmode": "turntable",
        },
        paper_bgcolor="rgba(0,0,0,0)",
        font={"family": "system-ui, sans-serif", "color": "#808894"},
        legend={
            "orientation": "h",
            "itemsizing": "constant",
            "font": {"size": 15},
            "x": 0,
            "y": 1,
        },
        modebar={"orientation": "v"},
        hoverlabel={"bgcolor": "#20262e", "font": {"color": "#ffffff"}},
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        annotations=[
            {"text": note, "xref": "paper", "yref": "paper", "x": 0.5, "y": 1 - 0.05 * i}
            | {"showarrow": False, "font": {"size": 17}}
            for i, note in enumerate(notes)
        ],
    )


def _notes(points: int, detections: Detections, missing: int, sizeless: int) -> list[str]:
    """missing: estimates without a solid; sizeless: those of them that are drawn as axes."""
    notes = []
    if not points:
        notes.append("this scene has no points")
    if not len(detections.score):
        notes.append("nothing was found")
    if sizeless:
        notes.append("sizes are not estimated: axes stand for the bodies")
    if missing > sizeless:
        notes.append(f"estimates without a valid solid, not drawn: {missing - sizeless}")
    return notes


def _solid(part: ParametricPart, parameters: Points) -> trimesh.Trimesh | None:
    try:
        part.check_named(parameters)
        return part.mesh(parameters)
    except ValueError:  # an early network may estimate parameters that describe no solid
        return None


def _columns(points: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    return dict(zip("xyz", points.T, strict=True))


def _millimetres(points: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.round(1000 * points, 2).astype(np.float32).reshape(-1, 3)


def _hex(colour: Points) -> str:
    return "#" + "".join(f"{round(255 * float(c)):02x}" for c in colour)
