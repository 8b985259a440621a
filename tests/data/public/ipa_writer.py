"""Writes scenes as the Fraunhofer IPA data set has them, from its description: no code of the reader."""

import json
from math import atan, degrees
from pathlib import Path

import numpy as np
from PIL import Image

from pnet.geometry.camera import Camera

LARGEST = 65535
SQUARE = 240  # pixels of the image that the window is cut from
HEADER = "id,class,x,y,z,rot_x_axis_x,rot_x_axis_y,rot_x_axis_z,rot_y_axis_x,rot_y_axis_y,rot_y_axis_z"
HEADER += ",rot_z_axis_x,rot_z_axis_y,rot_z_axis_z,visibility_score_o,visibility_score_p"


def window_camera(width: int, height: int, first_u: int, first_v: int, focal: float) -> Camera:
    """The camera of a window of the square image; the axis goes through the square's middle, where the
    pixels' edges are whole numbers and their centres halves."""
    cx, cy = SQUARE / 2 - first_u - 0.5, SQUARE / 2 - first_v - 0.5
    return Camera(width, height, focal, focal, cx, cy, near=0.5, far=1.5)


def write_parameters(part: Path, camera: Camera, **changes: object) -> None:
    """parameter.json; changes replace a key's value, or leave the key out where None."""
    fields = {
        "resolutionX": camera.width,
        "resolutionY": camera.height,
        "resolution_big": SQUARE,
        "perspectiveAngle": degrees(2 * atan(SQUARE / 2 / camera.fx)),
        "pixelOffset_X_KoSyTopLeft": round(SQUARE / 2 - 0.5 - camera.cx),
        "pixelOffset_Y_KoSyTopLeft": round(SQUARE / 2 - 0.5 - camera.cy),
        "clip_start": camera.near,
        "clip_end": camera.far,
        "location": [0.0, 0.0, 1.3],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "number_cycles": 2,
        "shapeDropLimit": 30,
    } | changes
    part.mkdir(parents=True, exist_ok=True)
    kept = {key: value for key, value in fields.items() if value is not None}
    (part / "parameter.json").write_text(json.dumps(kept))


def write_depth(
    part: Path, cycle: int, drop: int, camera: Camera, depth: np.ndarray, folder: str = "p_depth"
) -> None:
    """The depth image (h, w), metres; NaN where nothing was measured."""
    share = (depth - camera.near) / (camera.far - camera.near)
    code = np.where(np.isnan(depth), LARGEST, np.rint(np.nan_to_num(share) * LARGEST))
    path = part / folder / f"cycle_{cycle:04d}" / f"{drop:03d}_depth_uint16.png"
    write_image(path, code.astype(np.uint16))


def write_scene(
    part: Path,
    cycle: int,
    drop: int,
    camera: Camera,
    depth: np.ndarray,
    instance: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
    occlusion: np.ndarray,
    nothing: int = 0,
    ending: str = "",
) -> None:
    """Depth, segmentation and truth of a scene.

    Args:
        depth: (h, w) metres, NaN where nothing was measured. instance: (h, w), −1 for the bin, whose pixels
            get the value `nothing`. R: (d, 3, 3), t: (d, 3) object → camera. ending: of the folders' names.
    """
    write_depth(part, cycle, drop, camera, depth, f"p_depth{ending}")
    place = f"cycle_{cycle:04d}"
    values = np.where(instance < 0, nothing, instance + 1).astype(np.uint8)
    write_image(part / f"p_segmentation{ending}" / place / f"{drop:03d}_segmentation.png", values)
    rows = [truth_row(k + 1, R[k], t[k], 1 - occlusion[k]) for k in range(len(R))]
    write_truth(part / f"gt{ending}" / place / f"{drop:03d}.csv", [BIN, *rows])


def truth_row(number: int, R: np.ndarray, t: np.ndarray, visible: float) -> str:
    """A body's line: x and y against our frame's, the rotation's columns one after the other."""
    x, y, z = t
    columns = [-R[0, 0], -R[1, 0], R[2, 0], -R[0, 1], -R[1, 1], R[2, 1], -R[0, 2], -R[1, 2], R[2, 2]]
    of_image = 0.4 * visible  # the other score is not what we want
    values = [-x, -y, z, *columns, of_image, visible]
    return ",".join([str(number), "part", *(repr(float(value)) for value in values)])


BIN = truth_row(0, np.eye(3), np.array([0, 0, 1.3]), 1).replace("part", "bin")


def write_truth(path: Path, rows: list[str], header: str = HEADER) -> None:
    """Lines under a header line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows]) + "\n")


def write_image(path: Path, values: np.ndarray) -> None:
    """A PNG image of one channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)
