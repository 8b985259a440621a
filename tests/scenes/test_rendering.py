"""Depth, instances, visibility and occlusion against closed forms and trimesh's own ray casting."""

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pnet.geometry.camera import Camera
from pnet.scenes.rendering import render_view

EYE = np.eye(3)
CAMERA = Camera(80, 60, 200.0, 200.0, 39.5, 29.5, near=0.1, far=2.0)


@pytest.fixture(scope="module")
def cube() -> trimesh.Trimesh:
    """Twenty millimetres."""
    return trimesh.creation.box((0.02, 0.02, 0.02))


def view_of(camera, mesh, *places, R=None):
    """Bodies at places (x, y, z), turned by R or not at all."""
    R = np.stack([EYE] * len(places)) if R is None else R
    return render_view(camera, mesh, R, np.array(places, float).reshape(-1, 3))


def random_poses(n: int, spread: float, depth: float, rng: np.random.Generator):
    """Any orientations, centroids within `spread` of a point on the optical axis."""
    place = np.array([0, 0, depth])
    return Rotation.random(n, rng=rng).as_matrix(), place + rng.uniform(-spread, spread, (n, 3))


def pixels_in_square(camera: Camera, half: float, depth: float, x: float = 0.0) -> int:
    """Pixels, in an image without borders, whose ray meets |X − x| < half, |Y| < half at a depth."""
    u, v = np.meshgrid(np.arange(-500, 500), np.arange(-500, 500))
    X, Y = depth * (u - camera.cx) / camera.fx - x, depth * (v - camera.cy) / camera.fy
    return int(((np.abs(X) < half) & (np.abs(Y) < half)).sum())


def test_a_face_on_cube_has_the_depth_of_its_face_and_its_analytic_silhouette(cube):
    view = view_of(CAMERA, cube, (0, 0, 0.5))
    expected = pixels_in_square(CAMERA, 0.01, 0.49)
    assert expected == 64
    assert view.silhouette.tolist() == view.visible.tolist() == [expected]
    seen = view.instance == 0
    assert seen.sum() == expected
    np.testing.assert_allclose(view.depth[seen], 0.49, atol=1e-5)
    assert (view.depth[~seen] == 0).all() and (view.instance[~seen] == -1).all()


def test_a_sphere_has_the_analytic_depth_and_outline():
    """An icosphere of 80,000 faces stays within 4e-5 of its radius."""
    radius, centre = 0.04, np.array([0.01, -0.005, 0.4])
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=radius)
    view = view_of(CAMERA, sphere, centre)
    v, u = np.mgrid[:60, :80]
    rays = CAMERA.rays(u, v)
    a, b = (rays**2).sum(-1), rays @ centre
    root = b**2 - a * (centre @ centre - radius**2)
    hit = root > 0
    depth = (b[hit] - np.sqrt(root[hit])) / a[hit]
    assert (view.instance >= 0).sum() == pytest.approx(hit.sum(), abs=8)
    both = hit & (view.instance >= 0)
    analytic = np.zeros_like(view.depth)
    analytic[hit] = depth
    gap = np.abs(view.depth - analytic)[both]
    assert np.median(gap) < 1e-5 and np.quantile(gap, 0.98) < 1e-4


def test_depth_is_planar_not_radial(cube):
    """A wide plate across the view has one depth everywhere."""
    plate = trimesh.creation.box((1.0, 1.0, 0.02))
    view = view_of(CAMERA, plate, (0, 0, 0.5))
    np.testing.assert_allclose(view.depth, 0.49, atol=1e-5)
    assert view.silhouette[0] > view.visible[0] == 80 * 60


def test_a_body_right_behind_another_is_wholly_occluded(cube):
    view = view_of(CAMERA, cube, (0, 0, 0.6), (0, 0, 0.4))
    assert view.occlusion.tolist() == [1, 0]
    assert view.visible[0] == 0 < view.silhouette[0]
    assert view.visibility.tolist() == [0, 1]
    assert set(np.unique(view.instance)) == {-1, 1}


def test_a_half_covered_body_is_half_occluded(cube):
    """The nearer cube's right edge lies on the optical axis, at a pixel's border."""
    view = view_of(CAMERA, cube, (0, 0, 0.6), (-0.01, 0, 0.4))
    assert view.occlusion[0] == pytest.approx(0.5)
    assert view.occlusion[1] == 0


def test_visibility_is_the_pixel_count_over_the_largest(cube):
    view = view_of(CAMERA, cube, (-0.03, 0, 0.4), (0.03, 0, 0.6))
    near, far = pixels_in_square(CAMERA, 0.01, 0.39, -0.03), pixels_in_square(CAMERA, 0.01, 0.59, 0.03)
    # the near cube shows its side too, so its count is the view's own
    assert view.visible[0] >= near and view.visible[1] >= far
    np.testing.assert_allclose(view.visibility, view.visible / view.visible[0])
    assert view.occlusion.tolist() == [0, 0]


def test_what_the_image_cuts_off_counts_as_occluded(cube):
    """The image's left border goes through the middle of the cube's face."""
    border = -0.5  # pixels
    x = 0.49 * (border - CAMERA.cx) / CAMERA.fx
    view = view_of(CAMERA, cube, (x, 0, 0.5))
    whole = view_of(Camera(400, 60, 200.0, 200.0, 239.5, 29.5, 0.1, 2.0), cube, (x, 0, 0.5))
    assert whole.occlusion[0] == 0
    assert view.silhouette[0] == whole.silhouette[0] > view.visible[0] > 0
    outside = (whole.instance >= 0)[:, :200].sum()
    assert view.occlusion[0] == pytest.approx(outside / whole.silhouette[0])
    assert 0.4 < view.occlusion[0] < 0.7


