"""From a depth image to a method and back: pixels, background, sampling, batches."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pnet.data.background import Limits
from pnet.engine.depth_estimator import DepthEstimator
from pnet.engine.method import NetworkMethod, Timing
from pnet.geometry.camera import Camera
from pnet.ops.sampling import farthest_point_order
from pnet.postprocess.detections import no_detections
from pnet.records import Detections
from pnet.scenes.rendering import render_view

SMALL = Camera(4, 3, 10.0, 20.0, 1.5, 1.0, near=0.2, far=1.0)


class Recording:
    """A method that keeps what it is given and finds one instance at the mean of the points."""

    def __init__(self, part):
        self.part, self.timing, self.given = part, Timing(), []

    def estimate(self, points):
        self.given.append(points)
        if points.shape[1] == 0:
            return [no_detections(self.part, 0) for _ in points]
        self.timing.network += 0.5
        self.timing.postprocess += 0.25
        self.timing.scenes += len(points)
        return [self.one(cloud.double()) for cloud in points]

    def one(self, cloud):
        k, m = self.part.k, len(self.part.chain)
        return Detections(
            R=torch.eye(3, dtype=torch.float64)[None],
            t=cloud.mean(0)[None],
            parameters=torch.full((1, k), 0.02, dtype=torch.float64),
            score=torch.tensor([0.9]),
            keypoints=torch.zeros(1, m, 3),
            instance=torch.zeros(len(cloud), dtype=torch.int64),
        )


def test_pixels_become_points_by_the_pinhole_camera(tn34):
    depth = np.full((3, 4), np.nan)
    depth[0, 0], depth[2, 3], depth[1, 1] = 0.5, 0.8, 0.4
    method = Recording(tn34)
    found = DepthEstimator(method, 3).estimate(depth, SMALL)
    expected = np.array(
        [[(u - 1.5) / 10 * z, (v - 1.0) / 20 * z, z] for u, v, z in ((0, 0, 0.5), (1, 1, 0.4), (3, 2, 0.8))]
    )
    given = method.given[0][0].double().numpy()
    assert sorted(map(tuple, given.round(6))) == sorted(map(tuple, expected.round(6)))
    np.testing.assert_allclose(found.t[0], expected.mean(0), atol=1e-7)
    assert found.cloud.measured == found.cloud.kept == 3 and found.cloud.camera == SMALL
    assert len(found) == 1 and found.score.tolist() == pytest.approx([0.9])
    assert {k: v.tolist() for k, v in found.parameters.items()} == {"r": [0.02], "h": [0.02]}


@pytest.mark.parametrize("missing", [0.0, np.nan, 0.1, 1.5, np.inf])
def test_what_was_not_measured_or_is_out_of_range_is_left_out(tn34, missing):
    depth = np.full((3, 4), 0.5)
    depth[1, 2] = missing
    assert DepthEstimator(Recording(tn34), 8).estimate(depth, SMALL).cloud.measured == 11


def test_the_points_are_in_the_order_of_farthest_point_sampling(tn34):
    rng, method = np.random.default_rng(0), Recording(tn34)
    cloud = rng.uniform(-0.1, 0.1, (500, 3)) + np.array([0, 0, 0.6])
    DepthEstimator(method, 64).estimate_cloud(cloud)
    expected = cloud[farthest_point_order(cloud, 64)].astype(np.float32)
    np.testing.assert_array_equal(method.given[0][0].numpy(), expected)


def test_fewer_points_than_asked_for_are_repeated_and_nan_is_dropped(tn34):
    method = Recording(tn34)
    cloud = np.array([[0, 0, 0.5], [0.1, 0, 0.5], [np.nan, 0, 1]])
    found = DepthEstimator(method, 6).estimate_cloud(cloud)
    assert method.given[0].shape == (1, 6, 3) and found.cloud.measured == 2
    assert len(np.unique(method.given[0][0].numpy(), axis=0)) == 2


def test_the_background_is_taken_away_before_sampling(tn34):
    depth = np.full((3, 4), 0.5)
    depth[:, 2:] = 0.9
    limited = DepthEstimator(Recording(tn34), 6, background=Limits(z=[0.3, 0.7]))
    found = limited.estimate(depth, SMALL)
    assert (found.cloud.measured, found.cloud.kept) == (12, 6)
    assert found.cloud.points[:, 2].max() == np.float32(0.5)


def test_nothing_left_gives_no_detection_and_asks_no_network(tn34):
    method = Recording(tn34)
    found = DepthEstimator(method, 8).estimate(np.zeros((3, 4)), SMALL)
    assert len(found) == 0 and found.R.shape == (0, 3, 3) and found.parameters["r"].shape == (0,)
    assert all(given.shape[1] == 0 for given in method.given)


def test_seconds_of_a_batch_are_shared_by_its_images(tn34):
    estimator = DepthEstimator(Recording(tn34), 4, SMALL)
    clouds = [
        estimator.prepare(depth) for depth in (np.full((3, 4), 0.5), np.zeros((3, 4)), np.full((3, 4), 0.6))
    ]
    first, empty, last = estimator.recover(clouds)
    assert first.seconds["network"] == last.seconds["network"] == 0.25
    assert first.seconds["poses"] == 0.125 and "network" not in empty.seconds
    assert first.t[0, 2] == pytest.approx(0.5) and last.t[0, 2] == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("depth", "text"),
    [
        (np.zeros((4, 3)), r"depth image has shape \(4, 3\), the camera expects \(3, 4\)"),
        (np.full((3, 4), -0.1), "negative"),
    ],
)
def test_images_that_do_not_fit_are_refused(tn34, depth, text):
    with pytest.raises(ValueError, match=text):
        DepthEstimator(Recording(tn34), 4, SMALL).estimate(depth)


def test_an_image_needs_a_camera_and_a_cloud_three_columns(tn34):
    estimator = DepthEstimator(Recording(tn34), 4)
    with pytest.raises(ValueError, match="camera is not known"):
        estimator.estimate(np.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"shape \(5, 2\), expected \(n, 3\)"):
        estimator.estimate_cloud(np.zeros((5, 2)))


@pytest.fixture
def network(tn34):
    from pnet.backbones.pointnet2 import Level, PointNet2
    from pnet.models.parametricnet import ParametricNet
    from pnet.postprocess.cluster import CentroidClusters
    from pnet.postprocess.pipeline import PoseRecovery
    from pnet.postprocess.vote import MeanVote

    torch.manual_seed(0)
    backbone = PointNet2([Level(16, 0.05, 8, [8])], [[12]])
    recovery = PoseRecovery(CentroidClusters(0.01, 5, 10), None, MeanVote(), 0.0, False, 0.9, None)
    return NetworkMethod(tn34, ParametricNet(backbone, 3, [8], [8], 0.02, True), recovery)


@pytest.mark.parametrize("unet", [False, True], ids=["pointnet2", "range_unet"])
def test_images_together_are_found_like_images_alone(network, camera, tn34, unet):
    """Also where clouds of a batch share a grid, as those of the range U-Net do."""
    if unet:
        from pnet.backbones.range_unet import RangeUNet

        features = network.network.backbone.features
        network.network.backbone = RangeUNet([8, 12], 0.004, 0.6, 0.05, features).eval()
    estimator, size = DepthEstimator(network, 300, camera), tn34.part_object("L", 0)
    depths = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        R = Rotation.random(3, rng).as_matrix()
        t = (1 + 0.3 * seed) * np.array([[-0.03, 0, 0.6], [0.0, 0.02, 0.6], [0.03, 0, 0.62]])
        depths.append(render_view(camera, tn34.mesh(size), R, t).depth)
    together = estimator.recover([estimator.prepare(depth) for depth in depths])
    assert any(len(one) for one in together)
    for depth, one in zip(depths, together, strict=True):
        alone = estimator.estimate(depth)
        assert len(alone) == len(one)
        for name in ("R", "t", "score"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(one, name))
