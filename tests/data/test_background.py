"""What of a view is no part: by a box, by the floor's plane, by an image of the empty bin."""

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image
from scipy.spatial.transform import Rotation
from tests.conftest import CONF

from pnet.data.background import EmptyBin, Limits, NoBackground, PlaneBackground
from pnet.geometry.camera import Camera
from pnet.scenes.rendering import render_view

CAMERA = Camera(240, 192, 560.0, 560.0, 119.5, 95.5, near=0.3, far=1.0)
TINY = Camera(5, 4, 10.0, 10.0, 2.0, 1.5)
NOISE = 0.0005


def floor_image(camera, tilt=0.0, distance=0.65):
    """(h, w) depth of a plane that meets the axis at a distance, and its (3,) normal towards the camera."""
    normal = Rotation.from_euler("xy", [tilt, tilt / 2], degrees=True).apply([0, 0, -1.0])
    v, u = np.mgrid[: camera.height, : camera.width]
    return distance * normal[2] / (camera.rays(u, v) @ normal), normal


def part_image(part, tilt):
    """Twelve bodies that rest on a tilted floor, and the floor: depth (h, w), which pixels show bodies."""
    floor, normal = floor_image(CAMERA, tilt)
    mesh = part.mesh(part.part_object("L", 0))
    R = Rotation.random(12, np.random.default_rng(0)).as_matrix()
    column, row = np.arange(12) % 4 - 1.5, np.arange(12) // 4 - 1
    t = np.stack([0.05 * column, 0.05 * row, np.full(12, 0.65)], -1)
    lowest = (np.einsum("nij,vj->nvi", R, mesh.vertices) @ normal).min(1)
    t -= ((t - np.array([0, 0, 0.65])) @ normal + lowest)[
        :, None
    ] * normal  # the lowest vertex touches the floor
    view = render_view(CAMERA, mesh, R, t)
    body = (view.instance >= 0) & (view.depth < floor)
    return np.where(body, view.depth, floor), body, (normal, floor)


def cloud_of(depth, camera=CAMERA, noise=0.0, seed=0):
    """Points (n, 3) and pixels (n,) of a depth image."""
    noisy = depth + noise * np.random.default_rng(seed).standard_normal(depth.shape)
    pixels = np.flatnonzero(np.isfinite(depth))
    return camera.depth_to_points(noisy).reshape(-1, 3)[pixels], pixels


def grid(count=60, size=0.1):
    """(count², 2) x and y of a square."""
    return np.stack(np.meshgrid(*[np.linspace(-size, size, count)] * 2), -1).reshape(-1, 2)


def plane(height=0.0, tilt=0.0, xy=None):
    """Points on a plane that is tilted about y, at a height above z = 0.6 along its normal."""
    xy = grid() if xy is None else xy
    points = np.column_stack([xy, np.full(len(xy), -height)])
    return Rotation.from_euler("y", tilt, degrees=True).apply(points) + np.array([0, 0, 0.6])


def test_without_background_every_point_is_kept():
    assert NoBackground()(np.zeros((4, 3)), None, None).tolist() == [True] * 4


@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_the_plane_removes_the_floor_and_leaves_the_bodies(part, tilt):
    depth, body, (normal, _) = part_image(part, tilt)
    points, pixels = cloud_of(depth, noise=NOISE)
    before = points.copy()
    kept = PlaneBackground(distance=0.003)(points, pixels, CAMERA)
    exact, _ = cloud_of(depth)
    height = (exact - [0, 0, 0.65]) @ normal
    bodies = body.reshape(-1)
    assert bodies.sum() > 1500
    assert kept[~bodies].mean() <= 0.001
    assert kept[bodies & (height > 0.003 + 4 * NOISE)].mean() >= 0.99
    low = bodies & (height < 0.003 - 4 * NOISE)
    assert kept[low].sum() <= 0.01 * low.sum()
    np.testing.assert_array_equal(points, before)


