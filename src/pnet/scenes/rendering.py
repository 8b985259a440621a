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
    depth = np.full(camera.height * camera.width, np.inf)
    instance = np.full(camera.height * camera.width, -1, np.int64)
    incidence = np.zeros(camera.height * camera.width, np.float32)
    silhouette = np.zeros(len(R), np.int64)
    if len(R):
        body, u, v = _windows(camera, mesh, R, t)
        hit, z, cosine = _cast(mesh, R, t, body, camera.rays(u, v))
        body, u, v = body[hit], u[hit], v[hit]
        silhouette = np.bincount(body, minlength=len(R))
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        inside &= (z >= camera.near) & (z <= camera.far)
        body, pixel, z, cosine = body[inside], (v * camera.width + u)[inside], z[inside], cosine[inside]
        order = np.lexsort((body, -z))  # the nearest is written last and stays
        depth[pixel[order]], instance[pixel[order]] = z[order], body[order]
        incidence[pixel[order]] = cosine[order]
    visible = np.bincount(instance[instance >= 0], minlength=len(R))
    shape = (camera.height, camera.width)
    depth[instance < 0] = 0.0
    images = depth.reshape(shape), instance.reshape(shape), incidence.reshape(shape)
    return View(*images, silhouette, visible)


def _windows(
    camera: Camera, mesh: trimesh.Trimesh, R: Points, t: Points
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Body index and pixel u, v of every ray that may meet a body."""
    corners = np.einsum("dij,nj->dni", R, mesh.vertices) + t[:, None]
    if corners[..., 2].min() <= camera.near:
        raise ValueError(
            f"a body reaches to {corners[..., 2].min():.3f} m before the camera, nearer than its near "
            f"plane ({camera.near} m); put the camera farther away or lower camera.near"
        )
    pixels = camera.project(corners)
    low = np.ceil(pixels.min(1)).astype(np.int64)
    size = np.floor(pixels.max(1)).astype(np.int64) - low + 1
    count = size.prod(1)
    body = np.repeat(np.arange(len(R)), count)
    within = np.arange(len(body)) - np.repeat(np.cumsum(count) - count, count)
    v, u = np.divmod(within, size[body, 0])
    return body, u + low[body, 0], v + low[body, 1]


def _cast(
    mesh: trimesh.Trimesh, R: Points, t: Points, body: NDArray[np.int64], rays: Points
) -> tuple[NDArray[np.bool_], Points, NDArray[np.float32]]:
    """Which rays hit, the planar depth of the hits, and the cosine at which they do.

    rays: (n, 3) camera frame with z = 1.
    """
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    # single precision in the part's own frame and size: start near the body, in units of its radius
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    start_depth = t[:, 2] - 1.5 * radius
    origin = rays * start_depth[body, None] - t[body]
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, (mesh.vertices[mesh.faces] / radius).astype(np.float32))
    local_origin = np.einsum("nji,nj->ni", R[body], origin) / radius
    local_rays = np.einsum("nji,nj->ni", R[body], rays).astype(np.float32)
    found = scene.run(local_origin.astype(np.float32), local_rays, query="INTERSECT", output=True)
    distance, hit = found["tfar"], found["geomID"] >= 0
    normal, ray = found["Ng"][hit], local_rays[hit]
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(ray, axis=1)
    cosine = np.minimum(np.abs(np.einsum("ni,ni->n", normal, ray)) / length, 1)
    return hit, start_depth[body[hit]] + distance[hit].astype(np.float64) * radius, cosine