def test_a_body_outside_the_image_is_invisible_but_has_a_silhouette(cube):
    view = view_of(CAMERA, cube, (0.3, 0, 0.5))
    assert view.visible[0] == 0 and view.silhouette[0] > 60
    assert view.occlusion.tolist() == [1] and view.visibility.tolist() == [0]
    assert (view.instance == -1).all()


def test_no_body_gives_an_empty_view(cube):
    view = render_view(CAMERA, cube, np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert view.depth.shape == view.instance.shape == (60, 80)
    assert (view.depth == 0).all() and (view.instance == -1).all()
    assert (
        view.visible.shape == view.silhouette.shape == view.occlusion.shape == view.visibility.shape == (0,)
    )


def test_a_body_between_all_pixels_is_seen_by_none():
    speck = trimesh.creation.box((1e-5, 1e-5, 1e-5))
    view = view_of(CAMERA, speck, (0, 0, 0.5))
    assert view.silhouette.tolist() == view.visible.tolist() == [0]
    assert view.occlusion.tolist() == [1] and view.visibility.tolist() == [0]


def test_what_lies_beyond_the_far_plane_is_not_measured(cube):
    view = view_of(Camera(80, 60, 200.0, 200.0, 39.5, 29.5, 0.1, 0.45), cube, (0, 0, 0.5))
    assert (view.instance == -1).all() and view.occlusion.tolist() == [1]


@pytest.mark.parametrize("z", [0.11, 0.05, -0.5])
def test_a_body_before_the_near_plane_is_refused_with_its_depth(cube, z):
    with pytest.raises(ValueError, match=rf"reaches to {z - 0.01:.3f} m before the camera.*\(0.1 m\)"):
        view_of(CAMERA, cube, (0, 0, 0.5), (0, 0, z))


def test_the_order_of_the_bodies_is_only_their_numbering(tn34):
    mesh = tn34.mesh(tn34.part_object("L", 0))
    rng = np.random.default_rng(0)
    R, t = random_poses(6, 0.02, 0.4, rng)
    view, order = render_view(CAMERA, mesh, R, t), np.array([3, 1, 5, 0, 4, 2])
    other = render_view(CAMERA, mesh, R[order], t[order])
    np.testing.assert_array_equal(other.depth, view.depth)
    np.testing.assert_array_equal(other.visible, view.visible[order])
    seen = view.instance >= 0
    np.testing.assert_array_equal(order[other.instance[seen]], view.instance[seen])


def test_a_random_pile_is_what_trimesh_casts_on_all_bodies_together(part):
    camera = Camera(640, 512, 1500.0, 1500.0, 319.5, 255.5, near=0.3, far=1.0)
    mesh = part.mesh(part.part_object("L", 0))
    rng = np.random.default_rng(1)
    R, t = random_poses(15, 0.05, 0.6, rng)
    view = render_view(camera, mesh, R, t)
    bodies = [trimesh.Trimesh(mesh.vertices @ r.T + p, mesh.faces) for r, p in zip(R, t, strict=True)]
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(u, v).reshape(-1, 3)
    # from near by: trimesh casts in single precision in the camera's frame
    hits, ray, face = trimesh.util.concatenate(bodies).ray.intersects_location(
        0.5 * rays, rays, multiple_hits=False
    )
    depth, instance = np.zeros(len(rays)), np.full(len(rays), -1)
    depth[ray], instance[ray] = hits[:, 2], face // len(mesh.faces)
    seen = (instance >= 0) | (view.instance.ravel() >= 0)
    assert seen.sum() > 20_000
    assert (np.abs(depth - view.depth.ravel())[seen] < 1e-4).mean() > 0.999
    assert (instance == view.instance.ravel())[seen].mean() > 0.999


def test_occlusion_is_one_less_what_is_left_of_each_body_alone(tn06, camera):
    mesh = tn06.mesh(tn06.part_object("L", 20))
    rng = np.random.default_rng(2)
    R, t = random_poses(12, 0.03, 0.6, rng)
    view = render_view(camera, mesh, R, t)
    alone = [render_view(camera, mesh, R[i : i + 1], t[i : i + 1]).visible[0] for i in range(12)]
    assert view.silhouette.tolist() == alone
    np.testing.assert_allclose(view.occlusion, 1 - view.visible / alone)
    assert view.occlusion.max() > 0 and view.occlusion.min() >= 0


def test_bodies_far_off_keep_their_precision(cube):
    """Single precision at 30 m would be off by 2 micrometres at best; the body's own frame is not."""
    distant = Camera(80, 60, 20_000.0, 20_000.0, 39.5, 29.5, near=0.1, far=100.0)
    view = view_of(distant, cube, (0, 0, 30.0))
    seen = view.instance == 0
    assert seen.sum() == pixels_in_square(distant, 0.01, 29.99)
    np.testing.assert_allclose(view.depth[seen], 29.99, atol=1e-7)


def test_a_turned_body_shows_its_edge(cube):
    """Turned by 45° about y, the edge that faces the camera is √2 · 10 mm nearer than the centre."""
    R = Rotation.from_euler("y", 45, degrees=True).as_matrix()[None]
    odd = Camera(81, 61, 200.0, 200.0, 40.0, 30.0, 0.1, 2.0)  # a pixel looks along the axis
    view = view_of(odd, cube, (0, 0, 0.5), R=R)
    assert view.depth[30, 40] == pytest.approx(0.5 - 0.01 * math.sqrt(2), abs=1e-6)
    assert view.depth[view.depth > 0].min() == view.depth[30, 40]
