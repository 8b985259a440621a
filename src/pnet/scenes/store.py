"""The store: one file a cycle, its scenes read one by one.

A file is a safetensors file (nothing in it is ever run) whose single metadata entry is a JSON header
with a version, a checksum of its own and one per scene. It is written under a temporary name and
renamed when whole.
"""

import json
import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from pnet.geometry.camera import Camera
from pnet.records import Scene, SceneId

FORMAT = "pnet-cycle"
VERSION = 1
SUFFIX = ".safetensors"
TEMPORARY = ".part"  # a file that is still being written
_BODY = ("R", "t", "parameters", "visibility", "occlusion")  # one row a body
_DTYPES = {"points": "F32", "instance": "I16", "first_body": "I64", **dict.fromkeys(_BODY, "F64")}


@dataclass(frozen=True)
class CycleHeader:
    """What a cycle file says of itself.

    Attributes:
        fingerprint: digest of the settings that made it. part: the template's name.
        camera: intrinsics. split, kind, cycle, part_index: as in `SceneId`.
        drops: (scenes) bodies dropped before each scene. escaped: bodies that left the bin in all.
        unsettled: scenes taken before everything was at rest. empty: scenes left out, nothing visible.
    """

    fingerprint: str
    part: str
    camera: Camera
    split: str
    kind: str
    cycle: int
    part_index: int
    drops: tuple[int, ...]
    escaped: int = 0
    unsettled: int = 0
    empty: int = 0


def write_cycle(path: Path, header: CycleHeader, scenes: Sequence[Scene]) -> None:
    """Write a cycle's scenes; nothing appears under the final name before it is whole.

    Args:
        path: final name. header: its drops must match the scenes. scenes: all with the same N.
    """
    rows = [len(scene.R) for scene in scenes]
    first = np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)
    k = scenes[0].parameters.shape[1] if scenes else 0
    shapes = {"R": (0, 3, 3), "t": (0, 3), "parameters": (0, k)}
    n = len(scenes[0].points) if scenes else 0
    arrays: dict[str, NDArray[Any]] = {
        "points": np.stack([s.points for s in scenes]) if scenes else np.zeros((0, n, 3), np.float32),
        "instance": np.stack([s.instance for s in scenes]).astype(np.int16)
        if scenes
        else np.zeros((0, n), np.int16),
        "first_body": first,
    }
    for name in _BODY:
        parts = [getattr(scene, name) for scene in scenes]
        arrays[name] = np.concatenate(parts) if parts else np.zeros(shapes.get(name, (0,)))
    content = {
        "format": FORMAT,
        "version": VERSION,
        **{key: getattr(header, key) for key in CycleHeader.__dataclass_fields__},
        "camera": header.camera.to_dict(),
        "crc32": [_checksum(arrays, first, i) for i in range(len(scenes))],
    }
    content["header_crc32"] = _header_checksum(content)
    # one metadata entry only: the order of several is not fixed, and equal scenes must give equal bytes
    write_atomically(path, save(arrays, {FORMAT: json.dumps(content, sort_keys=True)}))


class CycleFile:
    """A cycle file, opened lazily; scenes are read and checked one by one.

    Args:
        path: the file.
    Raises:
        ValueError: where the file is no whole cycle file that this version reads; names it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = safe_open(path, framework="numpy")
            content = json.loads((self._file.metadata() or {})[FORMAT])
            newer = content["version"] > VERSION
            if not newer:
                self._read_header(content)
                self._open_arrays()
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: no such cycle file; run pnet-generate") from None
        except PermissionError as fault:
            raise PermissionError(f"{path}: not allowed to read it") from fault
        except (SafetensorError, LookupError, TypeError, ValueError, AttributeError, OSError) as fault:
            raise _damaged(path, str(fault)) from fault
        if newer:
            raise ValueError(
                f"{path}: written by a newer pnet (format {content['version']}, this one reads up to "
                f"{VERSION}); update pnet or make the data again"
            )

    def _read_header(self, content: dict[str, Any]) -> None:
        if content["header_crc32"] != _header_checksum(content):
            raise ValueError("the header does not match its checksum")
        self._crc32 = content["crc32"]
        fields = {key: content[key] for key in CycleHeader.__dataclass_fields__}
        fields["camera"] = Camera(**content["camera"])
        fields["drops"] = tuple(content["drops"])
        self.header = CycleHeader(**fields)

    def _open_arrays(self) -> None:
        views = {name: self._file.get_slice(name) for name in _DTYPES}
        if {name: view.get_dtype() for name, view in views.items()} != _DTYPES:
            raise ValueError("array types disagree")
        self._first = self._file.get_tensor("first_body")
        self._points, self._instance = views["points"], views["instance"]
        self._bodies = {name: views[name] for name in _BODY}
        self.points_per_scene = int(self._points.get_shape()[1])
        scenes = {len(self), len(self._crc32), len(self._first) - 1}
        scenes |= {self._points.get_shape()[0], self._instance.get_shape()[0]}
        bodies = {int(self._first[-1])} | {view.get_shape()[0] for view in self._bodies.values()}
        if len(scenes) > 1 or len(bodies) > 1 or (np.diff(self._first, prepend=0) < 0).any():
            raise ValueError("scene or body counts disagree")

    def __len__(self) -> int:
        return len(self.header.drops)

    def scene_id(self, index: int) -> SceneId:
        """Where scene `index` comes from."""
        h = self.header
        return SceneId(h.split, h.kind, h.cycle, h.part_index, h.drops[index])

    def scene(self, index: int) -> Scene:
        """Read one scene and check it against its checksum."""
        rows = slice(int(self._first[index]), int(self._first[index + 1]))
        try:
            points = self._points[index : index + 1]
            instance = self._instance[index : index + 1]
            bodies = {name: view[rows] for name, view in self._bodies.items()}
        except (SafetensorError, ValueError, IndexError, OverflowError) as fault:
            raise _damaged(self.path, f"scene {index}: {fault}") from fault
        if _digest([points, instance, *bodies.values()]) != self._crc32[index]:
            raise _damaged(self.path, f"scene {index} does not match its checksum")
        return Scene(
            points=points[0],
            instance=instance[0].astype(np.int64),
            camera=self.header.camera,
            part=self.header.part,
            id=self.scene_id(index),
            **bodies,
        )


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under a temporary name, flush it to the disk and rename it."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY}")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _damaged(path: Path, fault: str) -> ValueError:
    return ValueError(
        f"{path}: not a whole cycle file ({fault}); delete it and run pnet-generate again, "
        "which makes only what is missing"
    )


def _checksum(arrays: dict[str, NDArray[Any]], first: NDArray[np.int64], index: int) -> int:
    rows = slice(int(first[index]), int(first[index + 1]))
    own = [arrays["points"][index : index + 1], arrays["instance"][index : index + 1]]
    return _digest([*own, *(arrays[name][rows] for name in _BODY)])


def _header_checksum(content: dict[str, Any]) -> int:
    """Of everything in the header but itself."""
    rest = {key: value for key, value in content.items() if key != "header_crc32"}
    return zlib.crc32(json.dumps(rest, sort_keys=True).encode())


def _digest(arrays: Sequence[NDArray[Any]]) -> int:
    value = 0
    for array in arrays:
        value = zlib.crc32(np.ascontiguousarray(array).tobytes(), value)
    return value
