"""Labels: whose instance, which of the equivalent keypoints."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.conftest import Marble, load_part

from pnet.data.augmentation import rotate_about_view_axis
from pnet.data.targets import instance_keypoints, point_labels, pose_labels, pose_scale
from pnet.geometry.camera import Camera
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.parts.tn16 import TN16
from pnet.parts.tn42 import TN42
from pnet.records import Scene, SceneId

R, H = 0.012, 0.010  # metres
CAMERA = KeypointChoice(KeypointRule.CAMERA)
CANONICAL = KeypointChoice(KeypointRule.CANONICAL)
POINT = KeypointChoice(KeypointRule.POINT)
UP_ON = np.eye(3)  # the flange's axis along the view axis
LYING = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the flange's axis towards the camera's −y


def two_flanges() -> Scene:
    """One flange seen along its axis, one lying; three points, the second flange's first."""
    return Scene(
        points=np.array([[0.1, 0, 0.6], [0, 0, 0.6], [0.1, 0.01, 0.6]], np.float32),
        instance=np.array([1, 0, 1]),
        R=np.stack([UP_ON, LYING]),
        t=np.array([[0, 0, 0.6], [0.1, 0, 0.61]]),
        parameters=np.array([[R, H], [R, H]]),
        visibility=np.array([0.25, 0.75]),
        occlusion=np.zeros(2),
        camera=Camera(8, 8, 10.0, 10.0, 3.5, 3.5),
        part="tn34",
        id=SceneId("train", "pile", 0, 0, 2),
    )


def test_a_point_has_the_labels_of_its_own_instance(tn34):
    scene = two_flanges()
    labels = point_labels(scene, tn34.chain, CAMERA)
    torch.testing.assert_close(labels["visibility"], torch.tensor([0.75, 0.25, 0.75]))
    torch.testing.assert_close(
        labels["centroid"], torch.tensor([[0.1, 0, 0.61], [0, 0, 0.6], [0.1, 0, 0.61]])
    )
    torch.testing.assert_close(labels["points"], torch.from_numpy(scene.points))
    each, margin = (value.float() for value in instance_keypoints(scene, tn34.chain, CAMERA))
    torch.testing.assert_close(labels["keypoints"], each[[1, 0, 1]])
    torch.testing.assert_close(labels["margin"], margin[[1, 0, 1]])
    assert labels["parameters"].tolist() == pytest.approx(np.tile([R, H], (3, 1)))
    assert {value.dtype for value in labels.values()} == {torch.float32}


def test_keypoints_of_a_lying_flange_by_hand(tn34):
    below = float(tn34.centroid(np.array([[R, H]]))[0, 2])  # the centroid's height over the base
    base, top, rim = instance_keypoints(two_flanges(), tn34.chain, CAMERA)[0][1].tolist()
    # the part's z points to −y, so the base lies towards +y; the rim's nearest point lies towards −z
    assert base == pytest.approx([0.1, below, 0.61])
    assert top == pytest.approx([0.1, below - H, 0.61])
    assert rim == pytest.approx([0.1, below, 0.61 - R])


def test_without_gu_the_rim_is_the_templates_own(tn34):
    base, _, rim = instance_keypoints(two_flanges(), tn34.chain, CANONICAL)[0][0].tolist()
    assert np.subtract(rim, base) == pytest.approx([R, 0, 0])


