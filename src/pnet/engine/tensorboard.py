"""What TensorBoard shows of a run beside its scalars."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from pnet.engine.evaluation import SceneScorer
from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene

COLOURS = 255 * np.array(
    [[0.12, 0.47, 0.71], [1, 0.5, 0.05], [0.17, 0.63, 0.17], [0.84, 0.15, 0.16], [0.58, 0.4, 0.74]]
)


def log_hyperparameters(folder: Path, chosen: dict[str, Any], scores: dict[str, float]) -> None:
    """Put a run on the page that compares runs by their settings and final scores.

    Args:
        folder: of the run's event files. chosen: settings, plain values. scores: by tag.
    """
    with SummaryWriter(str(folder)) as writer:
        assert writer.file_writer is not None
        for summary in hparams(chosen, scores):
            writer.file_writer.add_summary(summary)
        for tag, value in scores.items():
            writer.add_scalar(tag, value)


def add_settings(writer: SummaryWriter, settings: str) -> None:
    """The run's whole config, as text."""
    writer.add_text("settings", "```yaml\n" + settings + "```")


def add_curve(writer: SummaryWriter, scorer: SceneScorer, step: int) -> None:
    """Precision over recall, as a picture."""
    from matplotlib.figure import Figure

    curve = scorer.metrics.curve()
    figure = Figure(figsize=(4, 4), layout="tight")
    axes = figure.subplots()
    axes.step(curve.recall, curve.precision, where="pre")
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1.01), ylim=(0, 1.01))
    axes.grid(alpha=0.3)
    writer.add_figure("val/precision_recall", figure, step)


def add_mesh(writer: SummaryWriter, part: ParametricPart, scene: Scene, found: Detections, step: int) -> None:
    """The scene's points, and the estimated parts as meshes, in metres, with y and z up."""
    up = np.array([1.0, -1.0, -1.0])
    middle = scene.points.mean(0)
    writer.add_mesh("val/points", _batch((scene.points - middle) * up), global_step=step)
    vertices, faces, colours, first = [], [], [], 0
    for i in range(len(found.score)):
        size = found.parameters[i].numpy()
        if not (np.isfinite(size).all() and (size > 0).all()):
            continue  # early in training a vote can make no solid
        try:
            mesh = part.mesh(size)
        except ValueError:
            continue
        placed = np.asarray(mesh.vertices) @ found.R[i].numpy().T + found.t[i].numpy()
        vertices.append((placed - middle) * up)
        faces.append(np.asarray(mesh.faces) + first)
        colours.append(np.tile(COLOURS[i % len(COLOURS)], (len(placed), 1)))
        first += len(placed)
    if vertices:
        writer.add_mesh(
            "val/estimates",
            _batch(np.concatenate(vertices)),
            torch.from_numpy(np.concatenate(colours)).to(torch.uint8)[None],
            torch.from_numpy(np.concatenate(faces)).int()[None],
            global_step=step,
        )


def _batch(vertices: np.ndarray) -> Tensor:
    return torch.from_numpy(vertices).float()[None]