def test_the_plane_needs_neither_pixels_nor_single_points_in_double_precision(part):
    depth, body, _ = part_image(part, 10.0)
    points, pixels = cloud_of(depth, noise=NOISE)
    kept = PlaneBackground()(points, pixels, CAMERA)
    shuffled = np.random.default_rng(1).permutation(len(points))
    again = PlaneBackground()(points[shuffled].astype(np.float32), None, None)
    assert (again == kept[shuffled]).mean() > 0.998  # other planes are tried
    assert (PlaneBackground(seed=0)(points, None, None) == kept).all()
    assert 0.8 < kept.sum() / body.sum() < 1.0


@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_heights_are_measured_along_the_normal_of_a_plane_through_all_of_the_floor(tilt):
    heights = [0.0029, 0.0031, -0.0029, -0.05]
    spots = np.array(
        [[-0.1, -0.1], [-0.1, 0.1], [0.1, -0.1], [0.1, 0.1]]
    )  # a wrong tilt shows at the corners
    noise = np.clip(np.random.default_rng(0).normal(0, NOISE, 3600), -0.002, 0.002)
    points = np.concatenate([plane(noise, tilt), *(plane(height, tilt, spots) for height in heights)])
    kept = PlaneBackground(distance=0.003)(points, None, None)
    assert kept[3600:].reshape(4, 4).tolist() == [[False] * 4, [True] * 4, [False] * 4, [False] * 4]
    assert not kept[:3600].any()


@pytest.mark.parametrize("border", [0.02, 0.04, 0.07])
def test_a_layer_of_parts_larger_than_the_floor_is_kept_where_the_floor_is_seen_behind_it(border):
    """The layer fills one side of the bin, so that a slanted plane could rest on both."""
    xy = grid()
    layer = xy[:, 0] < border
    points = np.concatenate([plane(0.02, 0, xy[layer]), plane(0, 0, xy[~layer])])
    points[:, 2] += NOISE * np.random.default_rng(0).standard_normal(len(points))
    kept = PlaneBackground()(points, None, None)
    assert 0.55 < layer.mean() < 0.9
    assert kept[: layer.sum()].all() and not kept[layer.sum() :].any()


def test_a_closed_layer_with_nothing_behind_it_passes_for_the_floor():
    assert not PlaneBackground()(plane(0.02), None, None).any()


def test_a_bin_so_full_that_its_floor_is_hardly_seen_is_an_error():
    points = plane(np.random.default_rng(0).uniform(0.0, 0.1, 3600))
    with pytest.raises(ValueError, match=r"found no floor.*use background=limits or background=empty_bin"):
        PlaneBackground()(points, None, None)
    points[::8] = plane()[::8]  # an eighth shows the floor
    kept = PlaneBackground()(points, None, None)
    assert not kept[::8].any() and kept.mean() > 0.8


def test_a_table_below_the_bin_must_be_cut_off():
    xy = grid()
    table = np.abs(xy).max(1) > 0.07
    floor = plane(0.02, 0, xy[~table])
    points = np.concatenate([floor, plane(0, 0, xy[table]), plane(0.05, 0, np.zeros((1, 2)))])
    assert PlaneBackground()(points, None, None)[: len(floor)].all()
    kept = PlaneBackground(x=(-0.069, 0.069), y=(-0.069, 0.069))(points, None, None)
    assert kept.tolist() == [False] * (len(points) - 1) + [True]
    kept = PlaneBackground(z=(0.1, 0.59))(points, None, None)
    assert kept.tolist() == [False] * (len(points) - 1) + [True]


def test_a_plane_that_is_too_steep_is_no_floor():
    points = plane(tilt=40)
    with pytest.raises(ValueError, match=r"found no floor.*tilted by 30 degrees at most"):
        PlaneBackground()(points, None, None)
    assert not PlaneBackground(max_tilt_deg=41)(points, None, None).any()


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), plane()[:2], np.tile(plane()[:1], (9, 1)), plane(0, 9, grid()[:60])],
)
def test_points_that_span_no_plane_are_an_error(points):
    with pytest.raises(ValueError, match="background=plane found no floor"):
        PlaneBackground()(points, None, None)


def test_limits_keep_a_box_with_its_borders():
    points = np.array([[0, 0, 1], [0.1, 0, 1], [0.11, 0, 1], [0, -0.2, 1], [0, -0.21, 1], [0, 0, 1.5]])
    kept = Limits(x=[-0.1, 0.1], y=(-0.2, 0.2), z=None)(points, None, None)
    assert kept.tolist() == [True, True, False, True, False, True]
    assert Limits(z=[0.5, 1.2])(points, None, None).tolist() == [True] * 5 + [False]


