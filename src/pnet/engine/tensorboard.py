"""What TensorBoard shows of a run beside its scalars (docs/tensorboard.md)."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensorboard.compat.proto.summary_pb2 import Summary, SummaryMetadata
from tensorboard.plugins.hparams import api_pb2, metadata
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData, SessionEndInfo, SessionStartInfo
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from pnet.metrics.average_precision import count_positives, precision_recall_curve
from pnet.metrics.matching import SceneMatch
from pnet.metrics.pose_metric import PoseMetrics
from pnet.parts.base import ParametricPart, Points
from pnet.records import Detections, Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = 255 * np.array(
    [[0.12, 0.47, 0.71], [1, 0.5, 0.05], [0.17, 0.63, 0.17], [0.84, 0.15, 0.16], [0.58, 0.4, 0.74]]
)
COLUMNS = 127  # the most thresholds that fit in a summary of the plugin's
# the viewer steps back by the size of what it shows; by default it cuts off all that is nearer than 0.1 m
CAMERA = {"camera": {"cls": "PerspectiveCamera", "fov": 75, "near": 0.001, "far": 100}}
DOTS = {**CAMERA, "material": {"cls": "PointsMaterial", "size": 0.001}}  # metres
MOST_VERTICES = 2**16  # the viewer numbers them in 16 bits
MOST_OBJECTS = 8  # with more part objects their curves bury the part's own

Setting = str | float | bool
Curve = Mapping[str, Sequence[float]]
Mesh = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]


def log_hyperparameters(
    folder: Path,
    chosen: Mapping[str, Setting],
    first: Collection[str],
    scores: Mapping[str, float | None],
    curves: Mapping[str, Curve],
) -> None:
    """Put a run on the page that compares runs; what an earlier call said of it goes.

    Args:
        folder: of the run's event files.
        chosen: settings by name, the same names in every run, since the page takes its columns from any one.
        first: those of them that the page shows unasked (five at most).
        scores: by tag, the same tags in every run; None where there is none.
        curves: "precision" and "recall", drawn, by tag.
    """
    with _in_place_of_earlier(folder, "outcome") as writer:
        for summary in _session(chosen, first, scores):
            writer._get_file_writer().add_summary(summary)
        for tag, score in scores.items():
            if score is not None:
                writer.add_scalar(tag, score)
        for tag, curve in curves.items():
            writer.add_figure(tag, _drawn(curve["recall"], curve["precision"]))


def add_settings(folder: Path, settings: str) -> None:
    """The run's whole config (YAML) as text; that of an earlier start goes. folder: of the event files."""
    with _in_place_of_earlier(folder, "settings") as writer:
        writer.add_text("settings", f"```yaml\n{settings}```")


def add_curves(
    writer: SummaryWriter,
    part: ParametricPart,
    metrics: PoseMetrics,
    sizes: Sequence[Points | None],
    step: int,
) -> None:
    """Precision over recall: of all scenes, of each part object where there are few, and as a picture.

    Args:
        metrics: of some scenes. sizes: (k,) metres of each scene's part object; None for an empty scene.
    """
    fields = (getattr(metrics, name) for name in SceneMatch.__dataclass_fields__)
    matches = [SceneMatch(*(field.cpu() for field in row)) for row in zip(*fields, strict=True)]
    by_tag = {part.name: matches}
    objects = defaultdict(list)
    for match, size in zip(matches, sizes, strict=True):
        if size is not None:
            objects[f"{part.name}_{'x'.join(f'{1000 * value:g}' for value in size)}"].append(match)
    if 1 < len(objects) <= MOST_OBJECTS:
        by_tag |= objects
    for tag, of_these in by_tag.items():
        tp, fp, tn, fn, precision, recall = curve_arrays(of_these)
        writer.add_pr_curve_raw(f"precision_recall/{tag}", tp, fp, tn, fn, precision, recall, step, COLUMNS)
    curve = precision_recall_curve(matches)
    writer.add_figure("val/precision_recall", _drawn(curve.recall, curve.precision), step)


def curve_arrays(matches: Sequence[SceneMatch]) -> NDArray[np.float64]:
    """The exact precision-recall curve as TensorBoard's plugin takes it.

    Note:
        The plugin wants thresholds that rise from 0 to 1. Of scores only the order matters, so the columns
        are points of the curve, evenly spaced in rank: the first with every result, the last with none.
        Precision and recall are means over scenes, so they don't follow from the counts, which are sums.

    Returns:
        (6, 127) true, false positives, true (not defined, 0), false negatives, precision, recall.
    """
    curve = precision_recall_curve(matches)
    pick = np.linspace(len(curve.threshold) - 1, 0, COLUMNS).round().astype(int)
    used, place = np.unique(pick, return_inverse=True)
    joined = _joined(matches)
    true, false = np.array([_positives(joined, curve.threshold[i]) for i in used])[place].T
    to_find = int(joined.relevant.sum())
    return np.stack([true, false, 0 * true, to_find - true, curve.precision[pick], curve.recall[pick]])


