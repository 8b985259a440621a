"""From point-wise predictions to instances."""

from dataclasses import replace

import pytest
import torch

from pnet.data.targets import point_labels
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.folded_vote import FoldedVote
from pnet.postprocess.pipeline import PoseRecovery
from pnet.postprocess.radius_filter import RadiusFilter
from pnet.postprocess.vote import MeanVote
from pnet.records import Detections, PointPrediction, Scene

RECOVERY = PoseRecovery(
    CentroidClusters(0.01, 5, 10),
    RadiusFilter(0.01, 5, 0.002, 0.02, 0.1),
    MeanVote(),
    visibility_threshold=0.0,
    scene_parameters=False,
    best_visible=0.9,
    trust=None,
)


FOLDED = {"voting": FoldedVote(96, 512, 25.0, 3.0), "radius_filter": None}
UPRIGHT = KeypointChoice(direction=(0, 1, 0))
POINT = KeypointChoice(KeypointRule.POINT)


def predict(
    scene: Scene, part, noise: float = 0.0, visibility: bool = True, choice: KeypointChoice = UPRIGHT
) -> PointPrediction:
    """A network that knows the labels up to noise; scene 1 of a batch, of scene 0 it says no numbers."""
    labels = point_labels(scene, part.chain, choice)
    generator = torch.Generator().manual_seed(0)

    def batch(value):
        noisy = value + noise * torch.randn(value.shape, generator=generator)
        return torch.stack([torch.full_like(noisy, torch.nan), noisy])

    shown = torch.stack([labels["visibility"], labels["visibility"]])
    return PointPrediction(
        batch(labels["centroid"]), batch(labels["keypoints"]), shown if visibility else None
    )


def recover(part, scene, prediction=None, **changes) -> Detections:
    prediction = predict(scene, part) if prediction is None else prediction
    return replace(RECOVERY, **changes)(part, prediction)[1]


def paired(part, scene: Scene, found: Detections) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance of each true body to its nearest detection, and which that is."""
    space = part.pose_space(scene.parameters[0])
    R, t = torch.from_numpy(scene.R), torch.from_numpy(scene.t)
    distance, nearest = space.pairwise_distance(R, t, found.R, found.t).min(1)
    return distance, nearest


def test_perfect_predictions_give_every_instance_exactly(part, make_scene):
    scene = make_scene(part, bodies=6, points=600)
    found = recover(part, scene)
    distance, nearest = paired(part, scene, found)
    assert len(found.score) == 6 and sorted(nearest.tolist()) == list(range(6))
    assert float(distance.max()) < 1e-6
    torch.testing.assert_close(
        found.parameters[nearest], torch.from_numpy(scene.parameters), rtol=0, atol=1e-6
    )
    torch.testing.assert_close(found.score[nearest], torch.from_numpy(scene.visibility), rtol=0, atol=1e-6)
    assert torch.equal(found.instance, nearest[torch.from_numpy(scene.instance)])
    assert found.keypoints.shape == (6, 3, 3)
    assert found.score.tolist() == sorted(found.score.tolist(), reverse=True)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("trust", [None, 0.001])
def test_noise_of_half_a_millimetre_averages_out(part, make_scene, seed, trust):
    scene = make_scene(part, bodies=7, points=1400, seed=seed)
    found = recover(part, scene, predict(scene, part, 0.0005), trust=trust)
    distance, nearest = paired(part, scene, found)
    assert len(found.score) == 7 and len(set(nearest.tolist())) == 7
    assert float(distance.max()) < part.pose_space(scene.parameters[0]).distance_threshold / 2
    assert float((found.parameters[nearest] - torch.from_numpy(scene.parameters)).abs().max()) < 0.0005


@pytest.mark.parametrize("choice", [UPRIGHT, POINT], ids=["camera", "point"])
@pytest.mark.parametrize("noise", [0.0, 0.0005])
@pytest.mark.parametrize("trust", [None, 0.001])
def test_folded_votes_give_every_instance_under_either_rule(any_part, make_scene, choice, noise, trust):
    scene = make_scene(any_part, bodies=6, points=1200)
    found = recover(any_part, scene, predict(scene, any_part, noise, choice=choice), **FOLDED, trust=trust)
    distance, nearest = paired(any_part, scene, found)
    assert len(found.score) == 6 and sorted(nearest.tolist()) == list(range(6))
    assert float(distance.max()) < 1e-6 + noise
    sizes = torch.from_numpy(scene.parameters)
    torch.testing.assert_close(found.parameters[nearest], sizes, rtol=0, atol=1e-6 + noise / 2)


def test_plain_means_cannot_read_labels_of_the_rule_point(tn06, make_scene):
    scene = make_scene(tn06, bodies=6, points=1200)
    prediction = predict(scene, tn06, choice=POINT)
    threshold = tn06.pose_space(scene.parameters[0]).distance_threshold
    plain = paired(tn06, scene, recover(tn06, scene, prediction, radius_filter=None))[0]
    folded = paired(tn06, scene, recover(tn06, scene, prediction, **FOLDED))[0]
    assert float(folded.max()) < 1e-6 and float(plain.max()) > threshold / 2


def test_without_the_radius_filter_every_vote_counts(tn34, make_scene):
    """Of body 0's rim votes some lie far off: the filter leaves them out, the mean does not."""
    scene = make_scene(tn34, bodies=3, points=600)
    prediction = predict(scene, tn34)
    bad = torch.nonzero(torch.from_numpy(scene.instance) == 0).squeeze(1)[:20]
    prediction.keypoints[1, bad, 2] += 0.05 + 0.03 * torch.arange(20)[:, None]
    truth = recover(tn34, scene).keypoints
    filtered = recover(tn34, scene, prediction).keypoints
    plain = recover(tn34, scene, prediction, radius_filter=None).keypoints
    torch.testing.assert_close(filtered, truth, rtol=0, atol=1e-6)
    # a tenth of the votes, off by 50 mm to 620 mm along each axis
    off = (plain - truth).abs().amax((0, 1))
    torch.testing.assert_close(off, torch.full((3,), 0.0335, dtype=torch.float64), rtol=0, atol=1e-5)


