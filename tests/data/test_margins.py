"""How much worse the runner-up among the equivalent keypoints is."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.conftest import load_part

from pnet.data.targets import instance_keypoints, nearest_keypoints, point_labels
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.parts.tn16 import TN16
from pnet.parts.tn42 import TN42
from pnet.records import Scene

CAMERA, CANONICAL, POINT = (KeypointChoice(rule) for rule in KeypointRule)
INF = math.inf


@pytest.fixture(scope="module")
def tn16():
    return TN16({"r": [8], "h": [20], "c": [6]})


@pytest.fixture(scope="module")
def tn42():
    return TN42({"l": [36], "a": [13], "w": [11]})


@pytest.fixture
def one_body(make_scene):
    """Makes a scene of one body of a given size, tilted about x, with points given in the part frame."""

    def make(part, size_mm, tilt: float = 0.0, points_mm=((0.0, 0.0, 0.0),), R=None) -> Scene:
        R = Rotation.from_euler("x", tilt, degrees=True).as_matrix() if R is None else R
        t = np.array([0.02, -0.01, 0.6])
        points = (np.array(points_mm) / 1000 @ R.T + t).astype(np.float32)
        return replace(
            make_scene(part, bodies=1, points=1),
            R=R[None],
            t=t[None],
            parameters=np.array([size_mm]) / 1000,
            points=points,
            instance=np.zeros(len(points), int),
        )

    return make


def camera_margin(part, scene, choice=CAMERA) -> list[float]:
    """Of the only instance, mm."""
    return (1000 * instance_keypoints(scene, part.chain, choice)[1][0]).tolist()


def point_margin(part, scene) -> list[list[float]]:
    """Of every point, mm."""
    return (1000 * nearest_keypoints(scene, part.chain)[1]).tolist()


@pytest.mark.parametrize("tilt", [0, 30, 60, 90])
def test_camera_a_face_pair_differs_by_its_distance_in_depth(tn06, one_body, tilt):
    """Faces h apart: h cos(tilt) in z. The hole's circle spans 2 r sin(tilt), of which half counts.

    What hangs on the face is no surer than the face.
    """
    face, hole, _ = camera_margin(tn06, one_body(tn06, (4, 11, 14), tilt))
    depth, half_range = 11 * math.cos(math.radians(tilt)), 4 * math.sin(math.radians(tilt))
    assert face == pytest.approx(depth, abs=1e-9)
    assert hole == pytest.approx(min(depth, half_range), abs=1e-9)


def test_camera_a_vertexs_runner_up_is_its_neighbour(tn06, one_body):
    """Tilted by 30° the vertices' z are −14 sin(60° k) sin 30°: the two highest are level, a tie.

    Turned about z by 10° first they lie at 70° and 130°, the two highest.
    """
    _, _, level = camera_margin(tn06, one_body(tn06, (4, 11, 14), 30))
    assert level == pytest.approx(0, abs=1e-9)
    R = Rotation.from_euler("zx", [10, 30], degrees=True).as_matrix()
    _, _, vertex = camera_margin(tn06, one_body(tn06, (4, 11, 14), R=R))
    expected = 14 * 0.5 * (math.sin(math.radians(70)) - math.sin(math.radians(130)))
    assert vertex == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("tilt", [0, 20, 90, 180])
def test_camera_a_single_candidate_has_no_runner_up(tn34, one_body, tilt):
    base, top, rim = camera_margin(tn34, one_body(tn34, (12, 10), tilt))
    assert base == top == INF
    assert rim == pytest.approx(12 * math.sin(math.radians(tilt)), abs=1e-9)


def test_camera_the_other_direction_has_the_other_margin(tn34, one_body):
    """Along y a flange seen along its axis is unambiguous."""
    sideways = KeypointChoice(KeypointRule.CAMERA, (0, 1, 0))
    assert camera_margin(tn34, one_body(tn34, (12, 10), 0), sideways)[2] == pytest.approx(12)
    assert camera_margin(tn34, one_body(tn34, (12, 10), 90), sideways)[2] == pytest.approx(0, abs=1e-9)


def test_camera_what_hangs_on_a_chosen_end_follows_it(tn16, one_body):
    end, rim, apex = camera_margin(tn16, one_body(tn16, (8, 20, 6), 75))
    depth = 20 * math.cos(math.radians(75))  # 5.18 mm, less than the rim's 7.73 mm
    assert [end, rim, apex] == pytest.approx([depth] * 3, abs=1e-9)


def test_camera_a_mirror_pair_differs_by_its_distance_in_depth(tn42, one_body):
    foot, side, toe, head, tip = camera_margin(tn42, one_body(tn42, (36, 13, 11), 50))
    assert foot == toe == head == tip == INF
    assert side == pytest.approx(11 * math.sin(math.radians(50)), abs=1e-9)


def test_canonical_labels_have_no_runner_up(part, make_scene):
    scene = make_scene(part)
    assert bool(instance_keypoints(scene, part.chain, CANONICAL)[1].isinf().all())
    assert bool(point_labels(scene, part.chain, CANONICAL)["margin"].isinf().all())


def test_point_distances_of_a_flanges_rim(tn34, one_body):
    """3 mm from the base's centre the rim is 9 mm away, its far side 15 mm; on the axis they tie."""
    base = -1000 * tn34.centroid(np.array([[0.012, 0.010]]))[0, 2]
    scene = one_body(tn34, (12, 10), 40, [(3, 0, base), (0, 5, base + 4), (0, 0, base)])
    first, second, third = point_margin(tn34, scene)
    assert first == [INF, INF, pytest.approx(3, abs=1e-3)]
    assert second[2] == pytest.approx((math.hypot(17, 4) - math.hypot(7, 4)) / 2, abs=1e-3)
    assert third[2] == pytest.approx(0, abs=1e-3)


