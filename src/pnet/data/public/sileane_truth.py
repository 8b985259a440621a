"""The Siléane data set's `gt/*.json`: the true poses of one scene, and its segmentation's ids."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.json_files import read_json, read_numbers, read_rotation

Points = NDArray[np.float64]
OCCLUSION_TOLERANCE = 1e-3
HIGHEST_ID = 65535


@dataclass(frozen=True, eq=False)
class Truth:
    """What is true of a scene of d bodies.

    Attributes:
        ids: (d,) int64 value of the body's pixels in the segmentation.
        R: (d, 3, 3), t: (d, 3) object → world, metres.
        occlusion: (d,) 0 fully visible, 1 hidden.
    """

    ids: NDArray[np.int64]
    R: Points
    t: Points
    occlusion: Points


def read_truth(path: Path, most: int) -> Truth:
    """Read the truth of a scene.

    Args:
        path: of the JSON, a list of {R, t, segmentation_id, occlusion_rate}. most: bodies that can be there.
    Raises:
        FileNotFoundError, ValueError: names the file, the entry and the key.
    """
    entries = read_json(path)
    if not isinstance(entries, list):
        raise ValueError(f"{path}: holds a {type(entries).__name__}, expected a list of poses")
    if len(entries) > most:
        raise ValueError(f"{path}: has {len(entries)} entries, but the file's name says {most} bodies")
    rows = [_read_entry(entry, f"{path}: entry {i}") for i, entry in enumerate(entries)]
    return Truth(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows]).reshape(-1, 3, 3),
        np.array([row[2] for row in rows]).reshape(-1, 3),
        np.array([row[3] for row in rows], float),
    )


def _read_entry(entry: Any, where: str) -> tuple[int, Points, Points, float]:
    if not isinstance(entry, dict):
        raise ValueError(
            f"{where}: is a {type(entry).__name__}, expected {{R, t, segmentation_id, occlusion_rate}}"
        )
    number = float(read_numbers(entry, "segmentation_id", where, ()))
    if number % 1 or not 0 <= number <= HIGHEST_ID:
        raise ValueError(
            f"{where}: key 'segmentation_id' is {number:g}, expected a whole number, 0 to {HIGHEST_ID}"
        )
    rate = float(read_numbers(entry, "occlusion_rate", where, ()))
    if not -OCCLUSION_TOLERANCE <= rate <= 1 + OCCLUSION_TOLERANCE:
        raise ValueError(f"{where}: key 'occlusion_rate' is {rate:g}, expected 0 to 1")
    R, t = read_rotation(entry, "R", where), read_numbers(entry, "t", where, (3,))
    return int(number), R, t, min(max(rate, 0.0), 1.0)
