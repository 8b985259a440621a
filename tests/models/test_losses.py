"""Equation 2 against a naive loop, in each reading of the norm."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.data.dataset import collate
from pnet.data.targets import point_labels
from pnet.models.losses import Norm, ParametricLoss
from pnet.parts.keypoints import KeypointChoice
from pnet.records import Batch, PointPrediction

NORMS = list(Norm)


@pytest.fixture
def batch(part, make_scene) -> Batch:
    scenes = [make_scene(part, seed=seed, points=30) for seed in (0, 1)]
    items = [point_labels(scene, part.chain, KeypointChoice()) for scene in scenes]
    return collate([{**item, "scene": torch.tensor(i)} for i, item in enumerate(items)])


def perfect(batch: Batch) -> PointPrediction:
    return PointPrediction(batch.centroid, batch.keypoints, batch.visibility)


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
    losses = ParametricLoss(part.chain, norm)(predicted, batch)
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
    weights = ParametricLoss(tn34.chain, "squared").weights
    assert weights == pytest.approx(
        {"centroid": 200, "keypoints": 200 / 9, "parameters": 25, "visibility": 50}
    )
    assert ParametricLoss(tn06.chain, "squared").weights["parameters"] == pytest.approx(50 / 3)


def test_given_weights_replace_them_zero_too(tn34, make_scene, batch):
    loss = ParametricLoss(tn34.chain, "squared", centroid=0.0, keypoints=7.0)
    assert loss.weights == pytest.approx({"centroid": 0, "keypoints": 7, "parameters": 25, "visibility": 50})


@pytest.mark.parametrize("norm", NORMS)
def test_a_perfect_prediction_has_no_loss_and_a_finite_gradient(part, batch, norm):
    predicted = replace(perfect(batch), keypoints=batch.keypoints.clone().requires_grad_())
    losses = ParametricLoss(part.chain, norm)(predicted, batch)
    assert losses["loss"].item() == pytest.approx(0, abs=2e-5)
    losses["loss"].backward()
    assert bool(predicted.keypoints.grad.isfinite().all())


def test_without_the_visibility_module_its_term_is_missing(part, batch):
    loss = ParametricLoss(part.chain, "squared")
    full, without = loss(noisy(batch), batch), loss(replace(noisy(batch), visibility=None), batch)
    assert "visibility" not in without
    assert float(full["loss"] - without["loss"]) == pytest.approx(50 * float(full["visibility"]), rel=1e-4)


def test_by_hand(tn34):
    """One point, every error along one axis."""
    zero = torch.zeros(1, 1, 3)
    keypoints = torch.tensor([[[[0, 0, -1.0], [0, 0, 1], [1, 0, -1]]]])
    batch = Batch(zero, zero, keypoints, torch.zeros(1, 1, 2), torch.zeros(1, 1), torch.zeros(1))
    moved = keypoints + torch.tensor([[3.0, 0, 0], [0, 4, 0], [0, 0, 0]])
    predicted = PointPrediction(zero + torch.tensor([0, 2.0, 0]), moved, torch.full((1, 1), 0.25))
    values = {norm: ParametricLoss(tn34.chain, norm)(predicted, batch) for norm in NORMS}
    assert [float(values[n]["centroid"]) for n in ("squared", "distance", "each")] == pytest.approx([4, 2, 2])
    assert [float(values[n]["keypoints"]) for n in ("squared", "distance", "each")] == pytest.approx(
        [25, 5, 7]
    )
    assert float(values["each"]["visibility"]) == 0.25


def test_an_unknown_norm_is_refused(tn34):
    with pytest.raises(ValueError, match="cubic"):
        ParametricLoss(tn34.chain, "cubic")
