"""Predicting scene by scene, and scoring what was predicted."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.data.poseutils import write_poseutils
from pnet.engine.evaluation import SceneScorer, predict_scenes
from pnet.engine.method import NetworkMethod, Timing
from pnet.metrics.sileane_results import score_folder
from pnet.postprocess.detections import no_detections
from pnet.records import Detections, Scene


def perfect(scene: Scene) -> Detections:
    d = len(scene.R)
    return Detections(
        R=torch.from_numpy(scene.R),
        t=torch.from_numpy(scene.t),
        parameters=torch.from_numpy(scene.parameters),
        score=torch.linspace(1, 0.5, d, dtype=torch.float64),
        keypoints=torch.zeros(d, 3, 3, dtype=torch.float64),
        instance=torch.from_numpy(scene.instance),
    )


def worsened(scene: Scene, seed: int) -> Detections:
    """Some bodies missed, some poses moved, some found twice, scores at random."""
    rng = np.random.default_rng(seed)
    found = perfect(scene)
    pick = torch.from_numpy(rng.integers(0, len(scene.R), len(scene.R)))
    off = torch.from_numpy(rng.normal(0, 0.002, (len(pick), 3)))
    return replace(
        found, R=found.R[pick], t=found.t[pick] + off, score=torch.from_numpy(rng.random(len(pick)))
    )


def test_perfect_detections_have_ap_one_and_no_error(part, make_scene):
    scenes = [make_scene(part, bodies=d, seed=d) for d in (1, 4, 6)]
    values = SceneScorer(part).add_all(scenes, map(perfect, scenes)).compute()
    assert [values[name] for name in ("AP", "MAP", "mAP", "F1", "recall_at_precision_99")] == pytest.approx(
        [1] * 5
    )
    errors = [values[f"{name}"] for name in ("position_error_mm", "axis_error_deg", "parameter_error_mm")]
    assert errors == pytest.approx([0, 0, 0], abs=1e-5)
    assert values["truths_to_find"] == values["true_positives"] == 11 and values["scenes"] == 3


def test_each_parameter_of_the_part_has_its_error(part, make_scene):
    """Every body's first parameter 1 mm too large, its second 2 mm too small, the others right."""
    scene = make_scene(part)
    found, off = perfect(scene), torch.zeros(part.k, dtype=torch.float64)
    off[0], off[1] = 0.001, -0.002
    values = SceneScorer(part).add_all([scene], [replace(found, parameters=found.parameters + off)]).compute()
    errors = [values[f"parameter_error_mm/{name}"] for name in part.parameter_names]
    assert errors == pytest.approx([1.0, 2.0, *[0.0] * (part.k - 2)], abs=1e-9)
    assert values["parameter_error_mm"] == pytest.approx(3.0 / part.k)


def test_nothing_found_is_ap_zero(tn34, make_scene):
    scene = make_scene(tn34)
    none = {name: value[:0] for name, value in vars(perfect(scene)).items()}
    values = SceneScorer(tn34).add_all([scene], [Detections(**none)]).compute()
    assert values["AP"] == 0 and values["results"] == 0 and np.isnan(values["position_error_mm"])


def test_map_weighs_part_objects_alike(tn34, make_scene):
    """Three scenes of one object found, one scene of another not: AP is per scene, mAP per object."""
    scenes = [make_scene(tn34, seed=0)] * 3 + [make_scene(tn34, seed=1)]
    found = [perfect(scene) for scene in scenes]
    found[3] = replace(found[3], t=found[3].t + 1.0)
    values = SceneScorer(tn34).add_all(scenes, found).compute()
    assert values["mAP"] == pytest.approx(0.5)
    assert values["MAP"] == pytest.approx(0.75)


def test_scenes_and_detections_must_be_as_many(tn34, make_scene):
    with pytest.raises(ValueError):
        SceneScorer(tn34).add_all([make_scene(tn34)], [])


@pytest.mark.parametrize("seed", range(3))
def test_the_score_of_exported_results_is_the_evaluators_own(part, make_scene, tmp_path, seed):
    scenes = [
        replace(make_scene(part, bodies=d, seed=0), occlusion=np.linspace(0, 0.8, d)) for d in (3, 5, 8)
    ]
    found = [worsened(scene, seed) for scene in scenes]
    for name in ("gt", "results"):
        (tmp_path / name).mkdir()
    for i, (scene, detections) in enumerate(zip(scenes, found, strict=True)):
        truth = [
            {"R": R.tolist(), "t": t.tolist(), "segmentation_id": j, "occlusion_rate": float(o)}
            for j, (R, t, o) in enumerate(zip(scene.R, scene.t, scene.occlusion, strict=True))
        ]
        results = [
            {"R": R.tolist(), "t": t.tolist(), "score": float(s)}
            for R, t, s in zip(detections.R, detections.t, detections.score, strict=True)
        ]
        (tmp_path / "gt" / f"{i:03d}.json").write_text(json.dumps(truth))
        (tmp_path / "results" / f"{i:03d}.json").write_text(json.dumps(results))
    write_poseutils(tmp_path / "poseutils.json", part.pose_space(scenes[0].parameters[0]))
    scored = score_folder(tmp_path, tmp_path / "results", tmp_path / "poseutils.json")
    own = SceneScorer(part).add_all(scenes, found).compute()
    assert 0 < own["AP"] < 1
    assert scored == pytest.approx({name: own[name] for name in ("AP", "MAP", "F1")}, abs=1e-12)


