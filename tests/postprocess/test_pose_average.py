"""Point-wise poses back to instances, whichever equivalent each point says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation
from tests.conftest import CONF, load_part

from pnet.cli.instantiate import instantiate
from pnet.geometry.rigid import rotation_angle
from pnet.geometry.symmetry import (
    FLIP,
    FiniteSymmetry,
    RevolutionSymmetry,
    nearest_equivalent,
    rotation_about_z,
)
from pnet.parts.tn34 import TN34
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.icp import IcpRefinement
from pnet.postprocess.pose_average import PoseAveraging, known_parameters
from pnet.records import Detections, PosePrediction, Scene

AVERAGING = PoseAveraging(CentroidClusters(0.01, 5, 10), visibility_threshold=0.0, votes=512, width=60.0)
PARTS = ["tn06", "tn16", "tn34", "tn42"]


@pytest.fixture(scope="module", params=PARTS)
def part(request):
    return load_part(request.param)


def random_elements(symmetry, n: int, rng: np.random.Generator) -> torch.Tensor:
    """(n, 3, 3) elements of the group."""
    match symmetry:
        case FiniteSymmetry(rotations=G):
            return G[rng.integers(len(G), size=n)]
        case RevolutionSymmetry(rotoreflection=reflected):
            turns = rotation_about_z(torch.from_numpy(rng.uniform(0, 2 * math.pi, n)))
            half = torch.from_numpy(rng.random(n) < 0.5) & reflected
            return torch.where(half[:, None, None], turns @ torch.tensor(FLIP).double(), turns)
    return torch.from_numpy(Rotation.random(n, rng).as_matrix())


def predict(part, scene: Scene, noise: float = 0.0, wild: float = 0.0, seed: int = 0) -> PosePrediction:
    """A network that knows each point's pose up to a symmetry element of its own; scene 1 of a batch, of
    scene 0 it says no numbers.

    Args:
        noise: of the rotation vector, radians. wild: share of points that say any rotation.
    """
    rng = np.random.default_rng(seed)
    n = len(scene.points)
    R = torch.from_numpy(scene.R)[scene.instance]
    R = torch.from_numpy(Rotation.from_rotvec(noise * rng.normal(size=(n, 3))).as_matrix()) @ R
    R = R @ random_elements(part.symmetry, n, rng)
    R = torch.where(
        torch.from_numpy(rng.random(n) < wild)[:, None, None],
        torch.from_numpy(Rotation.random(n, rng).as_matrix()),
        R,
    )
    t, seen = torch.from_numpy(scene.t)[scene.instance], torch.from_numpy(scene.visibility)[scene.instance]
    return PosePrediction(*(torch.stack([torch.full_like(value, math.nan), value]) for value in (t, R, seen)))


def recover(part, prediction: PosePrediction, points=None, **changes) -> Detections:
    clouds = None if points is None else torch.stack([torch.zeros_like(points), points])
    return replace(AVERAGING, **changes)(part, prediction, clouds)[1]


def matched(scene: Scene, found: Detections) -> torch.Tensor:
    """(bodies,) which detection stands nearest to each body."""
    return torch.cdist(torch.from_numpy(scene.t), found.t).argmin(1)


def angles(part, scene: Scene, found: Detections) -> torch.Tensor:
    """(bodies,) radians to the nearest equivalent of the truth."""
    R = found.R[matched(scene, found)]
    truth = torch.from_numpy(scene.R)
    return 2 * torch.asin(
        ((nearest_equivalent(truth, R, part.symmetry) - R).norm(dim=(-2, -1)) / math.sqrt(8)).clamp(max=1)
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("width", [25.0, 60.0, 180.0])
def test_exact_votes_give_every_instance_whichever_equivalent_they_are(part, make_scene, seed, width):
    scene = make_scene(part, bodies=6, points=600, seed=seed)
    found = recover(part, predict(part, scene, seed=seed), width=width)
    which = matched(scene, found)
    assert sorted(which.tolist()) == list(range(6)) and len(found.score) == 6
    assert float(angles(part, scene, found).max()) < 1e-6
    assert float((found.t[which] - torch.from_numpy(scene.t)).abs().max()) < 1e-9
    assert torch.equal(found.instance, which[scene.instance])
    torch.testing.assert_close(found.score[which], torch.from_numpy(scene.visibility), rtol=0, atol=1e-12)
    assert found.score.tolist() == sorted(found.score.tolist(), reverse=True)


def test_the_distance_of_the_benchmark_is_nothing_then(part, make_scene):
    scene = make_scene(part, bodies=6, points=600)
    found = recover(part, predict(part, scene))
    R, t = torch.from_numpy(scene.R), torch.from_numpy(scene.t)
    space = part.pose_space(scene.parameters[0])
    assert float(space.pairwise_distance(R, t, found.R, found.t).amin(1).max()) < 1e-8


@pytest.mark.parametrize("seed", range(3))
def test_a_third_of_wild_votes_turns_a_pose_by_little(part, make_scene, seed):
    """Votes with 3° of noise, three in ten of them anything."""
    scene = make_scene(part, bodies=6, points=1200, seed=seed)
    found = recover(part, predict(part, scene, noise=math.radians(3), wild=0.3, seed=seed))
    assert len(found.score) == 6
    assert math.degrees(float(angles(part, scene, found).max())) < 2


def test_float32_predictions_make_float64_detections(part, make_scene):
    scene = make_scene(part, bodies=3, points=300)
    given = predict(part, scene)
    single = PosePrediction(given.centroid.float(), given.rotation.float(), given.visibility.float())
    found = recover(part, single)
    assert {v.dtype for v in (found.R, found.t, found.score, found.parameters)} == {torch.float64}
    assert float(angles(part, scene, found).max()) < 1e-5
    eye = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    torch.testing.assert_close(found.R @ found.R.mT, eye, rtol=0, atol=1e-6)
    assert float(torch.linalg.det(found.R).min()) > 0


def test_every_scene_of_a_batch_has_its_own_instances(make_scene):
    part = load_part("tn34")
    scenes = [make_scene(part, bodies=n, points=300, seed=n) for n in (2, 3)]
    each = [predict(part, scene) for scene in scenes]
    both = PosePrediction(
        *(torch.stack([getattr(p, name)[1] for p in each]) for name in ("centroid", "rotation", "visibility"))
    )
    for i, (scene, found) in enumerate(zip(scenes, AVERAGING(part, both), strict=True)):
        assert len(found.score) == i + 2 and float(angles(part, scene, found).max()) < 1e-6


def outer_mean(R: torch.Tensor, weight: np.ndarray) -> torch.Tensor:
    """Of rotations (n, 3, 3): the largest eigenvector of Σ w q qᵀ (Markley et al. 2007)."""
    q = Rotation.from_matrix(R.numpy()).as_quat()
    values, vectors = np.linalg.eigh(np.einsum("n,ni,nj->ij", weight, q, q))
    return torch.from_numpy(Rotation.from_quat(vectors[:, values.argmax()]).as_matrix())


def naive_mean(part, votes: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """Each vote's equivalent nearest to the mean, by trying all; weighted by cos⁴(θ / 2), as at a width of
    180°; again and again."""
    G, mean = part.symmetry.rotations, start
    for _ in range(60):
        images = votes[:, None] @ G
        nearest = rotation_angle(images, mean.expand_as(images)).argmin(1)
        chosen = images[torch.arange(len(votes)), nearest]
        angle = rotation_angle(chosen, mean.expand_as(chosen)).numpy()
        mean = outer_mean(chosen, np.cos(angle / 2) ** 4)
    return mean


@pytest.mark.parametrize("name", ["tn06", "tn42", "knob"])
@pytest.mark.parametrize("noise", [0.02, 0.08])
def test_it_is_the_quaternions_mean_of_the_nearest_equivalents(make_scene, name, noise):
    part = load_part(name)
    made = make_scene(part, bodies=3, points=180, seed=2)
    keep = np.concatenate([np.flatnonzero(made.instance == i)[: 20 * (i + 1)] for i in range(3)])
    scene = replace(made, points=made.points[keep], instance=made.instance[keep])  # 20, 40 and 60 points
    prediction = predict(part, scene, noise=noise)
    found = recover(part, prediction, width=180.0)
    for body, which in enumerate(matched(scene, found)):
        votes, truth = prediction.rotation[1][scene.instance == body], torch.from_numpy(scene.R[body])
        expected = naive_mean(part, votes, truth)
        same = nearest_equivalent(expected, found.R[which], part.symmetry)
        torch.testing.assert_close(found.R[which], same, rtol=0, atol=1e-7)
        # and, as cos⁴ of a few degrees is almost one, of the plain mean
        plain = outer_mean(nearest_equivalent(votes, truth, part.symmetry), np.ones(len(votes)))
        assert float(rotation_angle(expected, plain)) < noise**2
        assert float(rotation_angle(expected, truth)) > 1e-4


@pytest.mark.parametrize("name", ["tn34", "tn16"])
def test_the_axis_is_the_mean_of_the_axes(make_scene, name):
    part = load_part(name)
    scene = make_scene(part, bodies=3, points=120, seed=2)
    prediction = predict(part, scene, noise=0.05)
    found = recover(part, prediction, width=180.0)
    for body, which in enumerate(matched(scene, found)):
        axes = prediction.rotation[1][scene.instance == body][..., 2]
        mean = found.R[which, :, 2]
        axes = torch.where((axes @ mean)[:, None] < 0, -axes, axes)
        for _ in range(40):  # cos⁴(θ / 2), as at a width of 180°
            weight = ((1 + (axes @ mean).clamp(max=1)) / 2) ** 2
            mean = torch.nn.functional.normalize(weight @ axes, dim=0)
        torch.testing.assert_close(found.R[which, :, 2], mean, rtol=0, atol=1e-7)


def test_only_so_many_votes_of_a_cluster_count(make_scene):
    """The first ten of each say one thing, all others another."""
    part = load_part("tn42")
    scene = make_scene(part, bodies=3, points=300)
    prediction = predict(part, scene)
    late = np.array([(scene.instance[:n] == body).sum() >= 10 for n, body in enumerate(scene.instance)])
    prediction.rotation[1, late] = prediction.rotation[1, late].roll(1, -1)
    assert float(angles(part, scene, recover(part, prediction, votes=10)).max()) < 1e-6
    assert float(angles(part, scene, recover(part, prediction, votes=512)).min()) > 1.5


def test_points_that_are_hidden_do_not_count(make_scene):
    """Body 1 is below T_v; of body 2 half the points are, and these have wrong poses."""
    part = load_part("tn34")
    scene = replace(make_scene(part, bodies=3, points=300), visibility=np.array([0.9, 0.44, 0.6]))
    prediction = predict(part, scene)
    odd = (scene.instance == 2) & (np.arange(300) % 2 == 1)
    prediction.visibility[1, odd] = 0.1
    prediction.centroid[1, odd] += 0.004
    prediction.rotation[1, odd] = prediction.rotation[1, odd].roll(1, -1)
    found = recover(part, prediction, visibility_threshold=0.45)
    assert found.score.tolist() == pytest.approx([0.9, 0.6])
    torch.testing.assert_close(found.t, torch.from_numpy(scene.t[[0, 2]]), rtol=0, atol=1e-9)
    expected = np.select([scene.instance == 0, (scene.instance == 2) & ~odd], [0, 1], -1)
    assert found.instance.tolist() == expected.tolist()
    everything = recover(part, prediction)
    assert len(everything.score) == 3
    assert float((everything.t[2] - torch.from_numpy(scene.t[2])).norm()) > 0.001


def test_without_the_visibility_head_the_score_is_the_share_of_points(part, make_scene):
    scene = make_scene(part, bodies=3, points=600)
    keep = np.concatenate([np.flatnonzero(scene.instance == i)[: 50 * (i + 2)] for i in range(3)])
    fewer = replace(scene, points=scene.points[keep], instance=scene.instance[keep])
    prediction = replace(predict(part, fewer), visibility=None)
    found = recover(part, prediction, visibility_threshold=0.45)
    assert found.score.tolist() == pytest.approx([200 / 450, 150 / 450, 100 / 450])
    assert matched(scene, found).tolist() == [2, 1, 0]


@pytest.mark.parametrize("name", [*PARTS, "knob"])
def test_a_size_that_is_not_known_is_nan(make_scene, name):
    part = load_part(name)
    scene = make_scene(part, bodies=3, points=300)
    found = recover(part, predict(part, scene))
    assert found.parameters.shape == (3, part.k) and bool(found.parameters.isnan().all())
    assert found.keypoints.shape == (3, len(part.chain), 3)
    assert bool(found.keypoints.isnan().all())
    assert bool(found.R.isfinite().all()) and bool(found.t.isfinite().all())


@pytest.mark.parametrize("name", ["gear", "candlestick", "tless20"])
def test_a_part_with_one_part_object_has_its_parameters(make_scene, name):
    part = load_part(name)
    made = make_scene(part, bodies=3, points=300)
    scene = replace(made, t=made.t * np.array([4, 4, 1]))
    found = recover(part, predict(part, scene))
    assert found.parameters.tolist() == [part.grids["L"][0].tolist()] * 3
    template = part.chain.keypoints_from_parameters(torch.from_numpy(part.grids["L"][:1]))[0]
    expected = torch.stack([R @ template.T + t[:, None] for R, t in zip(found.R, found.t, strict=True)]).mT
    torch.testing.assert_close(found.keypoints, expected, rtol=0, atol=1e-12)
    assert bool(expected.isfinite().all())


def test_another_size_in_the_other_grid_is_not_known():
    same = TN34({"r": [18], "h": [16]}, {"r": [18], "h": [16]})
    other = TN34({"r": [18], "h": [16]}, {"r": [18], "h": [17]})
    assert known_parameters(same, 2).tolist() == [[0.018, 0.016]] * 2
    assert bool(known_parameters(other, 2).isnan().all())
    assert known_parameters(same, 0).shape == (0, 2)


def no_centroids(prediction: PosePrediction) -> PosePrediction:
    return replace(prediction, centroid=prediction.centroid * math.nan)


def no_rotation(prediction: PosePrediction) -> PosePrediction:
    rotation = prediction.rotation.clone()
    rotation[1, 7] = math.nan
    return replace(prediction, rotation=rotation)


def no_visibility(prediction: PosePrediction) -> PosePrediction:
    return replace(prediction, visibility=prediction.visibility * math.nan)


def scattered(prediction: PosePrediction) -> PosePrediction:
    steps = torch.arange(prediction.centroid.shape[1]).view(1, -1, 1).double()
    return replace(prediction, centroid=prediction.centroid + steps)


@pytest.mark.parametrize("spoil", [no_centroids, no_rotation, no_visibility, scattered])
def test_where_there_is_nothing_nothing_is_found(part, make_scene, spoil):
    scene = make_scene(part, bodies=3, points=300)
    found = recover(part, spoil(predict(part, scene)))
    assert found.R.shape == (0, 3, 3) and found.t.shape == (0, 3) and found.score.shape == (0,)
    assert found.parameters.shape == (0, part.k)
    assert found.keypoints.shape == (0, len(part.chain), 3)
    assert found.instance.tolist() == [-1] * 300


def test_a_scene_without_points_has_no_instances():
    part = load_part("tn34")
    for seen in (torch.zeros(2, 0), None):
        found = recover(part, PosePrediction(torch.zeros(2, 0, 3), torch.zeros(2, 0, 3, 3), seen))
        assert len(found.score) == len(found.instance) == 0


class Shift(IcpRefinement):
    """Notes what it is given; moves every pose by a millimetre along x and turns it about the view axis."""

    def __call__(self, part, parameters, R, t, points, owner):
        self.given.append((parameters, points, owner))
        return rotation_about_z(torch.tensor(0.1).double()) @ R, t + torch.tensor([0.001, 0, 0]).double()


@pytest.fixture
def shift() -> Shift:
    made = Shift(2000, 0.005, 30, 20)
    object.__setattr__(made, "given", [])
    return made


def test_refinement_has_the_last_word_on_the_pose(make_scene, shift):
    part = load_part("gear")
    made = make_scene(part, bodies=3, points=300)
    scene = replace(made, t=made.t * np.array([4, 4, 1]))
    prediction, cloud = predict(part, scene), torch.from_numpy(scene.points)
    plain, moved = recover(part, prediction), recover(part, prediction, cloud, refine=shift)
    torch.testing.assert_close(moved.t, plain.t + torch.tensor([0.001, 0, 0]).double())
    turn = rotation_about_z(torch.tensor(0.1).double())
    torch.testing.assert_close(moved.R, turn @ plain.R)
    expected = (plain.keypoints - plain.t[:, None]) @ turn.mT + moved.t[:, None]
    torch.testing.assert_close(moved.keypoints, expected)
    ((parameters, points, owner),) = shift.given
    assert parameters.tolist() == [part.grids["L"][0].tolist()] * 3
    assert torch.equal(points, cloud.double()) and points.dtype == torch.float64
    assert len(owner) == 300 and sorted(owner.unique().tolist()) == [0, 1, 2]


def test_refinement_without_points_is_refused(make_scene, shift):
    part = load_part("gear")
    prediction = predict(part, make_scene(part, bodies=1, points=300))
    with pytest.raises(ValueError, match=r"postprocess\.refine needs the scenes' points"):
        recover(part, prediction, refine=shift)
    assert shift.given == []


def test_refinement_of_an_unknown_size_is_refused(make_scene):
    part = load_part("tn34")
    scene = make_scene(part, bodies=2, points=300)
    icp = IcpRefinement(2000, 0.005, 30, 20)
    with pytest.raises(ValueError, match="ICP needs the part's size"):
        recover(part, predict(part, scene), torch.from_numpy(scene.points), refine=icp)


def test_icp_mends_poses_that_are_off(make_scene):
    pytest.importorskip("small_gicp", reason="needs the extra [icp]")
    part = load_part("tless20")
    made = make_scene(part, bodies=3, points=1500)
    scene = replace(made, t=made.t * np.array([6, 6, 1]))
    points = made.points + (scene.t - made.t)[made.instance].astype(np.float32)
    prediction = predict(part, scene)
    prediction.centroid[1] += torch.tensor([0.001, -0.001, 0.001]).double()
    icp = IcpRefinement(2000, 0.005, 30, 20)
    before = recover(part, prediction)
    after = recover(part, prediction, torch.from_numpy(points), refine=icp)
    truth = torch.from_numpy(scene.t)
    off = [float((found.t[matched(scene, found)] - truth).norm(dim=1).max()) for found in (before, after)]
    assert off[0] == pytest.approx(0.001 * math.sqrt(3), rel=1e-3)
    assert off[1] < 0.7 * off[0]


def test_the_config_makes_it():
    settings = OmegaConf.load(CONF / "postprocess" / "pprnet.yaml")
    cluster = OmegaConf.load(CONF / "cluster" / "paper.yaml")
    made = instantiate(OmegaConf.merge(settings, cluster, OmegaConf.load(CONF / "refine" / "none.yaml")))
    assert isinstance(made, PoseAveraging)
    assert (made.votes, made.width, made.refine, made.visibility_threshold) == (512, 60.0, None, 0.45)