@pytest.mark.parametrize(
    ("direction", "side"),
    [
        ((0, 0, 1), (0, -1, 0)),  # a tie in z: the smallest y decides
        ((0, 1, 0), (0, -1, 0)),
        ((0, -1, 0), (0, 1, 0)),
        ((1, 0, 0), (-1, 0, 0)),
        ((3, 4, 0), (-0.6, -0.8, 0)),
    ],
)
def test_the_direction_decides_where_the_rim_is(tn34, direction, side):
    choice = KeypointChoice(KeypointRule.CAMERA, direction)
    base, _, rim = instance_keypoints(two_flanges(), tn34.chain, choice)[0][0].tolist()
    assert np.subtract(rim, base) == pytest.approx(R * np.array(side), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_gu_labels_turn_with_the_scene(part, make_scene, seed):
    scene = make_scene(part, seed=seed)
    angle = 0.4 + seed
    turned = rotate_about_view_axis(scene, angle)
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    keypoints, margin = instance_keypoints(scene, part.chain, CAMERA)
    found, same_margin = instance_keypoints(turned, part.chain, CAMERA)
    torch.testing.assert_close(found, keypoints @ turn.T, rtol=0, atol=1e-12)
    torch.testing.assert_close(same_margin, margin, rtol=0, atol=1e-12)


@pytest.mark.parametrize("choice", [CAMERA, CANONICAL, POINT, KeypointChoice(KeypointRule.CAMERA, (0, 1, 0))])
def test_labels_give_back_the_parameters(part, make_scene, choice):
    labels = point_labels(make_scene(part), part.chain, choice)
    measured = part.chain.parameters_from_keypoints(labels["centroid"], labels["keypoints"])
    torch.testing.assert_close(measured, labels["parameters"], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("number", [-1, 2])
def test_a_point_on_no_instance_is_an_error(tn34, number):
    scene = replace(two_flanges(), instance=np.array([0, number, 1]))
    with pytest.raises(ValueError, match="train/pile_0000_part_00/002: a point names instance"):
        point_labels(scene, tn34.chain, CAMERA)


def test_a_scene_without_points_has_no_labels(tn34):
    scene = two_flanges()
    empty = replace(scene, points=scene.points[:0], instance=scene.instance[:0])
    for choice in (CAMERA, CANONICAL, POINT):
        labels = point_labels(empty, tn34.chain, choice)
        assert labels["keypoints"].shape == (0, 3, 3) and labels["margin"].shape == (0, 3)


def test_the_rule_point_is_not_one_of_an_instance(tn34):
    with pytest.raises(ValueError, match="needs surface points"):
        instance_keypoints(two_flanges(), tn34.chain, POINT)


CIRCLE = np.linspace(0, 2 * np.pi, 3600, endpoint=False)


def ring(radius: float, angles=CIRCLE) -> np.ndarray:
    return radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)


def candidates(part, size: np.ndarray, chosen: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Keypoint → every place that it may have beside its reference's; circles are sampled."""
    x, y, z = np.eye(3)
    below = part.centroid(size[None])[0]
    if part.name == "tn06":
        r, h, d = size
        face = chosen.get("face", z)
        return {
            "face": np.outer([h / 2, -h / 2], z),
            "hole": face + ring(r),
            "vertex": face + ring(d, np.arange(6) * np.pi / 3),
        }
    if part.name == "tn34":
        r, h = size
        return {"base": -below[None], "top": (h * z - below)[None], "rim": ring(r) - below}
    if part.name == "tn16":
        r, h, c = size
        end = chosen.get("end", z)
        return {
            "end": np.outer([h / 2, -h / 2], z),
            "rim": end + ring(r),
            "apex": (end * (1 + c / (h / 2)))[None],
        }
    length, a, w = size
    return {
        "foot": -below[None],
        "toe": (length * x - below)[None],
        "head": (a * z - below)[None],
        "tip": (length * x + 0.006 * z - below)[None],
        "side": np.outer([w / 2, -w / 2], y),
    }


# tn42: the corner nearest to a point → which keypoint's place each keypoint is taught, else its own
EXCHANGES = {
    "foot": {},
    "toe": {"foot": "toe", "toe": "foot", "head": "tip", "tip": "head"},
    "head": {"foot": "head", "head": "foot", "toe": "tip", "tip": "toe"},
    "tip": {"foot": "tip", "tip": "foot", "toe": "head", "head": "toe"},
}


@pytest.fixture(params=["tn06", "tn34", "tn16", "tn42"])
def pile(request, make_scene):
    """A part and a scene of sixty bodies of sizes of their own."""
    name = request.param
    own = {
        "tn16": lambda: TN16({"r": [8], "h": [20], "c": [6]}),
        "tn42": lambda: TN42({"l": [36], "a": [13], "w": [11]}),
    }
    part = own[name]() if name in own else request.getfixturevalue(name)
    scene = make_scene(part, bodies=60, points=600)
    grow = 1 + np.random.default_rng(0).uniform(0, 0.1, (60, 1))
    return part, replace(scene, parameters=scene.parameters * grow)


def test_gu_labels_of_sixty_bodies_are_those_of_trying_every_place(pile):
    part, scene = pile
    labels, _ = instance_keypoints(scene, part.chain, CAMERA)
    for i, (R_, t) in enumerate(zip(scene.R, scene.t, strict=True)):
        chosen: dict[str, np.ndarray] = {}
        for name, found in zip(part.chain.names, labels[i].numpy(), strict=True):
            places = candidates(part, scene.parameters[i], chosen)[name]
            chosen[name] = places[np.argmin((places @ R_.T)[:, 2])]
            step = 2e-3 * scene.parameters[i].max() if len(places) == len(CIRCLE) else 1e-9
            assert np.linalg.norm(R_ @ chosen[name] + t - found) < step, (i, name)


def test_point_labels_of_sixty_bodies_are_those_of_trying_every_place(pile):
    part, scene = pile
    said = point_labels(scene, part.chain, POINT)
    labels, which, seen = said["keypoints"].double().numpy(), said.get("lookalike"), set()
    assert (which is not None) == (part.name == "tn42")
    for n, i in enumerate(scene.instance):
        local = (scene.points[n].astype(float) - scene.t[i]) @ scene.R[i]
        chosen: dict[str, np.ndarray] = {}
        steps = {}
        for name in part.chain.names:
            places = candidates(part, scene.parameters[i], chosen)[name]
            distance = np.linalg.norm(places - local, axis=1)
            chosen[name] = places[np.argmin(distance)]
            steps[name] = 2e-3 * scene.parameters[i].max() if len(places) == len(CIRCLE) else 1e-6
        taught = dict(chosen)
        if part.name == "tn42":
            nearest = min(EXCHANGES, key=lambda name: np.linalg.norm(chosen[name] - local))
            taught |= {name: chosen[other] for name, other in EXCHANGES[nearest].items()}
            assert which[n] == list(EXCHANGES).index(nearest)
            seen.add(nearest)
        for name, found in zip(part.chain.names, labels[n], strict=True):
            off = scene.R[i] @ taught[name] + scene.t[i] - found
            assert np.linalg.norm(off) < steps[name], (n, name)
    assert seen == (set(EXCHANGES) if part.name == "tn42" else set())


@pytest.mark.parametrize("choice", [CAMERA, CANONICAL])
def test_other_rules_exchange_nothing(make_scene, choice):
    part = TN42({"l": [36], "a": [13], "w": [11]})
    scene = make_scene(part, bodies=5, points=100)
    assert "lookalike" not in point_labels(scene, part.chain, choice)
    keypoints = point_labels(scene, part.chain, choice)["keypoints"].double().numpy()
    local = np.einsum("nij,nmi->nmj", scene.R[scene.instance], keypoints - scene.t[scene.instance][:, None])
    own = np.stack([candidates(part, scene.parameters[0], {})[name][0] for name in part.chain.names])
    local[..., 1] = np.abs(local[..., 1])  # the camera's side is one of two
    np.testing.assert_allclose(local, np.broadcast_to(own, local.shape), atol=1e-6)


def rotations(n: int, seed: int) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(n, seed).as_matrix())


def distances(part, size: np.ndarray, Ra: torch.Tensor, Rb: torch.Tensor) -> torch.Tensor:
    """The benchmark's, of bodies whose surface centroids lie at one place."""
    space = part.pose_space(size)
    return space.distance(Ra, -Ra @ space.centre, Rb, -Rb @ space.centre)


@pytest.mark.parametrize("name", ["tn06", "tn42", "knob", "tless20"])
@pytest.mark.parametrize("index", [0, -1])
def test_rotations_differ_by_the_benchmarks_distance(name, index):
    """Of finite symmetries, over whose elements the least counts."""
    part = load_part(name)
    assert isinstance(part.symmetry, FiniteSymmetry)
    size = part.grids["L"][index]
    Ra, Rb = rotations(40, 0), rotations(40, 1)
    others = Rb[:, None] @ part.symmetry.rotations
    found = ((Ra[:, None] - others) @ pose_scale(part, size)).norm(dim=(-2, -1)).amin(1)
    torch.testing.assert_close(found, distances(part, size, Ra, Rb), rtol=0, atol=1e-12)
    assert float(found.min()) > 0.0001


@pytest.mark.parametrize(("name", "ends"), [("tn34", (1,)), ("tn16", (1, -1)), ("gear", (1,))])
def test_axes_of_revolutions_differ_by_the_benchmarks_distance(name, ends):
    part = load_part(name)
    assert isinstance(part.symmetry, RevolutionSymmetry)
    size = part.grids["L"][-1]
    scale = pose_scale(part, size)
    assert torch.equal(scale, scale[0, 0] * torch.eye(3, dtype=torch.float64))
    assert float(scale[0, 0]) == float(part.pose_space(size).scale) > 0.003
    Ra, Rb = rotations(40, 0), rotations(40, 1)
    found = torch.stack([((Ra[..., 2] - end * Rb[..., 2]) @ scale).norm(dim=-1) for end in ends])
    torch.testing.assert_close(found.amin(0), distances(part, size, Ra, Rb), rtol=0, atol=1e-12)


def test_turning_a_sphere_moves_nothing():
    part = Marble({"r": [8, 11]})
    scale = pose_scale(part, part.part_object("L", 1))
    assert scale.shape == (3, 3) and scale.dtype == torch.float64 and not bool(scale.any())


def test_a_scale_of_twice_the_size_is_twice_the_scale(tn34, tn06):
    for part in (tn34, tn06):
        size = part.part_object("L", 3)
        torch.testing.assert_close(pose_scale(part, 2 * size), 2 * pose_scale(part, size))


def test_scales_are_found_once_for_each_part_object(tn06, monkeypatch):
    part = load_part("tn06")
    asked = []
    original = part.pose_space

    def spy(parameters):
        asked.append(tuple(parameters))
        return original(parameters)

    monkeypatch.setattr(part, "pose_space", spy)
    sizes = [part.part_object("L", i) for i in (0, 5, 0, 5, 63, 0)]
    found = [pose_scale(part, size) for size in sizes]
    assert asked == [tuple(sizes[i]) for i in (0, 1, 4)]
    assert torch.equal(found[0], found[2]) and torch.equal(found[0], found[5])
    assert not torch.allclose(found[0], found[1])
    torch.testing.assert_close(pose_scale(tn06, sizes[1]), found[1])  # another instance of the template


def test_pose_labels_are_those_of_the_points_instance(part, make_scene):
    scene = make_scene(part, bodies=5, points=60, seed=3)
    labels = pose_labels(scene, part)
    assert {name: (tuple(value.shape), value.dtype) for name, value in labels.items()} == {
        "rotation": ((60, 3, 3), torch.float32),
        "scale": ((3, 3), torch.float32),
    }
    for n, i in enumerate(scene.instance):
        np.testing.assert_allclose(labels["rotation"][n].numpy(), scene.R[i], atol=1e-7)
    torch.testing.assert_close(labels["scale"].double(), pose_scale(part, scene.parameters[0]))


def test_pose_labels_turn_with_the_scene(part, make_scene):
    scene = make_scene(part, seed=1)
    before, after = (pose_labels(s, part) for s in (scene, rotate_about_view_axis(scene, 0.7)))
    turn = torch.from_numpy(Rotation.from_euler("z", 0.7).as_matrix()).float()
    torch.testing.assert_close(after["rotation"], turn @ before["rotation"], rtol=0, atol=1e-6)
    assert torch.equal(after["scale"], before["scale"])


def test_a_scene_without_bodies_has_pose_labels_too(tn34):
    scene = two_flanges()
    rows = {name: getattr(scene, name)[:0] for name in ("R", "t", "parameters", "visibility", "occlusion")}
    empty = replace(scene, points=scene.points[:0], instance=scene.instance[:0], **rows)
    labels = pose_labels(empty, tn34)
    assert labels["rotation"].shape == (0, 3, 3)
    expected = pose_scale(tn34, tn34.part_object("L", 0)).float()
    assert torch.equal(labels["scale"], expected) and float(expected[0, 0]) > 0.003
