"""A trained network in one file: weights, settings, camera and the part's mesh, for another machine.

It is a safetensors file (nothing in it is ever run) whose single metadata entry is a JSON header.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from pnet.data.images import MOST_PIXELS
from pnet.data.public.checks import MOST_POINTS
from pnet.geometry.camera import Camera
from pnet.scenes.record_file import write_atomically

FORMAT, VERSION = "pnet-bundle", 1
SUFFIXES = (".pnet", ".safetensors")  # of a bundle's file
_WEIGHT, _FILE = "weight/", "file/"  # what a tensor's name begins with


@dataclass(frozen=True, eq=False)
class Bundle:
    """What a bundle holds.

    Attributes:
        settings: plain settings of the training that prediction needs. weights: of the network, by name.
        points: N of a scene in the training. camera: of the training's scenes, None where nobody knows it.
        files: by name, what the settings refer to (a CAD part's mesh). about: where the weights come from.
    """

    settings: dict[str, Any]
    weights: dict[str, Tensor]
    points: int
    camera: Camera | None
    files: Mapping[str, bytes] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)


def write_bundle(path: Path, bundle: Bundle) -> None:
    """Write a bundle; equal ones give equal bytes, and nothing half-written stays."""
    tensors = {_WEIGHT + name: weight.detach().cpu().contiguous() for name, weight in bundle.weights.items()}
    for name, content in bundle.files.items():
        tensors[_FILE + name] = torch.frombuffer(bytearray(content), dtype=torch.uint8)
    header = {
        "version": VERSION,
        "settings": bundle.settings,
        "points": bundle.points,
        "camera": None if bundle.camera is None else asdict(bundle.camera),
        "about": dict(bundle.about),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save(tensors, {FORMAT: json.dumps(header, sort_keys=True)}))


def read_bundle(path: Path) -> Bundle:
    """Read a bundle.

    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such bundle; pnet-export run=… output={path} writes one")
    try:
        with safe_open(path, framework="pt") as file:
            header: dict[str, Any] = json.loads((file.metadata() or {})[FORMAT])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if header["version"] != VERSION:
            raise ValueError(f"it has version {header['version']}, this pnet reads {VERSION}")
        camera, points = header["camera"], header["points"]
        if type(points) is not int or not 1 <= points <= MOST_POINTS:
            raise ValueError(f"its number of points is {points!r}, expected 1 to {MOST_POINTS:,}")
        if camera is not None and int(camera.get("width", 1)) * int(camera.get("height", 1)) > MOST_PIXELS:
            raise ValueError(f"its camera has {camera['width']} x {camera['height']} pixels")
        if "${" in json.dumps(header["settings"]):  # they were resolved when it was written
            raise ValueError("its settings refer to others")
        for name, weight in _named(tensors, _WEIGHT).items():
            if not bool(torch.isfinite(weight).all()):
                raise ValueError(f"weight {name} is NaN or infinite")
        return Bundle(
            settings=dict(header["settings"]),
            weights=_named(tensors, _WEIGHT),
            points=points,
            camera=None if camera is None else Camera(**camera),
            files={name: value.numpy().tobytes() for name, value in _named(tensors, _FILE).items()},
            about=dict(header["about"]),
        )
    except (SafetensorError, LookupError, TypeError, ValueError, OSError, RecursionError) as fault:
        raise ValueError(
            f"{path}: not a bundle that this pnet reads ({' '.join(str(fault).split())}); export it again"
        ) from fault


def _named(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
