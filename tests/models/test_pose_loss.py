"""PPR-Net's loss against a naive loop, and its indifference to the part's symmetry."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation
from tests.conftest import CONF, Marble, load_part

from pnet.cli.instantiate import instantiate
from pnet.data.dataset import Collate
from pnet.data.targets import point_labels, pose_labels
from pnet.geometry.symmetry import (
    FLIP,
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    dihedral,
    rotation_about_z,
)
from pnet.models.pose_loss import PoseLoss, RotationNorm
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import box
from pnet.records import Batch, PosePrediction


class Brick(ParametricPart):
    """Three different edges: its Λ tells the axes apart."""

    name = "brick"
    parameter_names = ("a", "b", "c")
    symmetry = dihedral(2)
    keypoints = tuple(
        Keypoint(axis, "centroid", Plane(axis), p, 0.5) for axis, p in zip("xyz", "abc", strict=True)
    )

    def solid(self, parameters):
        a, b, c = self.split(parameters)
        return box((-a / 2, a / 2), (-b / 2, b / 2), (-c / 2, c / 2))


NORMS = list(RotationNorm)
NAMES = ["tn06", "tn16", "tn34", "tn42", "knob", "marble", "brick"]


@pytest.fixture(scope="module", params=NAMES)
def part(request):
    """Dihedral, revolution with and without equal ends, none, cyclic, sphere, half turns."""
    own = {
        "marble": lambda: Marble({"r": [8, 11]}),
        "brick": lambda: Brick({"a": [10], "b": [16], "c": [28]}),
    }
    return own.get(request.param, lambda: load_part(request.param))()


def labelled(part, make_scene, points=25) -> Batch:
    """Two scenes of different part objects, with the labels of poses."""
    items = []
    for i, seed in enumerate((0, 1)):
        scene = make_scene(part, seed=seed, points=points)
        labels = point_labels(scene, part.chain, KeypointChoice())
        items.append({**labels, **pose_labels(scene, part), "scene": torch.tensor(i)})
    return Collate()(items)


@pytest.fixture
def batch(part, make_scene) -> Batch:
    return labelled(part, make_scene)


def point(R: torch.Tensor, scale: torch.Tensor, visibility: float = 1.0) -> Batch:
    """One point at the origin, on an instance of this rotation."""
    zero = torch.zeros(1, 1, 3)
    keypoints, margin = torch.zeros(1, 1, 1, 3), torch.zeros(1, 1, 1)
    shown = torch.full((1, 1), visibility)
    labels = {"rotation": R[None, None].float(), "scale": scale[None].float()}
    return Batch(zero, zero, keypoints, margin, zero, shown, torch.zeros(1), **labels)


def perfect(batch: Batch) -> PosePrediction:
    return PosePrediction(batch.centroid, batch.rotation, batch.visibility)


def noisy(batch: Batch, angle: float = 2.0, seed: int = 0) -> PosePrediction:
    """Rotations turned by up to so many radians, each point about an axis of its own."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.uniform(-angle, angle, (batch.visibility.numel(), 3)) / math.sqrt(3))
    turned = torch.from_numpy(turns.as_matrix()).float().view_as(batch.rotation) @ batch.rotation
    shift = torch.from_numpy(rng.normal(0, 0.003, batch.centroid.shape)).float()
    shown = torch.from_numpy(rng.random(batch.visibility.shape)).float()
    return PosePrediction(batch.centroid + shift, turned, shown)


def elements(symmetry, count: int = 12) -> torch.Tensor:
    """(g, 3, 3) the symmetry's elements, of an infinite group so many at random."""
    angle = 2 * math.pi * torch.rand(count, generator=torch.Generator().manual_seed(3)).double()
    match symmetry:
        case FiniteSymmetry(rotations=G):
            return G
        case RevolutionSymmetry(rotoreflection=reflected):
            turns = rotation_about_z(angle)
            return torch.cat([turns, turns @ torch.tensor(FLIP).double()]) if reflected else turns
        case _:
            return torch.from_numpy(Rotation.random(count, 0).as_matrix())


