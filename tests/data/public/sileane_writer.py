"""Writes scenes as the Siléane data set has them, from its description alone: no code of the reader."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from pnet.geometry.camera import Camera

# the camera's place: looking down, tilted and turned; camera → world
QUATERNION = (0.08, 0.91, -0.36, 0.19)  # w x y z, of any norm
LOCATION = (0.21, -0.34, 1.3)
LARGEST = 65535


def camera_rotation(quaternion: tuple[float, ...] = QUATERNION) -> np.ndarray:
    """The matrix (3, 3) of a quaternion, the textbook's formula."""
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def segmentation_ids(bodies: int) -> list[int]:
    """The bodies' values in the segmentation: 65535 (N − k) / N, halves rounded up."""
    return [(2 * LARGEST * (bodies - k) + bodies) // (2 * bodies) for k in range(bodies)]


def write_camera(root: Path, camera: Camera, **changes: str) -> None:
    """camera_params.txt; changes replace a key's values, or leave the key out where empty."""
    unit = np.array(QUATERNION) / np.linalg.norm(QUATERNION)
    values = {
        "width": camera.width,
        "height": camera.height,
        "fu": camera.fx,
        "fv": camera.fy,
        "cu": camera.cx,
        "cv": camera.cy,
        "clip_start": camera.near,
        "clip_end": camera.far,
        "location": " ".join(map(repr, LOCATION)),
        "rotation": " ".join(repr(float(x)) for x in unit),
    }
    lines = [f"{key} {value}" for key, value in (values | changes).items() if value != ""]
    root.mkdir(parents=True, exist_ok=True)
    (root / "camera_params.txt").write_text("\n".join(["# pixels and metres", *lines]) + "\n")


def write_scene(
    root: Path,
    name: str,
    camera: Camera,
    depth: np.ndarray,
    instance: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
    occlusion: np.ndarray,
    background: int = 0,
    folder: str = "depth",
    ending: str = ".PNG",
) -> None:
    """Depth, segmentation and truth of a scene.

    Args:
        name: like bunny_3_070. depth: (h, w) metres, NaN or 0 where nothing was measured.
        instance: (h, w), −1 for the background, whose pixels get the value `background`.
        R: (d, 3, 3), t: (d, 3) object → camera. folder: of the depth image. ending: of the images.
    """
    share = (depth - camera.near) / (camera.far - camera.near)
    code = np.where(depth > 0, np.rint(np.nan_to_num(share) * LARGEST), LARGEST)
    write_image(root / folder / (name + ending), code)
    ids = segmentation_ids(len(R))
    values = np.full(instance.shape, background)
    for k, number in enumerate(ids):
        values[instance == k] = number
    write_image(root / "segmentation" / (name + ending), values)
    turn = camera_rotation()
    rows = [
        {
            "R": (turn @ R[k]).tolist(),
            "t": (turn @ t[k] + LOCATION).tolist(),
            "segmentation_id": ids[k],
            "occlusion_rate": float(occlusion[k]),
        }
        for k in range(len(R))
    ]
    write_truth(root, name, rows)


def write_image(path: Path, values: np.ndarray) -> None:
    """A 16-bit PNG image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert values.min() >= 0 and values.max() <= LARGEST
    Image.fromarray(values.astype(np.uint16)).save(path, format="PNG")


def write_truth(root: Path, name: str, rows: object) -> None:
    """The truth of a scene."""
    (root / "gt").mkdir(parents=True, exist_ok=True)
    (root / "gt" / f"{name}.json").write_text(json.dumps(rows))
