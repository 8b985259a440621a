"""Equation 2 against a naive loop, in each reading of the norm."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.data.dataset import Collate
from pnet.data.targets import point_labels
from pnet.models.losses import Norm, ParametricLoss
from pnet.parts.choice import KeypointChoice
from pnet.records import Batch, PointPrediction

NORMS = list(Norm)
INF = math.inf


@pytest.fixture
def batch(part, make_scene) -> Batch:
    scenes = [make_scene(part, seed=seed, points=30) for seed in (0, 1)]
    items = [point_labels(scene, part.chain, KeypointChoice()) for scene in scenes]
    return Collate()([{**item, "scene": torch.tensor(i)} for i, item in enumerate(items)])


def perfect(batch: Batch) -> PointPrediction:
    return PointPrediction(batch.centroid, batch.keypoints, batch.visibility)


def point(margin: list[float]) -> Batch:
    """One point of a flange, r = h = 2; base, top and rim with these margins."""
    zero = torch.zeros(1, 1, 3)
    keypoints = torch.tensor([[[[0, 0, -1.0], [0, 0, 1], [2, 0, -1]]]])
    size = torch.full((1, 1, 2), 2.0)
    return Batch(zero, zero, keypoints, torch.tensor([[margin]]), size, torch.zeros(1, 1), torch.zeros(1))


def moved(batch: Batch, offsets: list[list[float]]) -> PointPrediction:
    return PointPrediction(batch.centroid, batch.keypoints + torch.tensor(offsets), batch.visibility)


def noisy(batch: Batch) -> PointPrediction:
    torch.manual_seed(0)
    return PointPrediction(
        batch.centroid + 0.003 * torch.randn_like(batch.centroid),
        batch.keypoints + 0.003 * torch.randn_like(batch.keypoints),
        torch.rand_like(batch.visibility),
    )


def naive_losses(part, norm: str, predicted: PointPrediction, batch: Batch) -> dict[str, float]:
    """Point by point, as the equations are written."""
    sums = dict.fromkeys(("centroid", "keypoints", "parameters", "visibility"), 0.0)
    b, n = batch.visibility.shape
    for i in range(b):
        for j in range(n):
            c = (predicted.centroid - batch.centroid)[i, j].double().numpy()
            k = (predicted.keypoints - batch.keypoints)[i, j].double().numpy()
            if norm == "squared":
                sums["centroid"] += c @ c
                sums["keypoints"] += sum(e @ e for e in k)
            else:
                sums["centroid"] += math.sqrt(c @ c)
                sums["keypoints"] += (
                    math.sqrt(sum(e @ e for e in k))
                    if norm == "distance"
                    else sum(np.linalg.norm(e) for e in k)
                )
            measured = part.chain.parameters_from_keypoints(
                predicted.centroid[i, j].double(), predicted.keypoints[i, j].double()
            )
            sums["parameters"] += sum(abs(float(v)) for v in measured - batch.parameters[i, j].double())
            sums["visibility"] += abs(float(predicted.visibility[i, j] - batch.visibility[i, j]))
    return {name: total / (b * n) for name, total in sums.items()}


@pytest.mark.parametrize("norm", NORMS)
def test_losses_are_those_of_the_naive_loop(part, batch, norm):
    predicted = noisy(batch)
    losses = ParametricLoss(part, norm)(predicted, batch)
    expected = naive_losses(part, norm, predicted, batch)
    assert {name: float(losses[name]) for name in expected} == pytest.approx(expected, rel=1e-4)
    m, k = len(part.chain), part.k
    total = (
        200 * expected["centroid"]
        + 200 / (3 * m) * expected["keypoints"]
        + 50 / k * expected["parameters"]
        + 50 * expected["visibility"]
    )
    assert float(losses["loss"]) == pytest.approx(total, rel=1e-4)


def test_default_weights_are_the_papers(tn34, tn06):
    weights = ParametricLoss(tn34, "squared").weights
    assert weights == pytest.approx(
        {"centroid": 200, "keypoints": 200 / 9, "parameters": 25, "visibility": 50}
    )
    assert ParametricLoss(tn06, "squared").weights["parameters"] == pytest.approx(50 / 3)


def test_given_weights_replace_them_zero_too(tn34, make_scene, batch):
    loss = ParametricLoss(tn34, "squared", centroid=0.0, keypoints=7.0)
    assert loss.weights == pytest.approx({"centroid": 0, "keypoints": 7, "parameters": 25, "visibility": 50})


@pytest.mark.parametrize("norm", NORMS)
def test_a_perfect_prediction_has_no_loss_and_a_finite_gradient(part, batch, norm):
    predicted = replace(perfect(batch), keypoints=batch.keypoints.clone().requires_grad_())
    losses = ParametricLoss(part, norm)(predicted, batch)
    assert losses["loss"].item() == pytest.approx(0, abs=2e-5)
    losses["loss"].backward()
    assert bool(predicted.keypoints.grad.isfinite().all())


def test_without_the_visibility_module_its_term_is_missing(part, batch):
    loss = ParametricLoss(part, "squared")
    full, without = loss(noisy(batch), batch), loss(replace(noisy(batch), visibility=None), batch)
    assert "visibility" not in without
    assert float(full["loss"] - without["loss"]) == pytest.approx(50 * float(full["visibility"]), rel=1e-4)


def test_by_hand(tn34):
    """One point, every error along one axis."""
    batch = point([INF] * 3)
    shifted = moved(batch, [[3.0, 0, 0], [0, 4, 0], [0, 0, 0]])
    predicted = replace(
        shifted, centroid=batch.centroid + torch.tensor([0, 2.0, 0]), visibility=torch.full((1, 1), 0.25)
    )
    values = {norm: ParametricLoss(tn34, norm)(predicted, batch) for norm in NORMS}
    assert [float(values[n]["centroid"]) for n in ("squared", "distance", "each")] == pytest.approx([4, 2, 2])
    assert [float(values[n]["keypoints"]) for n in ("squared", "distance", "each")] == pytest.approx(
        [25, 5, 7]
    )
    assert float(values["each"]["visibility"]) == 0.25


@pytest.mark.parametrize(
    ("margin", "trust"),
    [
        ([INF, INF, INF], [1, 1, 1]),
        ([INF, INF, 0.0], [1, 1, 0]),
        ([INF, 0.002, 0.002], [1, 0.5, 0.5]),
        ([0.006, 0.002, 0.0], [0.75, 0.5, 0]),
        ([0.0, 0.0, 0.0], [0, 0, 0]),
    ],
)
def test_a_label_counts_by_its_margin_over_margin_and_scale(tn34, margin, trust):
    """Scale 2 mm, errors 3, 4 and 12. `squared` weighs squares, the others distances."""
    batch = point(margin)
    predicted = moved(batch, [[3.0, 0, 0], [0, 4, 0], [0, 0, 12]])
    found = {n: float(ParametricLoss(tn34, n, 0.002)(predicted, batch)["keypoints"]) for n in NORMS}
    squares = sum(w * e * e for w, e in zip(trust, (3, 4, 12), strict=True))
    scaled = math.hypot(*(w * e for w, e in zip(trust, (3, 4, 12), strict=True)))
    distances = sum(w * e for w, e in zip(trust, (3, 4, 12), strict=True))
    assert found["squared"] == pytest.approx(squares, abs=1e-6)
    assert found["distance"] == pytest.approx(scaled, abs=1e-6)
    assert found["each"] == pytest.approx(distances, abs=1e-6)


@pytest.mark.parametrize("norm", NORMS)
def test_a_margin_touches_the_keypoints_loss_only(part, batch, norm):
    predicted = noisy(batch)
    plain, weighed = ParametricLoss(part, norm), ParametricLoss(part, norm, margin=0.002)
    one, other = plain(predicted, batch), weighed(predicted, batch)
    for name in ("centroid", "parameters", "visibility"):
        assert torch.equal(one[name], other[name])
    assert 0 < float(other["keypoints"]) < float(one["keypoints"])
    sure = replace(batch, margin=torch.full_like(batch.margin, INF))
    torch.testing.assert_close(weighed(predicted, sure)["loss"], one["loss"])


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("margin", [[0.0, 0.0, 0.0], [INF, 0.0, 1e-12], [INF, INF, 0.003]])
@pytest.mark.parametrize("error", [0.0, 1e-12, 0.01])
def test_gradients_are_finite_whatever_margin_and_error(tn34, norm, margin, error):
    batch = point(margin)
    keypoints = (batch.keypoints + error).requires_grad_()
    predicted = PointPrediction(batch.centroid, keypoints, batch.visibility)
    loss = ParametricLoss(tn34, norm, 0.002)(predicted, batch)["keypoints"]
    loss.backward()
    assert math.isfinite(loss.item()) and bool(keypoints.grad.isfinite().all())
    gradient = keypoints.grad[0, 0].norm(dim=-1)
    for own, trusted in zip(gradient.tolist(), margin, strict=True):
        if trusted == 0:
            assert own == 0  # a label that is a tie teaches nothing
        elif error == 0.01 and trusted == INF:
            assert own > 1e-3


@pytest.mark.parametrize("margin", [0.0, -0.001])
def test_a_margin_that_is_no_length_is_refused(tn34, margin):
    with pytest.raises(ValueError, match=r"loss\.margin is .*, expected a positive length in metres or null"):
        ParametricLoss(tn34, "each", margin=margin)


def test_ambiguity_is_the_share_of_labels_with_a_near_runner_up(tn34):
    rows = [[INF, 0.0, 0.0005], [INF, 0.002, 0.0009], [INF, INF, 0.0011], [INF, 0.003, 0.0]]
    batch = replace(point([INF] * 3), margin=torch.tensor([rows[:2], rows[2:]]))
    share = ParametricLoss(tn34, "squared").remarks(batch)
    assert {name: float(value) for name, value in share.items()} == {
        f"ambiguous_labels/{name}": value for name, value in {"base": 0, "top": 0.25, "rim": 0.75}.items()
    }


def test_an_unknown_norm_is_refused(tn34):
    with pytest.raises(ValueError, match="cubic"):
        ParametricLoss(tn34, "cubic")