def test_scattered_votes_weigh_less_with_trust(tn34, make_scene):
    scene = make_scene(tn34, bodies=4, points=1200)
    prediction = predict(scene, tn34)
    generator = torch.Generator().manual_seed(0)
    # the rim's votes scatter, around a place that is off
    prediction.keypoints[1, :, 2] += 0.01 + 0.008 * torch.randn(1200, 3, generator=generator)
    plain = paired(tn34, scene, recover(tn34, scene, prediction))[0]
    trusting = paired(tn34, scene, recover(tn34, scene, prediction, trust=0.001))[0]
    assert float(trusting.max()) < float(plain.min()) / 2


def test_without_visibility_the_score_is_the_share_of_points(tn34, make_scene):
    scene = make_scene(tn34, bodies=3, points=600)
    keep = torch.cat(
        [
            torch.nonzero(torch.from_numpy(scene.instance) == i).squeeze(1)[: (200, 100, 50)[i]]
            for i in range(3)
        ]
    )
    whole = predict(scene, tn34, visibility=False)
    prediction = PointPrediction(whole.centroid[:, keep], whole.keypoints[:, keep], None)
    found = recover(tn34, scene, prediction)
    assert found.score.tolist() == [200 / 350, 100 / 350, 50 / 350]
    assert paired(tn34, scene, found)[1].tolist() == [0, 1, 2]


def test_the_visibility_threshold_leaves_out_the_hidden(tn34, make_scene):
    scene = replace(make_scene(tn34, bodies=4), visibility=torch.tensor([0.2, 0.9, 0.44, 0.46]).numpy())
    found = recover(tn34, scene, visibility_threshold=0.45)
    torch.testing.assert_close(found.score.float(), torch.tensor([0.9, 0.46]))
    nearest = paired(tn34, scene, found)[1]
    assert nearest[[1, 3]].tolist() == [0, 1]
    owner = torch.from_numpy(scene.instance)
    assert set(found.instance[(owner == 0) | (owner == 2)].tolist()) == {-1}
    assert set(found.instance[owner == 3].tolist()) == {1}


def test_without_visibility_nothing_is_left_out_for_it(tn34, make_scene):
    scene = make_scene(tn34, bodies=3, points=700)
    few = torch.from_numpy(scene.instance != 2) | (torch.arange(700) % 7 == 0)
    scene = replace(scene, points=scene.points[few.numpy()], instance=scene.instance[few.numpy()])
    found = recover(tn34, scene, predict(scene, tn34, visibility=False), visibility_threshold=0.45)
    assert len(found.score) == 3 and float(found.score.min()) < 0.2


def test_scene_parameters_are_the_mean_of_the_best_visible(tn34, make_scene):
    scene = make_scene(tn34, bodies=3, points=300)
    sizes = scene.parameters * [[1.0], [1.2], [5.0]]
    scene = replace(scene, parameters=sizes, visibility=torch.tensor([1.0, 0.9, 0.3]).numpy())
    each = recover(tn34, scene).parameters
    torch.testing.assert_close(each, torch.from_numpy(sizes), rtol=0, atol=1e-6)
    shared = recover(tn34, scene, scene_parameters=True, best_visible=0.7).parameters
    expected = torch.from_numpy(sizes[:2].mean(0)).expand(3, 2)
    torch.testing.assert_close(shared, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(
        recover(tn34, scene, scene_parameters=True, best_visible=1.0).parameters,
        torch.from_numpy(sizes[:1]).expand(3, 2),
        rtol=0,
        atol=1e-6,
    )


def test_nothing_dense_gives_no_detections(part, make_scene):
    scene = make_scene(part)
    prediction = predict(scene, part, noise=10.0)
    found = recover(part, scene, prediction)
    assert found.R.shape == (0, 3, 3) and found.t.shape == (0, 3) and found.score.shape == (0,)
    assert found.parameters.shape == (0, part.k) and found.keypoints.shape == (0, 3, 3)
    assert found.instance.tolist() == [-1] * 400


@pytest.mark.parametrize("points", [0, 1, 7])
def test_few_points_give_no_detections(tn34, make_scene, points):
    whole = predict(make_scene(tn34, bodies=1), tn34)
    few = PointPrediction(
        whole.centroid[:, :points], whole.keypoints[:, :points], whole.visibility[:, :points]
    )
    found = recover(tn34, None, few)
    assert len(found.score) == 0 and found.instance.shape == (points,)


def test_nan_predictions_give_no_detections(tn34, make_scene):
    scene = make_scene(tn34)
    prediction = predict(scene, tn34)
    prediction.centroid[1, 3] = float("nan")
    assert len(recover(tn34, scene, prediction).score) == 0
