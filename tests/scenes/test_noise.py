"""The depth sensors' noise, in numbers."""

from pathlib import Path

import hydra
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from pnet.geometry.camera import Camera
from pnet.scenes.noise import GaussianNoise, NoNoise, StructuredLightNoise, fill_lost

CONF = Path(__file__).parents[2] / "conf"
PIXELS = 20_000
BASELINE = 0.1
CAMERA = Camera(640, 512, 1500.0, 1400.0, 319.5, 255.5, near=0.3, far=1.0)
FULL = StructuredLightNoise(BASELINE, 0.1, 0.0625, 0.3, 60.0, 10.0, 2, 0.5, 0.01)
SENSORS = [NoNoise(), GaussianNoise(0.001), FULL]


def plane(depth, slope=0.0, count=PIXELS):
    """Points of the plane z = depth + slope x at random pixels."""
    rng = np.random.default_rng(1)
    rays = CAMERA.rays(rng.uniform(0, 639, count), rng.uniform(0, 511, count))
    return (rays * (depth / (1 - slope * rays[:, :1]))).astype(np.float32)


def measure(noise, points, cosine=1.0, edge=255, seed=0):
    """Incidence and edge distance may be one number for all."""
    incidence = np.broadcast_to(np.float32(cosine), len(points))
    edges = np.broadcast_to(np.uint8(edge), len(points))
    return noise(points, incidence, edges, CAMERA, np.random.default_rng(seed))


def lost(noise, **pixels):
    return 1 - measure(noise, plane(0.6), **pixels)[1].mean()


def test_no_noise_leaves_points_as_they_are():
    points = plane(0.6)
    measured, kept = measure(NoNoise(), points)
    assert np.array_equal(measured, points) and measured is not points and kept.all()


def test_gaussian_noise_moves_points_along_their_rays():
    points = plane(0.6)
    measured, kept = measure(GaussianNoise(0.002), points)
    error = measured[:, 2] - points[:, 2]
    assert kept.all()
    assert error.mean() == pytest.approx(0, abs=6e-5)
    assert error.std() == pytest.approx(0.002, rel=0.02)
    assert np.allclose(CAMERA.project(measured), CAMERA.project(points), atol=1e-3)


def test_gaussian_noise_stays_in_the_range():
    z = measure(GaussianNoise(1.0), plane(0.6))[0][:, 2]
    assert z.min() >= np.float32(CAMERA.near) and z.max() <= np.float32(CAMERA.far)


def test_triangulation_without_noise_is_exact():
    points = plane(0.6)
    measured, kept = measure(StructuredLightNoise(BASELINE), points)
    assert np.allclose(measured, points, atol=1e-7) and kept.all()


@pytest.mark.parametrize("depth", [0.4, 0.8])
def test_depth_noise_grows_with_the_squared_distance(depth):
    points = plane(depth)
    measured, _ = measure(StructuredLightNoise(BASELINE, disparity_sigma=0.2), points)
    expected = depth**2 * 0.2 / (1500 * BASELINE)  # 0.21 mm and 0.85 mm
    assert (measured[:, 2] - depth).std() == pytest.approx(expected, rel=0.02)
    assert np.allclose(CAMERA.project(measured), CAMERA.project(points), atol=1e-3)


@pytest.mark.parametrize(("cosine", "factor"), [(0.5, 2.0), (0.2, 5.0), (0.01, 5.0)])
def test_depth_noise_grows_at_grazing_angles_up_to_a_bound(cosine, factor):
    measured, _ = measure(StructuredLightNoise(BASELINE, disparity_sigma=0.1), plane(0.6), cosine)
    expected = factor * 0.6**2 * 0.1 / (1500 * BASELINE)
    assert (measured[:, 2] - 0.6).std() == pytest.approx(expected, rel=0.02)


def test_disparity_comes_in_steps():
    noise = StructuredLightNoise(BASELINE, disparity_sigma=0.3, disparity_step=0.25)
    steps = 1500 * BASELINE / measure(noise, plane(0.6, 0.5))[0][:, 2].astype(np.float64) / 0.25
    assert np.abs(steps - np.rint(steps)).max() < 1e-3
    assert len(np.unique(np.rint(steps))) > 100


