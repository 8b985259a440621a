"""Writes scenes as the Parametric data set has them, from its description alone: no code of the reader."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
import OpenEXR
from PIL import Image
from scipy.spatial.transform import Rotation

from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.scenes.rendering import View, render_view

CLIP_START, CLIP_END, LARGEST = 0.3, 0.9, 65535
STEP = (CLIP_END - CLIP_START) / LARGEST  # metres along the ray
# five nuts: one lies on two others, one stands, one is cut by the image's border
TURNS = [[0, 0, 0], [0.3, 0.1, 0.5], [1.4, 0.2, 0.1], [0.2, -0.4, 0.9], [2.9, 0.3, 0.2]]
PLACES = [
    [-0.03, -0.012, 0.52],
    [0.005, -0.01, 0.53],
    [0.04, 0.02, 0.50],
    [-0.016, -0.006, 0.495],
    [-0.086, 0.044, 0.52],
]


@dataclass(frozen=True, eq=False)
class Pile:
    """What was put before the camera, and what it sees."""

    part: ParametricPart
    sizes: np.ndarray  # (k,) metres
    camera: Camera
    R: np.ndarray
    t: np.ndarray
    view: View = field(init=False)

    def __post_init__(self) -> None:
        view = render_view(self.camera, self.part.mesh(self.sizes), self.R, self.t)
        object.__setattr__(self, "view", view)

    @property
    def cloud(self) -> np.ndarray:
        """(h, w, 3) exact points, the camera's formula written out."""
        v, u = np.indices(self.view.depth.shape)
        z, c = self.view.depth, self.camera
        return np.stack([(u - c.cx) * z / c.fx, (v - c.cy) * z / c.fy, z], -1)


def make_camera(width: int = 96, height: int = 72) -> Camera:
    """A view of 17 by 13 cm at half a metre, its axis off the centre, pixels not square."""
    return Camera(width, height, 2.9 * width, 2.95 * width, width / 2 - 2.3, height / 2 + 1.4, 0.2, 2.0)


def make_pile(part: ParametricPart, bodies: int, grid: str = "L", index: int = 5, width: int = 96) -> Pile:
    """The first so many bodies of a part object."""
    R = Rotation.from_rotvec(TURNS[:bodies]).as_matrix()
    sizes = part.part_object(grid, index)
    return Pile(part, sizes, make_camera(width, width * 3 // 4), R, np.array(PLACES[:bodies]))


def write_parameters(path: Path, camera: Camera, **changes: object) -> None:
    """parameter.json."""
    fields = {
        "resolutionX": camera.width,
        "resolutionY": camera.height,
        "fu": camera.fx,
        "fv": camera.fy,
        "cu": camera.cx,
        "cv": camera.cy,
        "clip_start": CLIP_START,
        "clip_end": CLIP_END,
        "max_val_in_depth": LARGEST,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(fields | changes))


def write_raw(
    template: Path, name: str, pile: Pile, cycle: int = 0, segments: str = "segment_images", seed: int = 0
) -> None:
    """Truth, depth and segmentation of one scene in a template's folder; rows in random order."""
    place = f"cycle_{cycle:04d}"
    (template / "gt" / place).mkdir(parents=True, exist_ok=True)
    rows = truth_rows(pile)
    np.random.default_rng(seed).shuffle(rows)
    write_truth(template / "gt" / place / f"{name}.csv", rows)
    write_depth(template / "depth_images" / place / name / "Image0001.png", coded_depth(pile))
    write_colours(template / segments / place / name / "Image0001.exr", *colours(pile))


def truth_rows(pile: Pile) -> list[list[object]]:
    """A row a body: class, id, t, R, visibility, parameters in mm."""
    sizes = [1000 * float(size) for size in pile.sizes]
    visibility = pile.view.visible / pile.view.visible.max()
    bodies = zip(pile.t.tolist(), pile.R.reshape(-1, 9).tolist(), visibility.tolist(), strict=True)
    return [["TN06", i, *t, *R, seen, *sizes] for i, (t, R, seen) in enumerate(bodies)]


def write_truth(path: Path, rows: list[list[object]], header: str = "class,id,t,R,visibility,sizes") -> None:
    """Rows as CSV under a header line."""
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")


def coded_depth(pile: Pile) -> np.ndarray:
    """(h, w) uint16: the distance along the ray between the clip planes, 0 where nothing is."""
    distance = np.linalg.norm(pile.cloud, axis=-1)
    share = (distance - CLIP_START) / (CLIP_END - CLIP_START)
    return np.where(pile.view.instance >= 0, np.rint(share * LARGEST), 0).astype(np.uint16)


def write_depth(path: Path, values: np.ndarray) -> None:
    """A PNG image of one channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def colours(pile: Pile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Red, green and blue (h, w): red on bodies and green their id, blue or black elsewhere."""
    body = pile.view.instance
    red = (body >= 0).astype(np.float32)
    green = np.where(body >= 0, body / max(len(pile.t) - 1, 1), 0).astype(np.float32)
    blue = np.where((body < 0) & (np.indices(body.shape)[0] % 2 == 0), 1, 0).astype(np.float32)
    return red, green, blue


def write_colours(path: Path, red: np.ndarray, green: np.ndarray, blue: np.ndarray) -> None:
    """An OpenEXR image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": red, "G": green, "B": blue}).write(str(path))


def h5_arrays(pile: Pile, points: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """`data` (points, 3) and `labels` (points, 23) of pixels on bodies, drawn at random."""
    rng = np.random.default_rng(seed)
    rows, columns = np.nonzero(pile.view.instance >= 0)
    chosen = rng.choice(len(rows), points, replace=points > len(rows))
    body = pile.view.instance[rows[chosen], columns[chosen]]
    visibility = pile.view.visible / pile.view.visible.max()
    labels = np.concatenate(
        [
            pile.t[body],
            pile.R.reshape(-1, 9)[body],
            visibility[body, None],
            body[:, None],
            rng.normal(size=(points, 9)),  # keypoints
        ],
        axis=1,
    )
    return pile.cloud[rows[chosen], columns[chosen]].astype(np.float32), labels.astype(np.float32)


def write_h5(path: Path, **arrays: object) -> None:
    """A file of arrays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
