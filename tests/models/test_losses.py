"""Equation 2 against a naive loop, in each reading of the norm."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.data.dataset import Collate
from pnet.data.targets import point_labels
from pnet.models.losses import Norm, ParametricLoss, doubt_loss
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.parts.tn42 import TN42
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
        {"centroid": 200, "keypoints": 200 / 9, "parameters": 25, "visibility": 50, "sizes": 0, "doubt": 0}
    )
    assert ParametricLoss(tn06, "squared").weights["parameters"] == pytest.approx(50 / 3)


def test_given_weights_replace_them_zero_too(tn34, make_scene, batch):
    loss = ParametricLoss(tn34, "squared", centroid=0.0, keypoints=7.0, sizes=3.0, doubt=0.5)
    assert loss.weights == pytest.approx(
        {"centroid": 0, "keypoints": 7, "parameters": 25, "visibility": 50, "sizes": 3, "doubt": 0.5}
    )


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


def doubting(error: tuple[float, ...], doubt: torch.Tensor) -> tuple[PointPrediction, Batch]:
    """n points with doubt (n, 6) whose centroid, three keypoints and two sizes are all off by `error`."""
    n = len(doubt)
    truth = point([INF] * 3)
    batch = replace(
        truth,
        centroid=truth.centroid.expand(1, n, 3),
        keypoints=truth.keypoints.expand(1, n, 3, 3),
        parameters=truth.parameters.expand(1, n, 2),
    )
    off = torch.tensor(error)
    predicted = PointPrediction(
        batch.centroid + off[0] * torch.tensor([0.6, 0, 0.8]),
        batch.keypoints + off[1:4, None] * torch.tensor([0, 1.0, 0]),
        None,
        doubt[None],
        batch.parameters - off[4:],
    )
    return predicted, batch


def test_the_loss_of_doubt_by_hand():
    """Errors of 3, 1, 2, 4 mm and 0.5, 6 mm, expected to be 1, 1, 4, 2, 1 and 3 mm."""
    error = (0.003, 0.001, 0.002, 0.004, 0.0005, 0.006)
    predicted, batch = doubting(error, torch.tensor([[0.001, 0.001, 0.004, 0.002, 0.001, 0.003]]))
    expected = (3 + 1 + 0.5 + 2 + 0.5 + 2 + math.log(1 * 1 * 4 * 2 * 1 * 3)) / 6
    assert float(doubt_loss(predicted, predicted.parameters, batch)) == pytest.approx(expected, rel=1e-4)


def test_doubt_is_best_at_the_mean_error():
    """Of points that say the same the errors are 1, 2 and 6 mm: least at 3 mm, on a grid and by its slope."""
    sizes = (0.001, 0.002, 0.006)
    cases = [doubting((e,) * 6, torch.ones(1, 6)) for e in sizes]

    def loss(doubt: torch.Tensor) -> torch.Tensor:
        said = [(replace(predicted, doubt=doubt.expand(1, 1, 6)), batch) for predicted, batch in cases]
        return torch.stack([doubt_loss(p, p.parameters, batch) for p, batch in said]).mean()

    grid = torch.arange(5, 100) / 10_000
    assert float(grid[torch.stack([loss(b) for b in grid]).argmin()]) == pytest.approx(0.003)
    doubt = torch.tensor([0.003, 0.0025, 0.0036], requires_grad=True)
    for b in doubt:
        loss(b).backward()
    at, under, over = doubt.grad.tolist()
    assert at == pytest.approx(0, abs=0.05) and under < -30 and over > 30  # a metre; of a loss of about 2


def test_doubt_teaches_nothing_but_doubt():
    predicted, batch = doubting((0.003,) * 6, torch.full((4, 6), 0.002))
    said = {
        name: getattr(predicted, name).clone().requires_grad_()
        for name in ("centroid", "keypoints", "doubt", "parameters")
    }
    predicted = replace(predicted, **said)
    doubt_loss(predicted, predicted.parameters, batch).backward()
    assert said["centroid"].grad is said["keypoints"].grad is said["parameters"].grad is None
    slope = (1 / 0.002 - 0.003 / 0.002**2) / 24
    torch.testing.assert_close(said["doubt"].grad, torch.full((1, 4, 6), slope), rtol=1e-3, atol=0)


def test_doubt_judges_the_sizes_that_count(tn34):
    """Those of the head where there is one, else those measured between keypoints."""
    doubt = torch.full((1, 1, 6), 0.001)
    batch = point([INF] * 3)
    exact = PointPrediction(batch.centroid, batch.keypoints, None, doubt)
    loss = ParametricLoss(tn34, "each", doubt=1.0)
    assert float(loss(exact, batch)["doubt"]) == pytest.approx(0, abs=1e-4)
    said = replace(exact, parameters=batch.parameters + 0.006)
    assert float(loss(said, batch)["doubt"]) == pytest.approx(2 * 6 / 6, rel=1e-3)
    measured = replace(exact, keypoints=batch.keypoints * torch.tensor([1, 1, 1.003]))  # h is 6 mm too long
    assert float(loss(measured, batch)["doubt"]) == pytest.approx((3 + 3 + 3 + 6) / 6, rel=1e-2)


def test_sizes_are_a_loss_of_their_own(tn34):
    batch = point([INF] * 3)
    exact = PointPrediction(batch.centroid, batch.keypoints, batch.visibility)
    loss = ParametricLoss(tn34, "each", sizes=10.0, doubt=2.0)
    assert set(loss(exact, batch)) == {"loss", "centroid", "keypoints", "parameters", "visibility"}
    off = replace(exact, parameters=batch.parameters + torch.tensor([0.003, -0.001]))
    found = loss(off, batch)
    assert float(found["sizes"]) == pytest.approx(0.004, rel=1e-3)
    assert float(found["parameters"]) == pytest.approx(0, abs=1e-6)
    assert float(found["loss"]) == pytest.approx(0.04, rel=1e-3)
    doubted = loss(replace(off, doubt=torch.full((1, 1, 6), 0.002)), batch)
    doubt = math.log(2) + (1.5 + 0.5) / 6
    assert float(doubted["doubt"]) == pytest.approx(doubt, rel=1e-3)
    assert float(doubted["loss"]) == pytest.approx(0.04 + 2 * doubt, rel=1e-3)


@pytest.fixture
def bars(make_scene) -> tuple[TN42, Batch]:
    """Points of bars under the rule `point`, of which every exchange is taught to some."""
    part = TN42({"l": [36], "a": [13], "w": [11]})
    scenes = [make_scene(part, seed=seed, points=80) for seed in (0, 1)]
    items = [point_labels(scene, part.chain, KeypointChoice(KeypointRule.POINT)) for scene in scenes]
    batch = Collate()([{**item, "scene": torch.tensor(i)} for i, item in enumerate(items)])
    assert batch.lookalike.shape == (2, 80) and set(batch.lookalike.flatten().tolist()) == {0, 1, 2, 3}
    return part, batch


def test_exchanged_labels_have_the_sizes_of_their_bar(bars):
    part, batch = bars
    losses = ParametricLoss(part, "each")(perfect(batch), batch)
    assert float(losses["parameters"]) < 1e-6 and float(losses["keypoints"]) < 1e-6
    blind = ParametricLoss(part, "each")(perfect(batch), replace(batch, lookalike=None))
    assert float(blind["parameters"]) > 0.003  # the small end taken for the large one


def test_sizes_of_exchanged_keypoints_are_those_of_the_keypoints_carried_back(bars):
    """A noisy prediction measured point by point, with the exchange undone by names."""
    part, batch = bars
    predicted = noisy(batch)
    foot, side, toe, head, tip = (part.chain.names.index(n) for n in ("foot", "side", "toe", "head", "tip"))
    back = [
        {},
        {foot: toe, toe: foot, head: tip, tip: head},
        {foot: head, head: foot, toe: tip, tip: toe},
        {foot: tip, tip: foot, toe: head, head: toe},
    ]
    total = 0.0
    for i, j in np.ndindex(2, 80):
        c, kp = predicted.centroid[i, j].numpy(), predicted.keypoints[i, j].numpy()
        own = [kp[back[int(batch.lookalike[i, j])].get(place, place)] for place in range(5)]
        measured = [
            np.linalg.norm(own[toe] - own[foot]),
            np.linalg.norm(own[head] - own[foot]),
            2 * np.linalg.norm(own[side] - c),
        ]
        total += np.abs(np.subtract(measured, batch.parameters[i, j].numpy())).sum()
    found = ParametricLoss(part, "each")(predicted, batch)["parameters"]
    assert float(found) == pytest.approx(total / 160, rel=1e-4)
