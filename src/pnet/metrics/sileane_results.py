"""Scores a folder of results in the public benchmark's format against its ground truth.

Both folders hold one JSON a scene, paired by file name: the truth a list of {R, t, segmentation_id,
occlusion_rate}, the results a list of {R, t, score}. Poses are object → world, metres.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnet.data.json_files import read_json, read_numbers, read_rotation
from pnet.data.poseutils import read_poseutils
from pnet.metrics.average_precision import (
    average_precision,
    best_f1,
    mean_average_precision,
    precision_recall_curve,
)
from pnet.metrics.matching import ScoredPoses, TruePoses, match_scene


def score_folder(truth: Path, results: Path, poseutils: Path) -> dict[str, float]:
    """AP, MAP and best F1 of a results folder.

    Args:
        truth: the `gt` folder, or the object's folder that contains it.
        results: folder of results; a scene without a file counts as found nothing.
        poseutils: the object's `poseutils.json`.
    """
    space = read_poseutils(poseutils)
    matches = [match_scene(space, *scene) for scene in read_scenes(truth, results).values()]
    curve = precision_recall_curve(matches)
    return {
        "AP": average_precision(curve),
        "MAP": mean_average_precision(matches),
        "F1": best_f1(curve),
    }


def read_scenes(truth: Path, results: Path) -> dict[str, tuple[TruePoses, ScoredPoses]]:
    """Pair the two folders: file name → true poses and results, in the names' order."""
    truth_files, result_files = _truth_files(truth), _result_files(results)
    strangers = sorted(set(result_files) - set(truth_files))
    if strangers:
        raise ValueError(
            f"{result_files[strangers[0]]}: no ground truth of this name in {truth} "
            f"({len(strangers)} such files of {len(result_files)})"
        )
    return {
        name: (read_truth(path), _read_results_or_none(result_files.get(name)))
        for name, path in truth_files.items()
    }


def read_truth(path: Path) -> TruePoses:
    """Read the true poses of one scene."""
    return TruePoses(*map(torch.from_numpy, _read_poses(path, "occlusion_rate")))


def read_results(path: Path) -> ScoredPoses:
    """Read the results of one scene."""
    return ScoredPoses(*map(torch.from_numpy, _read_poses(path, "score")))


def _read_results_or_none(path: Path | None) -> ScoredPoses:
    if path is not None:
        return read_results(path)
    return ScoredPoses(torch.empty(0, 3, 3), torch.empty(0, 3), torch.empty(0))


def _truth_files(folder: Path) -> Mapping[str, Path]:
    folder = folder / "gt" if (folder / "gt").is_dir() else folder
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder of ground truth")
    files = _json_files(folder)
    if not files:
        raise ValueError(f"{folder}: holds no .json, expected one ground truth file a scene")
    return files


def _result_files(folder: Path) -> Mapping[str, Path]:
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder of results; an empty one means found nothing")
    return _json_files(folder)


def _json_files(folder: Path) -> dict[str, Path]:
    return {path.name: path for path in sorted(folder.glob("*.json")) if path.is_file()}


def _read_poses(path: Path, key: str) -> tuple[NDArray[np.float64], ...]:
    """R (n, 3, 3), t (n, 3) metres and one number (n,) per entry of a list of poses."""
    entries = read_json(path)
    if not isinstance(entries, list):
        raise ValueError(f"{path}: holds a {type(entries).__name__}, expected a list of poses")
    poses = [_read_entry(entry, key, f"{path}: entry {i}") for i, entry in enumerate(entries)]
    if not poses:
        return np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0)
    return tuple(np.stack(column) for column in zip(*poses, strict=True))


def _read_entry(entry: Any, key: str, where: str) -> tuple[NDArray[np.float64], ...]:
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: is a {type(entry).__name__}, expected an object with R, t, {key}")
    return (
        read_rotation(entry, "R", where),
        read_numbers(entry, "t", where, (3,)),
        read_numbers(entry, key, where, ()),
    )