def test_a_step_rounds_to_the_nearest_by_hand():
    # disparity 150 / 0.7 = 214.29 pixels, read as 214
    points = np.array([[0.07, 0.0, 0.7]], np.float32)
    measured, _ = measure(StructuredLightNoise(BASELINE, disparity_step=1.0), points)
    assert measured[0] == pytest.approx([15 / 214, 0, 150 / 214])


def test_lateral_noise_in_pixels():
    points = plane(0.6)
    measured, _ = measure(StructuredLightNoise(BASELINE, lateral_sigma=0.4), points)
    shift = CAMERA.project(measured) - CAMERA.project(points)
    assert shift.std(0) == pytest.approx([0.4, 0.4], rel=0.02)
    assert abs(np.corrcoef(shift.T)[0, 1]) < 0.03
    assert np.array_equal(measured[:, 2], points[:, 2])


def test_lateral_noise_is_depth_noise_on_a_slanted_plane():
    slope, depth = 1.0, 0.6
    points = plane(depth, slope)
    measured, _ = measure(StructuredLightNoise(BASELINE, lateral_sigma=0.4), points)
    gap = measured[:, 2] - (depth + slope * measured[:, 0])
    expected = slope * 0.4 / 1500 * np.sqrt((points[:, 2].astype(np.float64) ** 2).mean())
    assert gap.std() == pytest.approx(expected, rel=0.02)  # 0.16 mm


@pytest.mark.parametrize(
    ("angle", "share"), [(0, 0.0), (49, 0.0), (55, 0.25), (60, 0.5), (65, 0.75), (71, 1.0)]
)
def test_pixels_are_missing_at_grazing_angles(angle, share):
    noise = StructuredLightNoise(BASELINE, max_incidence_deg=60, incidence_softness_deg=10)
    assert lost(noise, cosine=np.cos(np.radians(angle))) == pytest.approx(share, abs=0.012)


@pytest.mark.parametrize(("angle", "share"), [(59.9, 0.0), (60.1, 1.0)])
def test_without_softness_the_limit_is_sharp(angle, share):
    assert (
        lost(StructuredLightNoise(BASELINE, max_incidence_deg=60), cosine=np.cos(np.radians(angle))) == share
    )


@pytest.mark.parametrize(("edge", "share"), [(0, 0.4), (1, 0.4), (2, 0.0), (255, 0.0)])
def test_pixels_are_missing_at_edges(edge, share):
    noise = StructuredLightNoise(BASELINE, edge_pixels=2, edge_loss=0.4)
    assert lost(noise, edge=edge) == pytest.approx(share, abs=0.012)


def test_losses_add_up_as_independent_ones():
    noise = StructuredLightNoise(
        BASELINE, max_incidence_deg=60, incidence_softness_deg=5, edge_pixels=1, edge_loss=0.4, dropout=0.2
    )
    assert lost(noise, cosine=0.5, edge=0) == pytest.approx(1 - 0.5 * 0.6 * 0.8, abs=0.012)


def test_depths_beyond_the_range_are_lost():
    noise = StructuredLightNoise(BASELINE, disparity_sigma=1.0)
    measured, kept = measure(noise, plane(1.0))
    assert kept.mean() == pytest.approx(0.5, abs=0.012)
    assert np.array_equal(kept, measured[:, 2] <= 1.0)


@pytest.mark.parametrize("noise", SENSORS)
def test_the_same_seed_gives_the_same_points(noise):
    points = plane(0.6, count=500)
    first, second, other = (measure(noise, points, 0.5, 1, seed) for seed in (3, 3, 4))
    assert np.array_equal(first[0], second[0]) and np.array_equal(first[1], second[1])
    assert np.array_equal(first[0], other[0]) == isinstance(noise, NoNoise)


@pytest.mark.parametrize("noise", SENSORS)
def test_the_input_is_not_changed(noise):
    points = plane(0.6, count=500)
    before = points.copy()
    measured, _ = measure(noise, points, 0.5, 1)
    measured += 1
    assert np.array_equal(points, before)


@pytest.mark.parametrize("noise", [*SENSORS, StructuredLightNoise(BASELINE)])
def test_draws_do_not_depend_on_the_points(noise):
    left = []
    for points, cosine, edge in ((plane(0.4, count=50), 1.0, 255), (plane(0.9, 1.0, 50), 0.0, 0)):
        rng = np.random.default_rng(0)
        noise(points, np.full(50, cosine), np.full(50, edge), CAMERA, rng)
        left.append(rng.random())
    assert left[0] == left[1]


