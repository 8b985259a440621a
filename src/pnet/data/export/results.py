"""Detections as results files of the Siléane and the BOP benchmark."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import torch

from pnet.data.export.files import Advance, write_json
from pnet.records import Detections
from pnet.scenes.record_file import remove_left_overs, write_atomically

BOP_HEADER = "scene_id,im_id,obj_id,score,R,t,time"
UNKNOWN_TIME = -1.0


def write_sileane_results(
    folder: Path,
    names: Sequence[str],
    detections: Sequence[Detections],
    parameter_names: Sequence[str],
    advance: Advance = lambda scenes: None,
) -> None:
    """Write a JSON for every scene: a list of R, t, score, in the world frame, metres, best score first.

    Each entry has our own key "parameters", too: by name, metres; NaN is left out.

    Args:
        folder: made where missing. names: the scenes', see `sileane_name`; their world is the camera frame.
        detections: of each scene. parameter_names: (k) the template's.
        advance: called with the number of scenes done, after each.
    Raises:
        ValueError: names and detections are not as many, a name comes twice or is no file name, or a pose or
            score is not finite.
    """
    if len(names) != len(detections) or len(set(names)) < len(names):
        raise ValueError(
            f"{folder}: {len(detections)} scenes with {len(set(names))} different names, expected one each"
        )
    folder.mkdir(parents=True, exist_ok=True)
    remove_left_overs(folder)
    for name, found in zip(names, detections, strict=True):
        if Path(name).name != name:
            raise ValueError(f"{folder}: {name!r} is no name of a scene, it has to be one of a file")
        _check_finite(found, str(folder / f"{name}.json"))
        write_json(folder / f"{name}.json", list(_entries(found, parameter_names)))
        advance(1)


@dataclass(frozen=True, eq=False)
class BopImage:
    """What was found in one image.

    Attributes:
        scene_id, im_id, obj_id: see `bop_scene_id`, `SceneId.drop`, `bop_object_id`.
        found: the detections, all of that object. seconds: that the image took; −1: unknown.
    """

    scene_id: int
    im_id: int
    obj_id: int
    found: Detections
    seconds: float = UNKNOWN_TIME


def write_bop_results(path: Path, images: Iterable[BopImage]) -> None:
    """Write a CSV with a row for every detection: R row by row, t in millimetres, with all their digits.

    Args:
        path: its folder is made where missing; the benchmark wants a name like METHOD_DATASET-test.csv.
        images: in any order; those of one image must agree in their seconds.
    Raises:
        ValueError: they do not, or a time, a pose or a score is no proper number.
    """
    rows, times = [BOP_HEADER], dict[tuple[int, int], float]()
    for image in images:
        key, where = (image.scene_id, image.im_id), f"{path}: scene {image.scene_id}, image {image.im_id}"
        if not (image.seconds == UNKNOWN_TIME or 0 <= image.seconds < float("inf")):
            raise ValueError(f"{where}: the time is {image.seconds} s, expected 0 or more, or -1 for unknown")
        if times.setdefault(key, image.seconds) != image.seconds:
            raise ValueError(
                f"{where}: took {times[key]} s and {image.seconds} s, expected one time an image"
            )
        _check_finite(image.found, where)
        rows += _rows(image)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, ("\n".join(rows) + "\n").encode())


def _entries(found: Detections, parameter_names: Sequence[str]) -> Iterator[dict[str, Any]]:
    for R, t, score, parameters in zip(
        *(x.cpu().double().tolist() for x in (found.R, found.t, found.score, found.parameters)), strict=True
    ):
        named = zip(parameter_names, parameters, strict=True)
        known = {name: value for name, value in named if isfinite(value)}
        yield {"R": R, "t": t, "score": score, "parameters": known}


def _rows(image: BopImage) -> Iterator[str]:
    found = image.found
    R, t = found.R.cpu().double().flatten(1).tolist(), (1000 * found.t.cpu().double()).tolist()
    for score, *pose in zip(found.score.cpu().double().tolist(), R, t, strict=True):
        fields = (image.scene_id, image.im_id, image.obj_id, score, *(" ".join(map(repr, x)) for x in pose))
        yield ",".join(map(str, (*fields, image.seconds)))


def _check_finite(found: Detections, where: str) -> None:
    for name, values in (("R", found.R), ("t", found.t), ("score", found.score)):
        if not bool(torch.isfinite(values).all()):
            raise ValueError(f"{where}: key {name!r} of a detection is NaN or infinite")
