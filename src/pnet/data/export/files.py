"""Images and JSON as files; nothing appears under a final name before it is whole."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.exchange.ply import export_ply

from pnet.scenes.record_file import write_atomically

Advance = Callable[[int], None]  # told how many more scenes are written


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image (h, w) of one channel with 8 or 16 bits; the folder must exist."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    write_atomically(path, buffer.getvalue())


def ply_content(mesh: trimesh.Trimesh, normals: bool) -> bytes:
    """A mesh as a binary PLY file. normals: of the vertices, too."""
    return bytes(export_ply(mesh, vertex_normal=normals))


def write_json(path: Path, value: Any) -> None:
    """Write plain values with all their digits; the folder must exist. NaN and infinity are a ValueError."""
    write_atomically(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())
