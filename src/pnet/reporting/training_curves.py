"""Curves of a training and of an evaluation."""

import math
from collections.abc import Sequence
from pathlib import Path

import plotly.graph_objects as go
from plotly.subplots import make_subplots

Scalars = dict[str, tuple[list[int], list[float]]]

_MOST_POINTS = 2000  # of a drawn curve: a report stays small however long the training was
_FAINT = "rgba(128,136,148,0.25)"
_PALETTE = ("#4c8dff", "#f2994a", "#27ae60", "#eb5a6d", "#9b6dff", "#2bb5c0", "#d4a72c", "#c86fb5")


def read_scalars(folder: Path) -> Scalars:
    """Scalars of all TensorBoard event files below a folder.

    Args:
        folder: need not exist.
    Returns:
        tag → steps, values; steps ascending, where several files hold a step the latest written counts.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    latest: dict[str, dict[int, tuple[float, float]]] = {}
    for path in sorted(folder.rglob("*tfevents*")):
        events = EventAccumulator(str(path), size_guidance={"scalars": 0})
        events.Reload()
        for tag in events.Tags()["scalars"]:
            steps = latest.setdefault(tag, {})
            for event in events.Scalars(tag):
                written = (event.wall_time, event.value)
                steps[event.step] = max(steps.get(event.step, written), written, key=_wall_time)
    return {tag: _by_step(steps) for tag, steps in latest.items()}


def curve_figure(precision: Sequence[float], recall: Sequence[float], ap: float | None) -> go.Figure:
    """Precision over recall.

    Args:
        precision, recall: (k) points of the curve, recall ascending; may be empty.
        ap: the area under it as steps, or None.
    """
    known = ap is not None and math.isfinite(ap)
    figure = go.Figure(
        layout=_layout(f"Precision and recall (AP {ap:.3f})" if known else "Precision and recall")
    )
    figure.add_scatter(
        x=list(recall),
        y=list(precision),
        mode="lines",
        line={"shape": "vh", "width": 2.5, "color": _PALETTE[0]},
        fill="tozeroy",
        fillcolor="rgba(76,141,255,0.15)",
        hovertemplate="recall %{x:.3f}<br>precision %{y:.3f}<extra></extra>",
    )
    figure.update_xaxes(title="recall: share of the bodies found", range=[0, 1.02])
    figure.update_yaxes(title="precision: share of the results right", range=[0, 1.02])
    return figure


def training_figure(scalars: Scalars) -> go.Figure | None:
    """Losses of the modules, validation AP and learning rate over the steps.

    Args:
        scalars: as `read_scalars` gives them; what is missing is left out.
    Returns:
        The figure, or None where there is nothing of that.
    """
    panels = {title: tags for title, tags in _panels(scalars).items() if tags}
    if not panels:
        return None
    heights = [3.0 if "loss" in title else 1.2 for title in panels]
    figure = make_subplots(rows=len(panels), shared_xaxes=True, vertical_spacing=0.07, row_heights=heights)
    names = list(dict.fromkeys(_module(tag) for tags in panels.values() for tag in tags))
    for row, (title, tags) in enumerate(panels.items(), 1):
        for tag in tags:
            figure.add_trace(_line(tag, scalars[tag], names.index(_module(tag))), row=row, col=1)
        figure.update_yaxes(title=title, row=row, col=1)
        if "log" in title:
            figure.update_yaxes(type="log", dtick=1, row=row, col=1)
    figure.update_layout(_layout("Training"))
    figure.update_xaxes(title="step", row=len(panels), col=1)
    return figure


def _panels(scalars: Scalars) -> dict[str, list[str]]:
    tags = sorted(scalars)
    return {
        "loss (log)": [tag for tag in tags if tag.split("/")[0].endswith("_loss") or tag.endswith("/loss")],
        "validation AP": [tag for tag in tags if tag in ("val/AP", "val/mAP")],
        "learning rate": [tag for tag in tags if tag.split("/")[0].startswith("lr")],
    }


def _line(tag: str, scalar: tuple[list[int], list[float]], colour: int) -> go.Scatter:
    """Validation is dotted and has marks; a module has the same colour in both."""
    stride = max(1, math.ceil(len(scalar[0]) / _MOST_POINTS))
    steps, values = scalar[0][::stride], scalar[1][::stride]
    validation, name = tag.startswith("val"), _module(tag)
    return go.Scatter(
        x=steps,
        y=values,
        name=f"{name}, validation" if validation else name,
        mode="lines+markers" if validation else "lines",
        line={
            "color": _PALETTE[colour % len(_PALETTE)],
            "width": 1.5 if validation else 2,
            "dash": "dot" if validation else "solid",
        },
        hovertemplate="step %{x}: %{y:.4g}",
    )


def _module(tag: str) -> str:
    name = tag.split("/")[-1]
    return {"loss": "total loss"}.get(name, "learning rate" if name.startswith("lr") else name)


def _by_step(steps: dict[int, tuple[float, float]]) -> tuple[list[int], list[float]]:
    order = sorted(steps)
    return order, [steps[step][1] for step in order]


def _wall_time(written: tuple[float, float]) -> float:
    return written[0]


def _layout(title: str) -> go.Layout:
    """A quiet look that suits a light and a dark page."""
    axis = {"gridcolor": _FAINT, "zeroline": False, "linecolor": _FAINT, "showline": True}
    template = go.layout.Template(
        layout={
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
            "font": {"family": "system-ui, sans-serif", "color": "#808894"},
            "xaxis": axis,
            "yaxis": axis,
        }
    )
    return go.Layout(
        title={"text": title, "font": {"size": 16}, "x": 0.01, "xanchor": "left"},
        template=template,
        margin={"l": 64, "r": 16, "t": 48, "b": 48},
        legend={"font": {"size": 11}},
        hovermode="closest",
    )