def add_mesh(writer: SummaryWriter, part: ParametricPart, scene: Scene, found: Detections, step: int) -> None:
    """The scene's points, and the estimated parts as meshes, in metres, with y and z up.

    Where sizes are unknown, or make no solid (early in training), the axes of the pose stand for the part.
    """
    up = np.array([1.0, -1.0, -1.0])
    middle = scene.points.mean(0)
    writer.add_mesh("val/points", _batch((scene.points - middle) * up), config_dict=DOTS, global_step=step)
    pieces, first = [], 0
    for i in range(len(found.score)):
        vertices, faces, colours = _shape(part, found.parameters[i].numpy(), COLOURS[i % len(COLOURS)])
        if first + len(vertices) > MOST_VERTICES:
            break
        placed = vertices @ found.R[i].numpy().T + found.t[i].numpy()
        pieces.append(((placed - middle) * up, faces + first, colours))
        first += len(vertices)
    if pieces:
        vertices, faces, colours = (np.concatenate(column) for column in zip(*pieces, strict=True))
        writer.add_mesh(
            "val/estimates",
            _batch(vertices),
            torch.from_numpy(colours).to(torch.uint8)[None],
            torch.from_numpy(faces).int()[None],
            config_dict=CAMERA,
            global_step=step,
        )


@contextmanager
def _in_place_of_earlier(folder: Path, name: str) -> Iterator[SummaryWriter]:
    """A writer to an event file of this name; TensorBoard would keep the first of two, so earlier ones go."""
    earlier = list(folder.glob(f"events.*.{name}"))
    with SummaryWriter(str(folder), filename_suffix=f".{name}") as writer:
        yield writer
    for path in earlier:
        path.unlink()


def _session(
    chosen: Mapping[str, Setting], first: Collection[str], scores: Mapping[str, float | None]
) -> Iterator[Summary]:
    """The three summaries of the plugin: its columns, this run's settings, and that it has ended."""
    experiment = api_pb2.Experiment(
        hparam_infos=[_column(name, value, name in first) for name, value in chosen.items()],
        metric_infos=[
            api_pb2.MetricInfo(name=api_pb2.MetricName(tag=tag), display_name=tag.removeprefix("final/"))
            for tag in scores
        ],
    )
    start = SessionStartInfo()
    for name, value in chosen.items():
        setattr(start.hparams[name], f"{_kind(value)}_value", value)
    end = SessionEndInfo(status=api_pb2.STATUS_SUCCESS)
    yield _summary(metadata.EXPERIMENT_TAG, HParamsPluginData(experiment=experiment))
    yield _summary(metadata.SESSION_START_INFO_TAG, HParamsPluginData(session_start_info=start))
    yield _summary(metadata.SESSION_END_INFO_TAG, HParamsPluginData(session_end_info=end))


def _column(name: str, value: Setting, shown: bool) -> Any:
    """`differs` brings a column to the front; whether it does differ is known to no run alone."""
    kind = _kind(value)
    types = {"bool": "DATA_TYPE_BOOL", "number": "DATA_TYPE_FLOAT64", "string": "DATA_TYPE_STRING"}
    column = api_pb2.HParamInfo(name=name, type=types[kind], differs=shown)
    if kind == "bool":
        column.domain_discrete.extend([False, True])
    return column


def _kind(value: Setting) -> str:
    if isinstance(value, bool):  # before numbers: a bool is one
        return "bool"
    return "string" if isinstance(value, str) else "number"


def _summary(tag: str, data: HParamsPluginData) -> Summary:
    content = SummaryMetadata.FromString(metadata.create_summary_metadata(data).SerializeToString())
    return Summary(value=[Summary.Value(tag=tag, metadata=content, tensor=metadata.NULL_TENSOR)])


def _joined(matches: Sequence[SceneMatch]) -> SceneMatch:
    """One match of all scenes, their true poses numbered through: its counts are the scenes' sums."""
    before = np.cumsum([0] + [len(match.relevant) for match in matches])
    truth = [match.truth + first for match, first in zip(matches, before, strict=False)]
    rest = (torch.cat([getattr(m, name) for m in matches]) for name in ("distance", "matched", "relevant"))
    return SceneMatch(torch.cat([match.score for match in matches]), torch.cat(truth), *rest)


def _positives(match: SceneMatch, threshold: float) -> tuple[int, int]:
    """True and false positives when results with at least this score are the positives."""
    above = match.score >= threshold
    of_results = (match.score[above], match.truth[above], match.distance[above], match.matched[above])
    return count_positives([SceneMatch(*of_results, match.relevant)])


def _drawn(recall: Sequence[float] | NDArray[Any], precision: Sequence[float] | NDArray[Any]) -> "Figure":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4, 4), layout="tight")
    axes = figure.subplots()
    axes.step(recall, precision, where="pre")
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1.01), ylim=(0, 1.01))
    axes.grid(alpha=0.3)
    return figure


def _shape(part: ParametricPart, size: Points, colour: NDArray[np.float64]) -> Mesh:
    """Vertices, faces and a colour of each vertex, in the part frame. size: (k,) metres."""
    if np.isfinite(size).all() and (size > 0).all():
        try:
            mesh = part.mesh(size)
        except ValueError:  # the values make no solid
            return _axes(part)
        return np.asarray(mesh.vertices), np.asarray(mesh.faces), np.tile(colour, (len(mesh.vertices), 1))
    return _axes(part)


def _axes(part: ParametricPart) -> Mesh:
    """The axes x, y, z of a pose in red, green, blue, each a thin tetrahedron half as long as the part."""
    length = part.mesh(part.part_object("L", 0)).extents.max() / 2
    tip, base = length * np.eye(3), length / 10 * (np.eye(3) - 1 / 3)
    vertices = np.concatenate([np.stack([tip[i], *base]) for i in range(3)])
    corners = np.array([[1, 2, 3], [0, 1, 2], [0, 2, 3], [0, 3, 1]])
    return vertices, np.concatenate([corners + 4 * i for i in range(3)]), np.repeat(255 * np.eye(3), 4, 0)


def _batch(vertices: NDArray[Any]) -> Tensor:
    return torch.from_numpy(vertices).float()[None]
