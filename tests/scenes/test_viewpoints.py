"""Places of the camera: looking at the middle of the floor, as far and as tilted as asked."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from pnet.scenes.viewpoints import Viewpoints

AROUND = Viewpoints(distance=(0.5, 0.7), tilt=(10, 35), turn=True)


def draws(view: Viewpoints, count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    R, t = zip(*(view.draw(rng) for _ in range(count)), strict=True)
    return np.array(R), np.array(t)


def test_above_is_exactly_straight_down_whatever_the_chance():
    for seed in range(5):
        R, t = Viewpoints().draw(np.random.default_rng(seed))
        assert R.tolist() == np.diag([1.0, -1.0, -1.0]).tolist()
        assert t.tolist() == [0.0, 0.0, 0.65]


def test_seen_from_above_x_goes_right_y_up_and_heights_come_nearer():
    R, t = Viewpoints().draw(np.random.default_rng(0))
    world = np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0, 0, 0]])
    seen = world @ R.T + t
    np.testing.assert_allclose(
        seen, [[0.1, 0, 0.65], [0, -0.1, 0.65], [0, 0, 0.55], [0, 0, 0.65]], atol=1e-15
    )


def test_a_tilted_camera_without_turns_by_hand():
    """60 degrees about its own x axis: it stands at the height d cos 60° and looks along world y."""
    R, t = Viewpoints(distance=(2.0, 2.0), tilt=(60, 60)).draw(np.random.default_rng(0))
    centre = -R.T @ t
    np.testing.assert_allclose(np.abs(centre), [0, 2 * math.sqrt(0.75), 1.0], atol=1e-12)
    assert centre[2] > 0
    np.testing.assert_allclose(R[0], [1, 0, 0], atol=1e-12)  # the image's x is the world's


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0.1, 5),
    st.floats(0, 2),
    st.floats(0, 60),
    st.floats(0, 29),
    st.booleans(),
    st.integers(0, 2**32),
)
def test_the_optical_axis_goes_through_the_middle_of_the_floor_at_the_distance(
    near, deeper, upright, more, turn, seed
):
    view = Viewpoints((near, near + deeper), (upright, upright + more), turn)
    R, t = view.draw(np.random.default_rng(seed))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    assert t[0] == t[1] == 0 and near <= t[2] <= near + deeper  # where the world's origin is seen
    centre = -R.T @ t
    assert np.linalg.norm(centre) == pytest.approx(t[2])
    tilt = np.degrees(np.arccos(min(centre[2] / t[2], 1)))
    assert upright - 1e-5 <= tilt <= upright + more + 1e-5
    np.testing.assert_allclose(R[2], -centre / t[2], atol=1e-12)


def test_distance_tilt_direction_and_roll_are_uniform():
    R, t = draws(AROUND, 1500)
    centre = -np.einsum("nij,ni->nj", R, t)
    tilt = np.degrees(np.arccos(centre[:, 2] / t[:, 2]))
    azimuth = np.arctan2(centre[:, 1], centre[:, 0])
    roll = np.arctan2(R[:, 0, 2], R[:, 1, 2])  # where the image has the vertical
    assert kstest(t[:, 2], "uniform", (0.5, 0.2)).pvalue > 0.01
    assert kstest(tilt, "uniform", (10, 25)).pvalue > 0.01
    for angle in (azimuth, roll):
        assert kstest(angle, "uniform", (-np.pi, 2 * np.pi)).pvalue > 0.01
    assert np.abs(np.corrcoef([t[:, 2], tilt, azimuth, roll]) - np.eye(4)).max() < 0.1


def test_without_turns_the_images_x_is_the_worlds():
    R, _ = draws(Viewpoints(tilt=(0, 40)), 20)
    np.testing.assert_allclose(R[:, 0], np.broadcast_to([1.0, 0, 0], (20, 3)), atol=1e-15)
    assert np.ptp(R[:, 2, 2]) > 0.1


def test_the_generator_alone_decides():
    (R, t), (R_again, t_again), (R_other, _) = (draws(AROUND, 3, seed) for seed in (1, 1, 2))
    assert R.tobytes() == R_again.tobytes() and t.tobytes() == t_again.tobytes()
    assert np.abs(R - R_other).max() > 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"distance": (0.7, 0.6)}, r"view.distance is \[0.7, 0.6\], expected \[smallest, largest\]"),
        ({"distance": (-0.1, 0.6)}, r"view.distance is \[-0.1, 0.6\]"),
        ({"distance": (0.6,)}, r"view.distance is \[0.6\]"),
        ({"distance": (0.6, math.inf)}, r"view.distance is \[0.6, inf\]"),
        ({"distance": (math.nan, math.nan)}, r"view.distance is \[nan, nan\]"),
        ({"distance": (0, 0.6)}, r"view.distance is \[0, 0.6\], .* both more than 0"),
        ({"distance": 0.65}, r"view.distance is 0.65, expected \[smallest, largest\]"),
        ({"distance": (0.6, "far")}, r"view.distance is \[0.6, 'far'\]"),
        ({"tilt": (0, 90)}, r"view.tilt is \[0, 90\]"),
        ({"tilt": (20, 10)}, r"view.tilt is \[20, 10\], expected \[smallest, largest\]"),
        ({"tilt": (-5, 10)}, r"view.tilt is \[-5, 10\]"),
        ({"tilt": (1, 2, 3)}, r"view.tilt is \[1, 2, 3\]"),
    ],
)
def test_a_range_that_makes_no_sense_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Viewpoints(**settings)