def write_depth(path, depth):
    """Metres as tenths of a millimetre in 16 bits."""
    Image.fromarray(np.rint(np.nan_to_num(depth) * 10_000).astype(np.uint16)).save(path)


def test_what_is_nearer_than_the_empty_bin_is_kept(tmp_path):
    empty, seen = np.full((4, 5), 0.6), np.full((4, 5), 0.6)
    seen[0, 0], seen[1, 1], seen[2, 2], seen[3, 3] = 0.5965, 0.5975, 0.65, 0.3
    write_depth(tmp_path / "empty.png", empty)
    background = EmptyBin(str(tmp_path / "empty.png"), distance=0.003, scale=0.0001)
    points, pixels = cloud_of(seen, TINY)
    expected = np.zeros((4, 5), bool)
    expected[0, 0] = expected[3, 3] = True
    np.testing.assert_array_equal(background(points, pixels, TINY), expected.reshape(-1))
    some = np.array([18, 0, 7])
    assert background(points[some], some, TINY).tolist() == [True, True, False]


def test_the_empty_bin_is_read_once(tmp_path):
    write_depth(tmp_path / "empty.png", np.full((4, 5), 0.6))
    background = EmptyBin(str(tmp_path / "empty.png"), scale=0.0001)
    points, pixels = cloud_of(np.full((4, 5), 0.5), TINY)
    assert background(points, pixels, TINY).all()
    (tmp_path / "empty.png").unlink()
    assert background(points, pixels, TINY).all()


def test_of_the_empty_bin_the_nearest_depth_around_a_pixel_counts(tmp_path):
    """A hole of a pixel is filled, a step may move by a pixel, a large hole keeps what is there."""
    empty = np.full((4, 5), np.nan)
    empty[:, :2], empty[1, 1], empty[3, 0] = 0.6, np.nan, 0.5
    write_depth(tmp_path / "empty.png", empty)
    points, pixels = cloud_of(np.full((4, 5), 0.55), TINY)
    arguments = {"image": str(tmp_path / "empty.png"), "scale": 0.0001}
    kept = EmptyBin(**arguments)(points, pixels, TINY).reshape(4, 5)
    expected = np.ones((4, 5), bool)
    expected[2:, :2] = False
    np.testing.assert_array_equal(kept, expected)
    expected[:] = True
    expected[3, 0] = False
    np.testing.assert_array_equal(
        EmptyBin(**arguments, reach=0)(points, pixels, TINY).reshape(4, 5), expected
    )


def test_the_empty_bins_numbers_may_count_from_an_offset(tmp_path):
    write_depth(tmp_path / "empty.png", np.full((4, 5), 0.1))
    background = EmptyBin(str(tmp_path / "empty.png"), scale=0.0001, offset=0.5)
    for depth, kept in ((0.5965, True), (0.5975, False)):
        points, pixels = cloud_of(np.full((4, 5), depth), TINY)
        assert background(points, pixels, TINY).tolist() == [kept] * 20


@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_the_empty_bin_removes_a_noisy_floor_and_leaves_the_bodies(part, tilt, tmp_path):
    depth, body, (_, floor) = part_image(part, tilt)
    noisy = floor + NOISE * np.random.default_rng(7).standard_normal(floor.shape)
    noisy[np.random.default_rng(8).random(floor.shape) < 0.02] = np.nan
    write_depth(tmp_path / "empty.png", noisy)
    background = EmptyBin(str(tmp_path / "empty.png"), distance=0.003, scale=0.0001)
    points, pixels = cloud_of(depth, noise=NOISE)
    kept = background(points, pixels, CAMERA).reshape(depth.shape)
    assert kept[~body].mean() <= 0.001
    assert kept[body & (floor - depth > 0.003 + 8 * NOISE)].mean() >= 0.99


