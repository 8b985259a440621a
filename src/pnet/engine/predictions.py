"""Predictions of a split in one file: the first of evaluation's two steps."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from pnet.records import Detections
from pnet.scenes.record_file import write_atomically

FORMAT = "pnet-predictions"
VERSION = 1
_ROWS = ("R", "t", "parameters", "score", "keypoints")


@dataclass(frozen=True)
class PredictionHeader:
    """What predictions belong to.

    Attributes:
        part: the template's name. split: of the data. data: fingerprint of the data set.
        weights: digest of the checkpoint. recovery: digest of the post-processing's settings.
        scenes: the scenes' ids. seconds: "network" and "postprocess", per scene.
    """

    part: str
    split: str
    data: str
    weights: str
    recovery: str
    scenes: list[str]
    seconds: dict[str, float]


def write_predictions(path: Path, header: PredictionHeader, found: list[Detections]) -> None:
    """Write the detections of every scene; the file appears when it is whole."""
    rows = torch.tensor([0, *(len(d.score) for d in found)]).cumsum(0)
    points = torch.tensor([0, *(len(d.instance) for d in found)]).cumsum(0)
    tensors = {name: torch.cat([getattr(d, name) for d in found]).contiguous() for name in _ROWS}
    tensors["instance"] = torch.cat([d.instance for d in found]).to(torch.int16)
    content = {"format": FORMAT, "version": VERSION, **vars(header)}
    whole = save({**tensors, "first_row": rows, "first_point": points}, {FORMAT: json.dumps(content)})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, whole)


def read_predictions(path: Path) -> tuple[PredictionHeader, list[Detections]]:
    """Read what `write_predictions` wrote.

    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
    """
    try:
        with safe_open(path, framework="pt") as file:
            content: dict[str, Any] = json.loads((file.metadata() or {})[FORMAT])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if content["version"] > VERSION:  # before its fields, which may be others
            raise ValueError(f"{path}: written by a newer pnet; update pnet or predict again")
        header = PredictionHeader(**{key: content[key] for key in PredictionHeader.__dataclass_fields__})
        return header, _split(tensors)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no predictions there; run pnet-evaluate first") from None
    except (SafetensorError, KeyError, TypeError, json.JSONDecodeError, OSError) as fault:
        raise ValueError(f"{path}: not a whole prediction file ({fault}); predict again") from fault


def _split(tensors: dict[str, Tensor]) -> list[Detections]:
    rows, points = tensors["first_row"].tolist(), tensors["first_point"].tolist()
    found = []
    for i in range(len(rows) - 1):
        values = {name: tensors[name][rows[i] : rows[i + 1]] for name in _ROWS}
        instance = tensors["instance"][points[i] : points[i + 1]].long()
        found.append(Detections(**values, instance=instance))
    return found
