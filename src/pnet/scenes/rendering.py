"""Depth, instances, visibility and occlusion of a pile by ray casting (Embree)."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.geometry.camera import Camera

Points = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """What the camera sees of d bodies.

    Attributes:
        depth: (height, width) planar depth, metres, 0 where no body is.
        instance: (height, width) int64 index of the body, −1 where none is.
        incidence: (height, width) cosine of the angle between viewing ray and surface normal, 0 where no
            body is.
        silhouette: (d,) pixels of each body alone, not clipped by the image.
        visible: (d,) pixels of each body in this view.
    """

    depth: NDArray[np.float64]
    instance: NDArray[np.int64]
    incidence: NDArray[np.float32]
    silhouette: NDArray[np.int64]
    visible: NDArray[np.int64]

    @property
    def occlusion(self) -> Points:
        """(d,) 1 − visible share of the body's own silhouette."""
        return 1 - self.visible / np.maximum(self.silhouette, 1)

    @property
    def visibility(self) -> Points:
        """(d,) the paper's V = N_j / N_max; all 0 where nothing is visible."""
        return self.visible / max(int(self.visible.max(initial=0)), 1)


def render_view(camera: Camera, mesh: trimesh.Trimesh, R: Points, t: Points) -> View:
    """Cast the pixels' rays at every body and keep the nearest hit.

    Each body is tested alone, in its own frame, by the rays of its own window of pixels; so one
    acceleration structure serves all bodies, and the silhouette comes with the depth.

    Args:
        camera: the view. mesh: the part object, part frame, metres.
        R: (d, 3, 3), t: (d, 3) part → camera, metres.
    Returns:
        The `View`; bodies not wholly in front of the camera's near plane are an error.
    """
    shape = (camera.height, camera.width)
    depth, instance = np.full(shape, np.inf), np.full(shape, -1, np.int64)
    incidence, silhouette = np.zeros(shape, np.float32), np.zeros(len(R), np.int64)
    if len(R):
        low, size = _windows(camera, mesh, R, t)
        caster = _Caster(mesh)
        for i in range(len(R)):
            u, v = low[i, 0] + np.arange(size[i, 0]), low[i, 1] + np.arange(size[i, 1])
            hit, z, cosine = caster.cast(camera, R[i], t[i], u, v)
            silhouette[i] = hit.sum()
            # the part of the window that lies in the image
            rows, columns = (slice(*np.searchsorted(a, (0, n))) for a, n in zip((v, u), shape, strict=True))
            window = (slice(*_ends(v[rows])), slice(*_ends(u[columns])))
            hit, z, cosine = hit[rows, columns], z[rows, columns], cosine[rows, columns]
            nearest = hit & (z < depth[window]) & (z >= camera.near) & (z <= camera.far)
            depth[window][nearest], instance[window][nearest] = z[nearest], i
            incidence[window][nearest] = cosine[nearest]
    visible = np.bincount(instance[instance >= 0], minlength=len(R))
    depth[instance < 0] = 0.0
    return View(depth, instance, incidence, silhouette, visible)


def _ends(pixels: NDArray[np.int64]) -> tuple[int, int]:
    """First and one past the last of consecutive pixels."""
    return (int(pixels[0]), int(pixels[-1]) + 1) if len(pixels) else (0, 0)


def _windows(
    camera: Camera, mesh: trimesh.Trimesh, R: Points, t: Points
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First pixel u, v (d, 2) and size (d, 2) of the rectangles of pixels whose rays may meet a body."""
    corners = np.einsum("dij,nj->dni", R, mesh.vertices) + t[:, None]
    if corners[..., 2].min() <= camera.near:
        raise ValueError(
            f"a body reaches to {corners[..., 2].min():.3f} m before the camera, nearer than its near "
            f"plane ({camera.near} m); put the camera farther away or lower camera.near"
        )
    pixels = camera.project(corners)
    low = np.ceil(pixels.min(1)).astype(np.int64)
    return low, np.maximum(np.floor(pixels.max(1)).astype(np.int64) - low + 1, 0)


class _Caster:
    """Rays against one part object, in its own frame and in units of its radius: single precision is enough
    there."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
        self._scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, (mesh.vertices[mesh.faces] / self._radius).astype(np.float32))

    def cast(
        self, camera: Camera, R: Points, t: Points, u: NDArray[np.int64], v: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], Points, NDArray[np.float32]]:
        """Rays of the pixels u (w,) × v (h,) at a body with pose R (3, 3), t (3,) part → camera, metres.

        Returns:
            (h, w) which hit, the planar depth of the hits, and the cosine at which they do.
        """
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        ray = (x[None, :, None] * R[0] + y[:, None, None] * R[1] + R[2]).reshape(-1, 3)  # Rᵀ (x, y, 1)
        start = t[2] - 1.5 * self._radius  # near the body, for the precision
        origin = ((start * ray - t @ R) / self._radius).astype(np.float32)
        ray = ray.astype(np.float32)
        found = self._scene.run(origin, ray, query="INTERSECT", output=True)
        hit = found["geomID"] >= 0
        z, normal = start + found["tfar"].astype(np.float64) * self._radius, found["Ng"]
        with np.errstate(invalid="ignore", divide="ignore"):  # rays that miss have no normal
            cosine = np.abs(np.einsum("ni,ni->n", normal, ray))
            cosine /= np.sqrt(np.einsum("ni,ni->n", normal, normal) * np.einsum("ni,ni->n", ray, ray))
        shape = (len(v), len(u))
        return hit.reshape(shape), z.reshape(shape), np.minimum(cosine, 1).reshape(shape)