def test_point_distances_of_a_nut(tn06, one_body):
    """4 mm from the axis towards a vertex, in the upper face; and between the faces, where they tie."""
    scene = one_body(tn06, (2.5, 17, 14), 25, [(4, 0, 8.5), (4, 0, 0)])
    (face, hole, vertex), middle = point_margin(tn06, scene)
    assert face == pytest.approx(math.hypot(4, 17) - 4, abs=1e-3)
    assert hole == pytest.approx((6.5 - 1.5) / 2, abs=1e-3)
    assert vertex == pytest.approx(math.hypot(4 - 7, 14 * math.sqrt(0.75)) - 10, abs=1e-3)
    assert middle == pytest.approx([0, 0, 0], abs=1e-3)


def test_point_distances_of_a_bars_sides(tn42, one_body):
    """Of the corners, which it might be taken for, foot is nearest to the side's middle, head is next."""
    foot, side, toe, head, tip = point_margin(tn42, one_body(tn42, (36, 13, 11), 25, [(0, 5.5, 0)]))[0]
    x, z = 36 / 3 * 25 / 19, (13**2 + 13 * 6 + 6**2) / 57  # the centroid, from the foot
    lead = math.hypot(x, 5.5, 13 - z) - math.hypot(x, 5.5, z)
    assert [foot, toe, head, tip] == pytest.approx([lead] * 4, abs=1e-3)
    assert side == pytest.approx(11, abs=1e-3)


def test_point_labels_halfway_between_the_ends_are_a_tie(tn42, one_body):
    """A point of the lower face, as far from foot as from toe; then 3 mm nearer to the foot."""
    x, z = 36 / 3 * 25 / 19, (13**2 + 13 * 6 + 6**2) / 57
    scene = one_body(tn42, (36, 13, 11), 65, [(18 - x, 2, -z), (15 - x, 2, -z)])
    tie, beside = point_margin(tn42, scene)
    assert [tie[i] for i in (0, 2, 3, 4)] == pytest.approx([0] * 4, abs=1e-3)
    lead = math.hypot(15, 2, 13) - math.hypot(15, 2)  # head comes next
    assert [beside[i] for i in (0, 2, 3, 4)] == pytest.approx([lead] * 4, abs=1e-3)
    for (_, side, *_), along in ((tie, 18 - x), (beside, 15 - x)):
        assert side == pytest.approx(math.hypot(along, 7.5, z) - math.hypot(along, 3.5, z), abs=1e-3)


@pytest.mark.parametrize("name", ["tn06", "tn34", "tn42"])
@pytest.mark.parametrize("choice", [CAMERA, POINT], ids=["camera", "point"])
def test_a_keypoint_is_no_surer_than_what_it_hangs_on(name, make_scene, choice):
    part = load_part(name)
    margin = point_labels(make_scene(part, bodies=20, points=300), part.chain, choice)["margin"]
    assert float(margin.min()) >= 0
    for i, reference in enumerate(part.chain.reference):
        if reference > 0:
            assert bool((margin[:, i] <= margin[:, reference - 1]).all())