class Counting:
    """An estimator that finds as many instances as it got points, all at the origin."""

    def __init__(self, part):
        self.part, self.timing = part, Timing()

    def estimate(self, points):
        n = points.shape[1]
        zero = torch.zeros(n, 3)
        found = Detections(
            zero[:, None].expand(n, 3, 3), zero, zero, zero[:, 0], zero[:, None], zero[:, 0].long()
        )
        return [found for _ in points]


def test_predicting_takes_a_prefix_of_the_points_and_tells_its_progress(tn34, make_scene):
    scenes, steps = [make_scene(tn34, points=n) for n in (20, 50)], []
    assert [len(d.score) for d in predict_scenes(Counting(tn34), scenes, None, steps.append)] == [20, 50]
    assert [len(d.score) for d in predict_scenes(Counting(tn34), scenes, 30)] == [20, 30]
    assert steps == [1, 1]


def test_scenes_of_one_size_are_given_some_at_a_time(tn34, make_scene):
    """In order, each once."""
    sizes = [20] * 19 + [30, 20, 20]
    scenes, steps = [make_scene(tn34, points=n) for n in sizes], []
    assert [len(d.score) for d in predict_scenes(Counting(tn34), scenes, None, steps.append)] == sizes
    assert steps == [8, 8, 3, 1, 2]


@pytest.fixture
def estimator(tn34):
    from pnet.backbones.pointnet2 import Level, PointNet2
    from pnet.models.parametricnet import ParametricNet
    from pnet.postprocess.cluster import CentroidClusters
    from pnet.postprocess.pipeline import PoseRecovery
    from pnet.postprocess.vote import MeanVote

    torch.manual_seed(0)
    backbone = PointNet2([Level(16, 0.05, 8, [8])], [[12]])
    recovery = PoseRecovery(CentroidClusters(0.01, 5, 10), None, MeanVote(), 0.0, False, 0.9, None)
    return NetworkMethod(tn34, ParametricNet(backbone, 3, [8], [8], 0.02, True), recovery)


def test_the_estimator_counts_its_time_and_leaves_the_network_as_it_was(estimator, make_scene, tn34):
    cloud = torch.from_numpy(make_scene(tn34).points)[None]
    before = {name: value.clone() for name, value in estimator.network.state_dict().items()}
    estimator.network.train()
    estimator.estimate(torch.cat([cloud, cloud]))
    assert estimator.network.training and estimator.timing.scenes == 2
    assert estimator.timing.network > 0 and estimator.timing.postprocess > 0
    assert all(torch.equal(value, before[name]) for name, value in estimator.network.state_dict().items())


def test_the_recovery_is_told_what_the_network_says_of_its_clouds(estimator, make_scene, tn34):
    """On the CPU a scene at a time; the network alone says the same of each."""
    clouds = torch.stack([torch.from_numpy(make_scene(tn34, seed=seed).points) for seed in range(2)])
    given = []

    def note(part, prediction, points):
        given.append((prediction, points))
        return [no_detections(part, len(cloud)) for cloud in points]

    estimator.recovery = note
    assert [len(found.instance) for found in estimator.estimate(clouds)] == [400, 400]
    assert torch.equal(torch.cat([points for _, points in given]), clouds)
    with torch.no_grad():
        said = estimator.network.eval()(clouds[1:])
    assert torch.equal(given[1][0].keypoints, said.keypoints) and len(given) == 2


def test_an_empty_cloud_holds_nothing(estimator):
    found = estimator.estimate(torch.zeros(2, 0, 3))
    assert [len(d.score) for d in found] == [0, 0]


@pytest.mark.parametrize("depth", [0.0, -0.6])
def test_points_at_or_behind_the_camera_are_refused(part, depth):
    estimator = NetworkMethod(part, torch.nn.Linear(1, 1), None)
    cloud = torch.tensor([[[0.0, 0.0, 0.6], [0.0, 0.0, depth]]])
    with pytest.raises(ValueError, match="at or behind the camera"):
        estimator.estimate(cloud)


def test_a_scene_without_bodies_counts_every_result_as_false(tn34, make_scene):
    scene = make_scene(tn34, bodies=2)
    empty = replace(
        scene,
        R=scene.R[:0],
        t=scene.t[:0],
        parameters=scene.parameters[:0],
        visibility=scene.visibility[:0],
        occlusion=scene.occlusion[:0],
    )
    values = SceneScorer(tn34).add_all([empty], [perfect(scene)]).compute()
    assert values["AP"] == 0 and values["false_positives"] == 2 and values["truths_to_find"] == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_points_that_are_no_numbers_are_refused(estimator, make_scene, tn34, value):
    cloud = torch.from_numpy(make_scene(tn34).points.copy())[None]
    cloud[0, 5, 2] = value
    with pytest.raises(ValueError, match="NaN or infinite coordinates"):
        estimator.estimate(cloud)