def test_the_empty_bin_may_hold_distances_from_the_camera(tmp_path):
    v, u = np.mgrid[:4, :5]
    np.save(tmp_path / "empty.npy", 0.6 * np.linalg.norm(TINY.rays(u, v), axis=-1))
    points, pixels = cloud_of(np.full((4, 5), 0.599), TINY)
    planar = EmptyBin(str(tmp_path / "empty.npy"), radial=True)(points, pixels, TINY)
    assert not planar.any()
    assert EmptyBin(str(tmp_path / "empty.npy"))(points, pixels, TINY).sum() == 8


def test_the_empty_bin_must_fit_what_it_is_compared_with(tmp_path):
    write_depth(tmp_path / "empty.png", np.full((4, 5), 0.6))
    background = EmptyBin(str(tmp_path / "empty.png"))
    with pytest.raises(ValueError, match="needs a depth image and its camera, not a cloud"):
        background(np.ones((1, 3)), None, TINY)
    with pytest.raises(ValueError, match=r"empty\.png: has 5 x 4 pixels, the camera 240 x 192"):
        background(np.ones((1, 3)), np.zeros(1, np.int64), CAMERA)
    with pytest.raises(FileNotFoundError, match=r"none\.png: no such image file"):
        EmptyBin(str(tmp_path / "none.png"))(np.ones((1, 3)), np.zeros(1, np.int64), TINY)
    write_depth(tmp_path / "dark.png", np.zeros((4, 5)))
    with pytest.raises(ValueError, match=r"background.image: .*dark\.png: no pixel was measured"):
        EmptyBin(str(tmp_path / "dark.png"))(np.ones((1, 3)), np.zeros(1, np.int64), TINY)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Limits(), r"background\.x, background\.y and background\.z are all null"),
        (lambda: Limits(x=[0.2, 0.1]), r"background\.x is \[0\.2, 0\.1\], expected \[smallest, largest\]"),
        (lambda: Limits(y=[-200, 0.1]), r"background\.y is \[-200, 0\.1\]"),
        (lambda: Limits(z=[-0.1, 0.1]), r"background\.z is .* both 0 to 100"),
        (lambda: Limits(z=0.5), r"background\.z is 0\.5"),
        (lambda: PlaneBackground(distance=0), r"background\.distance is 0, expected more than 0"),
        (lambda: PlaneBackground(max_tilt_deg=90), r"background\.max_tilt_deg is 90, expected 0 to 80"),
        (lambda: PlaneBackground(min_share=2), r"background\.min_share is 2, expected 0 to 1"),
        (lambda: PlaneBackground(max_behind=-1), r"background\.max_behind is -1"),
        (lambda: PlaneBackground(z=[1]), r"background\.z is \[1\]"),
        (lambda: PlaneBackground(seed=-1), r"background\.seed is -1"),
        (lambda: EmptyBin("a.png", distance=float("nan")), r"background\.distance is nan"),
        (lambda: EmptyBin("a.png", scale=0), r"background\.scale is 0, expected more than 0"),
        (lambda: EmptyBin("a.png", reach=-1), r"background\.reach is -1, expected 0 to 100"),
    ],
)
def test_a_wrong_setting_is_an_error_that_names_its_key(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("name", "kind", "given"),
    [
        ("none", NoBackground, {}),
        ("plane", PlaneBackground, {}),
        ("empty_bin", EmptyBin, {"image": "a.png"}),
        ("limits", Limits, {"z": [0.3, 0.64]}),
    ],
)
def test_every_config_has_the_defaults_of_its_class(name, kind, given):
    node = OmegaConf.merge(OmegaConf.load(CONF / "background" / f"{name}.yaml"), given)
    fields = OmegaConf.to_container(node)
    assert fields.pop("_target_") == f"{kind.__module__}.{kind.__qualname__}"
    assert kind(**fields) == kind(**given)


def test_an_empty_bin_of_another_scale_is_told_and_not_taken_for_one_far_away(tmp_path):
    Image.fromarray(np.full((TINY.height, TINY.width), 6500, np.uint16)).save(tmp_path / "empty.png")
    points, pixels = np.tile([0.0, 0.0, 0.6], (3, 1)), np.arange(3)
    with pytest.raises(ValueError, match=r"empty.png: the median depth is 65 m.*background[.]scale"):
        EmptyBin(str(tmp_path / "empty.png"), scale=0.01)(points, pixels, TINY)
