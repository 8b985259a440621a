"""The model card of trained weights: a page of Markdown out of what their bundle says of itself.

What a bundle does not say has no line on the card; nothing is added that does not follow from it.
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.reporting.card_data import class_name, data_limits, data_rows, learnt_sizes, plan_of
from pnet.reporting.prediction_page import camera_text
from pnet.reporting.tables import metric_row

TITLE = "# Model card: "  # what a card begins with
_FIGURES = ("scenes", "truths_to_find", "mAP", "AP", "recall_at_precision_99", "position_error_mm",
            "axis_error_deg", "parameter_error_mm")  # fmt: skip
_UNTOLD = (AttributeError, LookupError, TypeError, ValueError, OverflowError, ZeroDivisionError)

Rows = Sequence[tuple[str, Any]]


@dataclass(frozen=True, eq=False)
class CardContent:
    """What a card is made of.

    Attributes:
        file: the bundle's name. digest: SHA-256 of the file. size: in bytes. licence: of the weights.
        part: the template. settings, about: the bundle's own. points: N of a scene in the training.
        camera: of images where none is given with them, or None. weights: how many numbers the file holds.
    """

    file: str
    digest: str
    size: int
    licence: str
    part: ParametricPart
    settings: Mapping[str, Any]
    about: Mapping[str, Any]
    points: int
    camera: Camera | None
    weights: int


def model_card(content: CardContent) -> str:
    """The card.

    Raises:
        ValueError: where the bundle tells of its training otherwise than pnet writes it.
    """
    try:
        sections = (
            _head(content),
            _section("What it finds", _sizes(content)),
            _section("Network", _facts(_network(content))),
            _section("Training data", _facts(data_rows(content.about, content.part.name))),
            _section("Training", _facts(_training(content.about))),
            _section("Figures", _figures(content.about, content.part.name)),
            _section("Use", _use(content)),
            _section("Limits", "\n".join(f"- {limit}" for limit in _limits(content))),
            _section("Licence", f"{content.licence}."),
        )
        return "\n\n".join(filter(None, sections)) + "\n"
    except _UNTOLD as fault:
        raise ValueError(
            f"{content.file}: what it says of its training is not as pnet writes it "
            f"({type(fault).__name__}: {fault}); export it again from its run"
        ) from fault


def _head(content: CardContent) -> str:
    """What it is, and the file."""
    name = content.part.name.upper()
    model = content.settings.get("model") or {}
    unsaid = content.part.is_fixed or str(model.get("_target_")).endswith(".PPRNet")
    sizes = "" if unsaid else ", its parameters"
    return (
        f"{TITLE}{name}\n\n"
        f"`{content.file}` finds every instance of the part template {name} in the depth image or point "
        f"cloud of a bin: its 6DoF pose{sizes} and a score. {_description(content.part)}\n\n"
        "This page is written by `pnet-export card=true` out of the file itself.\n\n"
        + _facts((("file", f"`{content.file}`, {content.size:,} bytes"), ("SHA-256", f"`{content.digest}`")))
    )


def _description(part: ParametricPart) -> str:
    """What the part's module and class say of it; nothing of classes that read many parts from files."""
    kind = type(part)
    if "name" not in vars(kind):
        return ""
    docs = (sys.modules[kind.__module__].__doc__, kind.__doc__)
    module, own = ((text or "").strip().split("\n")[0] for text in docs)
    title, colon, rest = module.partition(": ")
    told = rest[:1].upper() + rest[1:] if colon and title.lower() == part.name else ""
    return " ".join(filter(None, (told, own)))


def _sizes(content: CardContent) -> str:
    """The template's parameters with the values of its grids."""
    part, grids = content.part, content.part.grids
    heads = {"L": "grid L, for training, mm", "G": "grid G, for tests alone, mm"}
    columns = [heads[name] for name in grids]
    rows = [
        (name, *(", ".join(_mm(value) for value in np.unique(grid[:, i])) for grid in grids.values()))
        for i, name in enumerate(part.parameter_names)
    ]
    seen = learnt_sizes(content.about, part.name, len(grids["L"]))
    return "\n\n".join(filter(None, (_table(("parameter", *columns), rows), seen)))


def _network(content: CardContent) -> Rows:
    settings, network = content.settings, content.about.get("network", {})
    voting = settings["postprocess"].get("voting")
    return (
        ("method", settings["method"].get("name")),
        ("backbone", class_name(settings["backbone"])),
        ("learnt parameters", _number(network.get("parameters"))),
        ("numbers in the file", f"{content.weights:,}"),
        ("points of a scene", f"{content.points:,}"),
        ("multiply-adds of a scene", _number(network.get("operations"))),
        ("post-processing", class_name(settings["postprocess"])),
        ("votes", class_name(voting)),
        ("refinement", class_name(settings["postprocess"].get("refine"))),
    )