def naive(part, norm: str, predicted: PosePrediction, batch: Batch) -> dict[str, float]:
    """Point by point and element by element, as the docstring has it."""
    sums = dict.fromkeys(("centroid", "rotation", "visibility"), 0.0)
    b, n = batch.visibility.shape
    for i in range(b):
        scale = batch.scale[i].double().numpy()
        for j in range(n):
            seen = float(batch.visibility[i, j])
            R, truth = (x[i, j].double().numpy() for x in (predicted.rotation, batch.rotation))
            match part.symmetry:
                case FiniteSymmetry(rotations=G):
                    errors = [(R - truth @ g) @ scale for g in G.numpy()]
                case RevolutionSymmetry(rotoreflection=reflected):
                    signs = (1, -1) if reflected else (1,)
                    errors = [scale[0, 0] * (R[:, 2] - s * truth[:, 2]) for s in signs]
                case _:
                    errors = [np.zeros(3)]
            length = {"entries": lambda e: np.abs(e).sum(), "distance": np.linalg.norm}[norm]
            sums["rotation"] += seen * min(length(error) for error in errors)
            sums["centroid"] += seen * float((predicted.centroid - batch.centroid)[i, j].abs().sum())
            sums["visibility"] += abs(float(predicted.visibility[i, j]) - seen)
    return {name: total / (b * n) for name, total in sums.items()}


@pytest.mark.parametrize("norm", NORMS)
def test_any_equivalent_of_the_truth_has_no_loss(part, batch, norm):
    for g in elements(part.symmetry):
        same = replace(perfect(batch), rotation=batch.rotation @ g.float())
        losses = PoseLoss(part, norm)(same, batch)
        assert float(losses["rotation"]) < 2e-8 and float(losses["loss"]) < 4e-6


def test_other_rotations_have_one(part, batch):
    """Turned by 20° about x and y: for no part but the sphere a symmetry."""
    lengths = []
    for axis in "xy":
        turn = torch.from_numpy(Rotation.from_euler(axis, 20, degrees=True).as_matrix()).float()
        turned = replace(perfect(batch), rotation=batch.rotation @ turn)
        lengths.append(float(PoseLoss(part)(turned, batch)["rotation"]))
    if isinstance(part.symmetry, SphericalSymmetry):
        assert lengths == [0, 0]
    else:
        assert min(lengths) > 0.001  # 1 − cos 20° and sin 20° of some millimetres


@pytest.mark.parametrize("norm", NORMS)
def test_losses_are_those_of_the_naive_loop(part, batch, norm):
    for seed, angle in enumerate((0.3, 3.0)):
        predicted = noisy(batch, angle, seed)
        losses = PoseLoss(part, norm)(predicted, batch)
        expected = naive(part, norm, predicted, batch)
        assert {name: float(losses[name]) for name in expected} == pytest.approx(expected, rel=1e-4, abs=2e-9)
        total = 200 * expected["centroid"] + 200 * expected["rotation"] + 50 * expected["visibility"]
        assert float(losses["loss"]) == pytest.approx(total, rel=1e-4)


def test_scenes_of_one_batch_have_their_own_scales(make_scene):
    """Twice as large, twice the loss: only in the scene that is."""
    part = load_part("tn42")
    batch = labelled(part, make_scene)
    predicted = noisy(batch)
    once = float(PoseLoss(part)(predicted, batch)["rotation"])
    grown = [
        float(PoseLoss(part)(predicted, replace(batch, scale=batch.scale * factor))["rotation"])
        for factor in (torch.tensor([2.0, 1]).view(2, 1, 1), torch.tensor([1.0, 2]).view(2, 1, 1))
    ]
    assert grown[0] + grown[1] == pytest.approx(3 * once, rel=1e-5)
    assert min(grown) > 1.2 * once


def test_the_centroid_by_hand():
    """|3| + |−4| + |12| mm, seen a quarter."""
    batch = point(torch.eye(3), torch.eye(3), visibility=0.25)
    off = replace(perfect(batch), centroid=torch.tensor([[[0.003, -0.004, 0.012]]]))
    losses = PoseLoss(load_part("tn42"))(off, batch)
    assert float(losses["centroid"]) == pytest.approx(0.25 * 0.019)
    assert float(losses["loss"]) == pytest.approx(200 * 0.25 * 0.019)


def rotation_loss(name: str, norm: str, batch: Batch, R: torch.Tensor) -> float:
    predicted = replace(perfect(batch), rotation=R[None, None])
    return float(PoseLoss(load_part(name), norm)(predicted, batch)["rotation"])


@pytest.mark.parametrize("norm", NORMS)
def test_the_rotation_of_a_part_without_symmetry_by_hand(norm):
    """Half seen; a quarter turn about z: R − 1 = ((−1, −1, 0), (1, −1, 0), 0), columns weigh 2, 3, 5 mm."""
    batch = point(torch.eye(3), torch.diag(torch.tensor([0.002, 0.003, 0.005])), visibility=0.5)
    turn = rotation_about_z(torch.tensor(math.pi / 2))
    expected = {"entries": 2 * 2 + 2 * 3, "distance": math.sqrt(2 * 4 + 2 * 9)}[norm]
    assert rotation_loss("tn42", norm, batch, turn) == pytest.approx(0.5 * 0.001 * expected)


