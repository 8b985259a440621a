"""Cameras from elsewhere: pnet's own files, and those of four common layouts, known by their keys."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.images import MOST_PIXELS
from pnet.data.json_files import read_json, read_numbers
from pnet.geometry.camera import Camera

MOST_BYTES = 100_000  # a camera takes a thousand; YAML takes its time
ENDINGS = (".json", ".yaml", ".yml", ".txt")
LAYOUTS = (
    "width height fx fy cx cy (pnet, BOP); width height fu fv cu cv (Siléane); "
    "image_width image_height camera_matrix (ROS); width height intrinsic_matrix (Open3D)"
)
_NEAR, _FAR = 0.1, 10.0  # metres, where a file says nothing
_MOST_FOCAL = 1_000_000  # pixels
_SILEANE = {"fx": "fu", "fy": "fv", "cx": "cu", "cy": "cv", "near": "clip_start", "far": "clip_end"}
_ROS = {"width": "image_width", "height": "image_height"}

Fields = dict[str, Any]


@dataclass(frozen=True)
class CameraFile:
    """A camera as it was read.

    Attributes:
        camera: the view.
        depth_scale: millimetres per unit of its depth images, as BOP's camera.json says; None: not said.
        distorted: the file has coefficients of a lens distortion other than 0. A `Camera` knows none: its
            images must be rectified.
        depth_offset: metres that are added to a depth image's number times `depth_scale`.
    """

    camera: Camera
    depth_scale: float | None = None
    distorted: bool = False
    depth_offset: float = 0.0


def read_camera(path: Path) -> CameraFile:
    """A camera file of any layout of `LAYOUTS`.

    Args:
        path: .json, .yaml or .yml, or .txt with a key and its values in each line (# starts a comment).
    Returns:
        The camera; near and far are 0.1 and 10 m where the file says nothing of them. Keys that mean nothing
        here are left out.
    Raises:
        FileNotFoundError, ValueError: names the file, the key and the fault.
    """
    fields, where = _read_fields(path), str(path)
    if "camera_matrix" in fields:
        return _ros_camera(fields, where)
    if "intrinsic_matrix" in fields:
        matrix = read_numbers(fields, "intrinsic_matrix", where, (9,)).reshape(3, 3).T  # column by column
        _check_matrix(matrix, "intrinsic_matrix", where, "column by column")
        return CameraFile(_camera(fields | _named(matrix), where))
    if "fu" in fields:
        return _sileane_camera(fields, where)
    if "fx" in fields:
        return CameraFile(_camera(fields, where), _depth_scale(fields, where))
    found = ", ".join(sorted(map(str, fields)))[:200] or "none"
    raise ValueError(f"{path}: holds no camera that is known here; keys found: {found}; expected {LAYOUTS}")


def _read_fields(path: Path) -> Fields:
    """What the file says, by its keys."""
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"{path}: ends in {path.suffix or 'nothing'}, expected one of {', '.join(ENDINGS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such camera file")
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path}: has {path.stat().st_size:,} bytes, expected {MOST_BYTES:,} at most")
    match path.suffix.lower():
        case ".json":
            fields = read_json(path)
        case ".txt":
            fields = _read_lines(path)
        case _:
            fields = _read_yaml(path)
    if not isinstance(fields, dict):
        raise ValueError(f"{path}: holds a {type(fields).__name__}, expected keys and values")
    return fields


def _read_yaml(path: Path) -> Any:
    import yaml  # type: ignore[import-untyped]

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Plain values, each written out: a short file of aliases could stand for billions of numbers."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError("has an alias (*), expected every value written out")
            return super().compose_node(parent, index)

    try:
        return yaml.load(path.read_text(encoding="utf-8"), Loader)
    except Exception as fault:  # of odd tags the loader raises whatever Python raises
        told = " ".join(str(fault).split())[:200]
        raise ValueError(f"{path}: is not valid YAML: {told or type(fault).__name__}") from None


def _read_lines(path: Path) -> Fields:
    """A key and its values in each line; values that are no numbers belong to keys that nobody asks for."""
    fields: Fields = {}
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as fault:
        raise ValueError(f"{path}: not a text file ({fault})") from None
    for line in lines:
        key, *words = line.split("#")[0].split() or [""]
        if key in fields:
            raise ValueError(f"{path}: key {key!r} stands there twice")
        if key:
            values = [_number(word) for word in words]
            fields[key] = values[0] if len(values) == 1 else values
    return fields


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _sileane_camera(fields: Fields, where: str) -> CameraFile:
    camera = _camera(fields, where, _SILEANE)
    if "clip_start" not in fields or "clip_end" not in fields:
        return CameraFile(camera)
    # depth images hold 65535 steps from one clip plane to the other
    return CameraFile(camera, 1000 * (camera.far - camera.near) / 65535, depth_offset=camera.near)


def _ros_camera(fields: Fields, where: str) -> CameraFile:
    matrix = fields["camera_matrix"]
    if not isinstance(matrix, dict):
        raise ValueError(f"{where}: key 'camera_matrix' holds no keys, expected rows, cols and data")
    values = read_numbers(matrix, "data", f"{where}: camera_matrix", (9,)).reshape(3, 3)
    _check_matrix(values, "camera_matrix", where, "row by row")
    lens = fields.get("distortion_coefficients")
    distorted = False
    if isinstance(lens, dict) and lens.get("data"):
        distorted = bool(read_numbers(lens, "data", f"{where}: distortion_coefficients", (-1,)).any())
    return CameraFile(_camera(fields | _named(values), where, _ROS), distorted=distorted)


def _depth_scale(fields: Fields, where: str) -> float | None:
    if "depth_scale" not in fields:
        return None
    value = float(read_numbers(fields, "depth_scale", where, ()))
    if value <= 0:
        raise ValueError(f"{where}: key 'depth_scale' is {value:g}, expected more than 0")
    return value


def _check_matrix(matrix: NDArray[np.float64], key: str, where: str, order: str) -> None:
    """Raise ValueError where a (3, 3) matrix is none of a pinhole camera without skew."""
    rest = matrix - np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    if np.abs(rest).max() > 1e-6 * max(1.0, abs(matrix[0, 0])):
        raise ValueError(
            f"{where}: key {key!r} is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1], its 9 numbers taken {order}"
        )


def _named(matrix: NDArray[np.float64]) -> Fields:
    return {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}


def _camera(fields: Fields, where: str, names: dict[str, str] | None = None) -> Camera:
    """The camera of what a file says. names: what it calls a `Camera`'s fields, where not so."""
    called = {name: name for name in Camera.__dataclass_fields__} | (names or {})
    width, height = (_whole(fields, called[name], where) for name in ("width", "height"))
    if width * height > MOST_PIXELS:
        raise ValueError(f"{where}: claims {width} x {height} pixels, expected {MOST_PIXELS:,} at most")
    fx, fy = (_focal_length(fields, called[name], where) for name in ("fx", "fy"))
    cx, cy = (float(read_numbers(fields, called[name], where, ())) for name in ("cx", "cy"))
    limits = {"near": _NEAR, "far": _FAR}
    for name in limits:
        if called[name] in fields:
            limits[name] = float(read_numbers(fields, called[name], where, ()))
    try:
        return Camera(width, height, fx, fy, cx, cy, **limits)
    except ValueError as fault:
        raise ValueError(f"{where}: {fault}") from None


def _focal_length(fields: Fields, key: str, where: str) -> float:
    value = float(read_numbers(fields, key, where, ()))
    if not 1 <= value <= _MOST_FOCAL:
        raise ValueError(f"{where}: key {key!r} is {value:g}, expected 1 to {_MOST_FOCAL:,} pixels")
    return value


def _whole(fields: Fields, key: str, where: str) -> int:
    value = float(read_numbers(fields, key, where, ()))
    if not (value.is_integer() and 1 <= value <= MOST_PIXELS):
        raise ValueError(f"{where}: key {key!r} is {value:g}, expected a whole number of pixels, 1 or more")
    return int(value)
