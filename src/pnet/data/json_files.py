"""JSON from elsewhere: every value is checked, every error names the file and the key."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROTATION_TOLERANCE = 1e-3


def read_json(path: Path) -> Any:
    """Parse a file; ValueError names it."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not valid JSON: {error}") from error


def read_object(path: Path) -> dict[str, Any]:
    """Parse a file that holds an object; ValueError names it."""
    fields = read_json(path)
    if not isinstance(fields, dict):
        raise ValueError(f"{path}: holds a {type(fields).__name__}, expected an object")
    return fields


def read_numbers(
    fields: dict[str, Any], key: str, where: str, *shapes: tuple[int, ...]
) -> NDArray[np.float64]:
    """Finite numbers out of a JSON object.

    Args:
        where: file and entry, for the error.
        shapes: those allowed; −1 stands for any length.
    """
    if key not in fields:
        raise ValueError(f"{where}: key {key!r} is missing")
    expected = " or ".join(map(str, shapes)).replace("-1", "n")
    try:
        value = np.asarray(fields[key])
    except ValueError:
        raise ValueError(f"{where}: key {key!r} is ragged, expected shape {expected}") from None
    if value.dtype.kind not in "iuf":
        raise ValueError(f"{where}: key {key!r} does not hold numbers of shape {expected}")
    if not any(_fits(value.shape, shape) for shape in shapes):
        raise ValueError(f"{where}: key {key!r} has shape {value.shape}, expected {expected}")
    if not np.isfinite(value).all():
        raise ValueError(f"{where}: key {key!r} holds NaN or infinity")
    return value.astype(np.float64)


def read_rotation(fields: dict[str, Any], key: str, where: str) -> NDArray[np.float64]:
    """A (3, 3) rotation out of a JSON object."""
    R = read_numbers(fields, key, where, (3, 3))
    check_rotations(R, key, where)
    return R


def _fits(shape: tuple[int, ...], pattern: tuple[int, ...]) -> bool:
    return len(shape) == len(pattern) and all(p in (-1, n) for n, p in zip(shape, pattern, strict=True))


def check_rotations(R: NDArray[np.float64], key: str, where: str) -> None:
    """Raise ValueError where R (..., 3, 3) are no rotations. key, where: for the error."""
    gap = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max()
    if gap > ROTATION_TOLERANCE or (np.linalg.det(R) < 0).any():
        raise ValueError(
            f"{where}: key {key!r} is not a rotation (R Rᵀ is off the identity by {gap:.2g}, "
            f"smallest determinant {np.linalg.det(R).min():.2g})"
        )