@pytest.mark.parametrize("norm", NORMS)
def test_the_rotation_of_a_hexagon_by_hand(norm):
    """Turned by 70° about z it is 10° from a symmetry: chords in x and y, 4 mm."""
    batch = point(torch.eye(3), torch.diag(torch.tensor([0.004, 0.004, 0.009])))
    turn = rotation_about_z(torch.tensor(math.radians(70.0)))
    cosine, sine = 0.5 - math.cos(math.radians(70)), math.sin(math.radians(70)) - math.sqrt(0.75)
    expected = {"entries": 2 * (cosine + sine), "distance": math.sqrt(2) * 2 * math.sin(math.radians(5))}
    assert rotation_loss("tn06", norm, batch, turn) == pytest.approx(0.004 * expected[norm], rel=1e-5)


@pytest.mark.parametrize(
    ("name", "norm", "expected"),
    [
        ("tn34", "entries", 0.6 + 1.8),
        ("tn16", "entries", 0.6 + 0.2),
        ("tn34", "distance", math.hypot(0.6, 1.8)),
        ("tn16", "distance", math.hypot(0.6, 0.2)),
    ],
)
def test_the_axis_of_a_revolution_by_hand(name, norm, expected):
    """Axis (−0.6, 0, −0.8) instead of z; with equal ends it may be (0.6, 0, 0.8). Half seen, 7 mm."""
    R = torch.tensor([[0.8, 0, -0.6], [0, -1, 0], [-0.6, 0, -0.8]])
    assert float(torch.linalg.det(R)) == pytest.approx(1)
    batch = point(torch.eye(3), 0.007 * torch.eye(3), visibility=0.5)
    assert rotation_loss(name, norm, batch, R) == pytest.approx(0.5 * 0.007 * expected)


def test_of_equal_ends_that_counts_which_makes_the_smaller_error():
    """Axes a = (8, 4, 1) / 9 and b = (−4, 4, 7) / 9: an obtuse angle; Σ|a − b| = 18/9, Σ|a + b| = 20/9."""

    def with_axis(z: list[float]) -> torch.Tensor:
        z_axis = np.array(z) / 9
        x = np.cross(z_axis, [0, 0, 1]) / np.hypot(*z_axis[:2])
        return torch.from_numpy(np.stack([x, np.cross(z_axis, x), z_axis], -1)).float()

    batch = point(with_axis([8, 4, 1]), 0.009 * torch.eye(3))
    assert rotation_loss("tn16", "entries", batch, with_axis([-4, 4, 7])) == pytest.approx(0.018)
    distance = 0.001 * math.sqrt(4**2 + 8**2 + 8**2)
    assert rotation_loss("tn16", "distance", batch, with_axis([-4, 4, 7])) == pytest.approx(distance)


def test_hidden_bodies_teach_less(batch, part):
    predicted = noisy(batch)
    whole = PoseLoss(part)(predicted, replace(batch, visibility=torch.ones_like(batch.visibility)))
    half = PoseLoss(part)(predicted, replace(batch, visibility=0.5 * torch.ones_like(batch.visibility)))
    for name in ("centroid", "rotation"):
        assert float(half[name]) == pytest.approx(0.5 * float(whole[name]), rel=1e-5)


def test_one_hidden_body_teaches_nothing_but_its_visibility():
    batch = point(torch.eye(3), 0.01 * torch.eye(3), visibility=0.0)
    off = PosePrediction(batch.centroid + 1, batch.rotation.roll(1, -1), torch.full((1, 1), 0.3))
    losses = PoseLoss(load_part("tn42"))(off, batch)
    assert [float(losses[name]) for name in ("centroid", "rotation")] == [0, 0]
    assert float(losses["loss"]) == pytest.approx(50 * 0.3)