UNIT = st.floats(0, 1, width=32)
PIXEL = st.tuples(st.floats(-2, 2, width=32), st.floats(-2, 2, width=32), UNIT, UNIT, st.integers(0, 255))


@given(
    st.sampled_from([*SENSORS, GaussianNoise(1e6), StructuredLightNoise(BASELINE, 1e6, 1e3, 10.0)]),
    st.lists(PIXEL, max_size=20),
    st.integers(0, 2**32),
)
def test_measured_points_are_always_in_front_of_the_camera(noise, pixels, seed):
    x, y, depth, incidence, edge = np.array(pixels, np.float32).reshape(-1, 5).T
    points = np.stack([x, y, np.clip(0.3 + 0.7 * depth, 0.3, 1.0)], -1).astype(np.float32)
    measured, kept = noise(points, incidence, edge.astype(np.uint8), CAMERA, np.random.default_rng(seed))
    assert measured.shape == points.shape and measured.dtype == np.float32
    assert kept.shape == (len(points),) and kept.dtype == bool
    assert np.isfinite(measured).all() and (measured[:, 2] > 0).all()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("baseline", 0.0),
        ("baseline", float("nan")),
        ("disparity_sigma", -0.1),
        ("disparity_step", float("inf")),
        ("lateral_sigma", float("nan")),
        ("max_incidence_deg", 91.0),
        ("incidence_softness_deg", -1.0),
        ("edge_pixels", 11),
        ("edge_loss", 1.1),
        ("dropout", -0.1),
    ],
)
def test_settings_out_of_range_are_named(key, value):
    with pytest.raises(ValueError, match=rf"noise\.{key} is {value}, expected"):
        StructuredLightNoise(**{"baseline": BASELINE, key: value})


def test_a_negative_sigma_is_named():
    with pytest.raises(ValueError, match=r"noise\.sigma is -1, expected at least 0"):
        GaussianNoise(-1)


@pytest.mark.parametrize(
    ("kept", "count", "indices"),
    [
        ([1, 0, 1, 1, 0, 1], 3, [0, 2, 3]),
        ([1, 0, 1, 1, 0, 1], 4, [0, 2, 3, 5]),
        ([0, 1, 0, 1, 0, 0], 5, [1, 3, 1, 3, 1]),
        ([0, 0, 1], 1, [2]),
    ],
)
def test_fill_lost_by_hand(kept, count, indices):
    filled = fill_lost(np.array(kept, bool), count)
    assert filled.tolist() == indices and filled.dtype == np.int64


def test_a_scene_without_points_is_named():
    with pytest.raises(ValueError, match="lost every point of pile_0003, drop 7"):
        fill_lost(np.zeros(5, bool), 5, "pile_0003, drop 7")


@pytest.mark.parametrize(
    ("name", "kind"),
    [("none", NoNoise), ("gaussian", GaussianNoise), ("structured_light", StructuredLightNoise)],
)
def test_every_choice_of_conf(name, kind):
    assert isinstance(hydra.utils.instantiate(OmegaConf.load(CONF / "noise" / f"{name}.yaml")), kind)


def test_no_choice_of_conf_is_forgotten():
    assert {path.stem for path in (CONF / "noise").iterdir()} == {"none", "gaussian", "structured_light"}


@pytest.mark.parametrize("path", sorted((CONF / "camera").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_camera_of_conf_looks_straight_ahead(path):
    camera = hydra.utils.instantiate(OmegaConf.load(path))
    assert isinstance(camera, Camera)
    assert (camera.cx, camera.cy) == ((camera.width - 1) / 2, (camera.height - 1) / 2)


def test_the_structured_light_of_conf_at_the_bin():
    noise = hydra.utils.instantiate(OmegaConf.load(CONF / "noise" / "structured_light.yaml"))
    measured, kept = measure(noise, plane(0.65))
    # √(0.1² + 0.0625² / 12) pixels of disparity: noise and rounding
    assert (measured[:, 2] - 0.65).std() == pytest.approx(0.65**2 * 0.1016 / 150, rel=0.02)
    assert kept.mean() == pytest.approx(0.99, abs=0.005)