def _training(about: Mapping[str, Any]) -> Rows:
    steps, settings = about.get("steps"), about.get("training", {})
    batch, seconds = settings.get("data.batch_size"), about.get("training_seconds")
    batch = batch and batch * (settings.get("trainer.devices") or 1)
    packages = about.get("packages", {})
    named = (f"{name} {packages[name]}" for name in ("pnet", "torch", "lightning") if name in packages)
    return (
        ("steps", _number(steps)),
        ("scenes in a step", _number(batch)),
        ("scenes drawn in all", None if None in (steps, batch) else f"{steps * batch:,}"),
        ("time", None if seconds is None else f"{seconds:,.0f} s"),
        ("device", about.get("device")),
        ("threads", about.get("threads")),
        ("machine", about.get("machine")),
        ("precision", about.get("precision") or settings.get("trainer.precision")),
        ("seed", about.get("seed")),
        ("commit", ", ".join(about.get("commits", []))),
        ("packages", ", ".join(named)),
    )


def _figures(about: Mapping[str, Any], part: str) -> str:
    """A table of the evaluations; without one, of the validation in the training. part: its name."""
    measured: Mapping[str, Any] = about.get("evaluations") or {}
    if not measured and not about.get("validation"):
        return ""
    intro = (
        "By `pnet-evaluate`, on piles that training never saw. To be found are the bodies of which at least "
        "half can be seen; errors are means over the bodies found."
    )
    if not measured:
        measured = {"val": about["validation"]}
        intro = "From the last validation in the training; there is no evaluation."
    names = sorted(measured, key=lambda name: (name != "test_l", name))
    rows = [
        (metric_row(key, None)[0], *(metric_row(key, measured[name].get(key))[1] for name in names))
        for key in _figure_keys(measured)
    ]
    splits = plan_of(about, part).get("splits", {})
    grids = ", ".join(
        f"{name} shows sizes of grid {splits[name]['grid']}" for name in names if name in splits
    )
    return "\n\n".join((intro + (f" Here {grids}." if grids else ""), _table(("", *names), rows)))


def _figure_keys(measured: Mapping[str, Any]) -> list[str]:
    """The metrics on a card: a fixed list, then the errors of single parameters."""
    found = {key for metrics in measured.values() for key in metrics if key.startswith("parameter_error")}
    return [*_FIGURES, *sorted(found.difference(_FIGURES))]


def _use(content: CardContent) -> str:
    file, part, camera = content.file, content.part.name, content.camera
    text = (
        f"```\npnet-predict run={file} input=bin.png camera=camera.json\n```\n\n"
        "```python\nfrom pnet import Estimator\n\n"
        f'found = Estimator.load("{file}").estimate(depth, camera)\n'
        "```\n\n"
    )
    if file.rpartition(".")[0] == part:
        text += (
            f'For the file that comes with pnet `part={part}` and `Estimator.pretrained("{part}")` say the '
            "same.\n"
        )
    if camera is not None:
        text += f"Without a camera: {camera_text(camera)}.\n"
    return text + "docs/predict.md says what else it has to know."


def _limits(content: CardContent) -> Iterator[str]:
    """What follows from the settings."""
    yield from data_limits(content.about, content.part.name)
    part, grid = content.part, content.part.grids["L"]
    if not part.is_fixed:
        low, high = grid.min(0), grid.max(0)
        spans = (
            f"{n} {_mm(a)} to {_mm(b)} mm" for n, a, b in zip(part.parameter_names, low, high, strict=True)
        )
        yield f"Sizes outside of {', '.join(spans)} were not in the training."
        if content.settings["postprocess"].get("scene_parameters"):
            yield (
                "All parts in an image are taken to be of one size; `+postprocess.scene_parameters=false` "
                "takes each by itself."
            )


def _mm(metres: float) -> str:
    return f"{1000 * metres:g}"


def _number(value: Any) -> str | None:
    return None if value is None or not math.isfinite(value) else f"{value:,}"


def _section(title: str, text: str) -> str:
    return f"## {title}\n\n{text}" if text else ""


def _facts(rows: Rows) -> str:
    """A table of names and values, without those that nobody knows."""
    known = [(name, str(value)) for name, value in rows if value is not None and value != ""]
    return _table(("", ""), known) if known else ""


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())