def turned_by(vector: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
    """exp([v]×) R."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(cross) @ R


@pytest.mark.parametrize("norm", NORMS)
def test_the_gradient_is_finite_and_a_step_against_it_lowers_every_points_loss(part, batch, norm):
    """By as much as the gradient says."""
    start = noisy(batch, 1.2)
    vector = torch.zeros_like(batch.centroid).requires_grad_()
    predicted = replace(start, rotation=turned_by(vector, start.rotation))
    loss = PoseLoss(part, norm)
    loss(predicted, batch)["rotation"].backward()
    assert bool(vector.grad.isfinite().all())
    if isinstance(part.symmetry, SphericalSymmetry):
        assert not bool(vector.grad.any())
        return
    assert bool((vector.grad.norm(dim=-1) > 0).all())
    step = -1e-3 * torch.nn.functional.normalize(vector.grad, dim=-1)
    moved = turned_by(step, start.rotation)
    scale = batch.scale[:, None]
    weightless = [loss._rotation_distance(R, batch.rotation, scale) for R in (start.rotation, moved)]
    slope = (vector.grad.norm(dim=-1) / batch.visibility * batch.visibility.numel() * 1e-3).detach()
    fall = weightless[0] - weightless[1]
    assert bool((fall > 0).all())
    assert float((fall / slope).median()) == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("norm", NORMS)
def test_descent_ends_at_an_equivalent_of_the_truth(part, make_scene, norm):
    """Steps against the gradient, shorter and shorter."""
    batch = labelled(part, make_scene, points=4)
    R, loss = noisy(batch, 0.9).rotation, PoseLoss(part, norm)
    first = float(loss(replace(perfect(batch), rotation=R), batch)["rotation"])
    for round_ in range(150):
        vector = torch.zeros_like(batch.centroid).requires_grad_()
        loss(replace(perfect(batch), rotation=turned_by(vector, R)), batch)["rotation"].backward()
        step = 0.1 * 0.96**round_ * torch.nn.functional.normalize(vector.grad, dim=-1)
        R = turned_by(-step, R).detach()
    left = float(loss(replace(perfect(batch), rotation=R), batch)["rotation"])
    least = 0 if isinstance(part.symmetry, SphericalSymmetry) else 0.001
    assert first >= least and left <= 0.02 * first


@pytest.mark.parametrize("norm", NORMS)
def test_gradients_of_a_perfect_prediction_are_finite(part, batch, norm):
    rotation, centroid, shown = (
        value.clone().requires_grad_() for value in (batch.rotation, batch.centroid, batch.visibility)
    )
    PoseLoss(part, norm)(PosePrediction(centroid, rotation, shown), batch)["loss"].backward()
    assert all(bool(value.grad.isfinite().all()) for value in (rotation, centroid, shown))


@pytest.mark.parametrize("name", ["rotation", "scale"])
def test_missing_labels_are_said_with_the_setting(make_scene, name):
    part = load_part("tn34")
    batch = labelled(part, make_scene)
    with pytest.raises(ValueError, match=r"data\.targets\.poses=true \(method=pprnet does\)"):
        PoseLoss(part)(perfect(batch), replace(batch, **{name: None}))


def test_weights_are_the_released_ones_or_the_given(make_scene):
    part = load_part("tn34")
    assert PoseLoss(part).weights == {"centroid": 200, "rotation": 200, "visibility": 50}
    batch = labelled(part, make_scene)
    predicted = noisy(batch)
    loss = PoseLoss(part, centroid=3.0, rotation=0.0, visibility=7.0)
    values = {name: float(value) for name, value in loss(predicted, batch).items()}
    assert values["loss"] == pytest.approx(3 * values["centroid"] + 7 * values["visibility"], rel=1e-5)
    assert values["rotation"] > 0.001


def test_the_config_has_the_defaults():
    part = load_part("tn34")
    made = instantiate(OmegaConf.load(CONF / "loss" / "pprnet.yaml"), part=part)
    assert isinstance(made, PoseLoss)
    assert made.weights == PoseLoss(part).weights and made._norm in NORMS


def test_an_unknown_norm_is_refused():
    with pytest.raises(ValueError, match="squared"):
        PoseLoss(load_part("tn34"), "squared")


def test_a_wrong_way_round_axis_finds_back_by_distance():
    """Of a revolution with different ends, from 177°; the sum of entries may rest on the way there."""
    batch = point(torch.eye(3), 0.01 * torch.eye(3))
    R = turned_by(torch.tensor([0.9, 0.4, 0.0]) * math.pi, torch.eye(3))
    loss = PoseLoss(load_part("tn34"), "distance")
    for _ in range(400):
        vector = torch.zeros(3).requires_grad_()
        turned = turned_by(vector, R)
        loss(replace(perfect(batch), rotation=turned[None, None]), batch)["rotation"].backward()
        R = turned_by(-0.01 * torch.nn.functional.normalize(vector.grad, dim=-1), R).detach()
    assert float(R[2, 2]) > math.cos(0.02)


def test_without_the_visibility_head_its_term_is_missing(make_scene):
    part = load_part("tn06")
    batch = labelled(part, make_scene)
    full, without = (
        PoseLoss(part)(predicted, batch)
        for predicted in (noisy(batch), replace(noisy(batch), visibility=None))
    )
    assert set(full) - set(without) == {"visibility"}
    assert float(full["loss"] - without["loss"]) == pytest.approx(50 * float(full["visibility"]), rel=1e-4)


def test_nothing_is_remarked(make_scene):
    part = load_part("tn34")
    assert PoseLoss(part).remarks(labelled(part, make_scene)) == {}
