"""From a depth image with instance ids and true poses to a `Scene`: what all readers of public data share."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.json_files import ROTATION_TOLERANCE
from pnet.geometry.camera import Camera
from pnet.ops.sampling import farthest_point_order
from pnet.records import Scene, SceneId
from pnet.scenes.edges import image_edges
from pnet.scenes.view_factory import edge_step

Points = NDArray[np.float64]
FARTHEST = 1000.0  # metres; a clip plane or a body beyond it has another unit


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """A depth image with its truth, checked by the reader that made it.

    Attributes:
        depth: (h, w) planar depth, metres; 0 or NaN where nothing was measured.
        instance: (h, w) int64 index of the body in [0, d), −1 for background; pixels without depth may have
            an index.
        R: (d, 3, 3), t: (d, 3) part → camera, metres. parameters: (d, k) metres.
        occlusion: (d,) 1 − visible share of the body's own silhouette, in [0, 1].
    """

    depth: Points
    instance: NDArray[np.int64]
    R: Points
    t: Points
    parameters: Points
    occlusion: Points


def scene_of_image(image: LabelledImage, camera: Camera, part: str, scene_id: SceneId, points: int) -> Scene:
    """Back-project and sample the pixels on bodies.

    Args:
        image: the view and its truth. camera: of the image. part: the template's name.
        points: N, chosen by farthest point sampling; where fewer pixels lie on bodies they are repeated.
    Returns:
        The scene; without any point where no body was measured.
    """
    flat = image.depth.reshape(-1)
    with np.errstate(invalid="ignore"):
        pixels = np.flatnonzero((image.instance.reshape(-1) >= 0) & (flat > 0))  # NaN is not
    v, u = np.divmod(pixels, camera.width)
    cloud = (camera.rays(u, v) * flat[pixels, None]).astype(np.float32)
    owner = image.instance.reshape(-1)[pixels]
    seen = np.bincount(image.instance[image.instance >= 0], minlength=len(image.R))
    edge = image_edges(np.nan_to_num(image.depth), edge_step(cloud, camera)).reshape(-1)[pixels]
    order = farthest_point_order(cloud, points) if len(cloud) else np.zeros(0, np.int64)
    incidence = incidence_at(image.depth, camera, pixels[order])
    return Scene(
        points=cloud[order],
        instance=owner[order],
        R=nearest_rotations(image.R),  # files print few digits
        t=image.t,
        parameters=image.parameters,
        visibility=seen / max(int(seen.max(initial=0)), 1),
        occlusion=image.occlusion,
        camera=camera,
        part=part,
        id=scene_id,
        incidence=np.rint(255 * incidence).astype(np.uint8),
        edge=edge[order],
    )


def incidence_of_depth(depth: Points, camera: Camera) -> Points:
    """Cosine of the angle between viewing ray and surface, from a depth image.

    The normal is the cross product of the differences to the neighbours at the right and below, or to those
    at the left and above where these jump less in depth: at a body's border the one on the same body.

    Args:
        depth: (h, w) planar depth, metres; 0 or NaN where nothing was measured. camera: of the image.
    Returns:
        (h, w) in [0, 1]; 0 where nothing was measured, 1 where no neighbour was.
    """
    return incidence_at(depth, camera, np.arange(depth.size)).reshape(depth.shape)


def incidence_at(depth: Points, camera: Camera, pixels: NDArray[np.int64]) -> Points:
    """`incidence_of_depth` of some pixels alone. pixels: (n,) places in the flattened image; returns (n,)."""
    v, u = np.divmod(pixels, camera.width)
    here = _back_projected(depth, camera, u, v)
    across = _least_jump(
        _back_projected(depth, camera, u + 1, v) - here, here - _back_projected(depth, camera, u - 1, v)
    )
    down = _least_jump(
        _back_projected(depth, camera, u, v + 1) - here, here - _back_projected(depth, camera, u, v - 1)
    )
    normal = np.cross(across, down)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.abs((normal * here).sum(-1))
        cosine /= np.linalg.norm(normal, axis=-1) * np.linalg.norm(here, axis=-1)
    fallback = np.where(np.isnan(here[:, 2]), 0.0, 1.0)
    return np.where(np.isfinite(cosine), np.clip(np.nan_to_num(cosine), 0, 1), fallback)


def _back_projected(depth: Points, camera: Camera, u: NDArray[np.int64], v: NDArray[np.int64]) -> Points:
    """(n, 3) points of the pixels u, v (n,); NaN outside the image and where nothing was measured."""
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    z = depth[np.where(inside, v, 0), np.where(inside, u, 0)]
    return camera.rays(u, v) * np.where(inside & (z > 0), z, np.nan)[:, None]


def _least_jump(after: Points, before: Points) -> Points:
    """(n, 3) of two differences the one that jumps less in depth; NaN where neither is known."""
    jump_after, jump_before = (np.nan_to_num(np.abs(x[:, 2:]), nan=np.inf) for x in (after, before))
    return np.where(jump_after <= jump_before, after, before)


def instance_indices(
    codes: NDArray[np.unsignedinteger[Any]],
    ids: NDArray[np.int64],
    background: Collection[int],
    image: Path,
    truth: Path,
) -> NDArray[np.int64]:
    """From a segmentation image to indices of bodies.

    Args:
        codes: (h, w) uint8 or uint16 pixels of the segmentation. ids: (d,) the bodies' values there.
        background: values that stand for no body; one that is a body's id stands for the body.
        image, truth: the files that they come from, for errors.
    Returns:
        (h, w) index in [0, d), −1 for background.
    Raises:
        ValueError: two bodies have the same id, or pixels have a value that is neither.
    """
    values, count = np.unique(ids, return_counts=True)
    if (count > 1).any():
        raise ValueError(f"{truth}: the segmentation id {values[count > 1][0]} comes twice")
    unknown = len(ids)
    table = np.full(np.iinfo(codes.dtype).max + 1, unknown, np.int64)
    table[list(background)] = -1
    table[ids] = np.arange(len(ids))
    instance = table[codes]
    strangers = instance == unknown
    if strangers.any():
        raise ValueError(
            f"{image}: {strangers.sum()} pixels have the id {codes[strangers][0]}, which {truth} does not "
            "name"
        )
    return instance


def check_rotations(R: Points, where: str) -> None:
    """Raise ValueError where matrices (d, 3, 3) are no rotations. where: the file, for the error."""
    for row, matrix in enumerate(R):
        with np.errstate(invalid="ignore", over="ignore"):
            gap, volume = float(np.abs(matrix @ matrix.T - np.eye(3)).max()), np.linalg.det(matrix)
        if not gap <= ROTATION_TOLERANCE or volume < 0:
            raise ValueError(
                f"{where}: the rotation of entry {row} is none (R Rᵀ is off the identity by {gap:.2g}, "
                f"determinant {volume:.2g})"
            )


def nearest_rotations(R: Points) -> Points:
    """The rotations (d, 3, 3) nearest to matrices that `check_rotations` lets pass."""
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt


def check_depth_range(near: float, far: float, where: str) -> None:
    """Raise ValueError where clip planes are the wrong way round. near, far: metres. where: the file."""
    if not 0 < near < far <= FARTHEST:
        raise ValueError(
            f"{where}: clip_end ({far:g} m) must exceed clip_start ({near:g} m), which must be positive, and "
            f"be at most {FARTHEST:g} m"
        )


def read_lines(path: Path) -> list[str]:
    """The lines of a text file; errors name it."""
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except UnicodeDecodeError as fault:
        raise ValueError(f"{path}: not a text file ({fault})") from fault
