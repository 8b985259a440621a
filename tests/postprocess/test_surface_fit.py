"""Poses and the size of a scene's instances fitted to its cloud: what is off by millimetres comes back."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tests.conftest import CONF, load_part
from tests.postprocess.test_icp import displaced, errors
from tests.postprocess.test_pipeline import RECOVERY
from tests.postprocess.test_pipeline import predict as predict_keypoints
from tests.postprocess.test_pose_average import AVERAGING, matched
from tests.postprocess.test_pose_average import predict as predict_poses

from pnet.cli.instantiate import instantiate
from pnet.geometry.camera import Camera
from pnet.geometry.rigid import apply_pose, rotation_angle
from pnet.geometry.symmetry import nearest_equivalent
from pnet.parts.base import ParametricPart
from pnet.postprocess.pose_average import PoseAveraging
from pnet.postprocess.surface import sample_surface
from pnet.postprocess.surface_fit import SAME, WIDER, SurfaceFit, _Fit, _Poses, similar_turns
from pnet.postprocess.surface_registration import OwnPoints, Sight, misfit
from pnet.records import Detections, Scene, SceneId
from pnet.scenes.rendering import render_view

CAMERA = Camera(200, 150, 560.0, 560.0, 99.5, 74.5, near=0.3, far=1.0)
FLOOR = 0.66  # metres
EYE = torch.eye(3, dtype=torch.float64)
STEPS = [0.0024, 0.0012, 0.0006, 0.0003]
QUICK = SurfaceFit(
    samples=300,
    points=32,
    steps=4,
    reach=0.001,
    slack=0.0002,
    free=1.0,
    alike=0.0,
    sizes=[0.0012, 0.0006],
    shared=True,
    hold=0.003,
    larger=0.005,
    doubtful=0.001,
    ambiguous=None,
)
EXACT = replace(QUICK, points=48, steps=8, alike=0.15, sizes=STEPS)

Seen = tuple[torch.Tensor, Detections]


def where(bodies: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Random orientations 60 mm apart, so that none hides another."""
    place = np.arange(bodies)
    t = np.stack([0.06 * (place % 3 - 1), 0.06 * (place // 3 - 0.5), 0.6 + 0.002 * place], -1)
    R = Rotation.random(bodies, np.random.default_rng(seed)).as_matrix()
    return torch.from_numpy(R), torch.from_numpy(t)


def view(part: ParametricPart, sizes, R, t, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Cloud (N, 3) of bodies, each of its own size, on a floor; which body (N,) a point lies on, −1: none."""
    depth = np.full((CAMERA.height, CAMERA.width), FLOOR)
    instance = np.full(depth.shape, -1)
    for i in range(len(R)):
        body = render_view(CAMERA, part.mesh(sizes[i].numpy()), R[i : i + 1].numpy(), t[i : i + 1].numpy())
        nearer = (body.instance == 0) & (body.depth < depth)
        depth[nearer], instance[nearer] = body.depth[nearer], i
    order = np.random.default_rng(seed).permutation(depth.size)
    cloud, owner = CAMERA.depth_to_points(depth).reshape(-1, 3)[order], instance.reshape(-1)[order]
    return torch.from_numpy(cloud), torch.from_numpy(owner)


def detections(part: ParametricPart, sizes, R, t, owner) -> Detections:
    """What a method found in one scene, as the batch of it."""
    score = torch.linspace(0.9, 0.5, len(R), dtype=torch.float64)
    return Detections(
        R, t, sizes, score, apply_pose(R, t, part.chain.keypoints_from_parameters(sizes)), owner
    )


def one_scene(part: ParametricPart, size, bodies: int, seed: int = 0, off: float = 0.0) -> Seen:
    """A scene of one part object; detections 1.5 mm and 5° off, their sizes by `off` up and down in turn."""
    R, t = where(bodies, seed)
    sizes = torch.from_numpy(np.asarray(size)).expand(bodies, -1)
    cloud, owner = view(part, sizes, R, t, seed)
    said = sizes + off * (-1.0) ** torch.arange(part.k)
    return cloud, detections(part, said, *displaced(R, t, 0.0015, 5, seed), owner)


def fitted(fit: SurfaceFit, part: ParametricPart, *scenes: Seen) -> Detections:
    """All of them as one batch, which numbers the instances through."""
    first, owners = 0, []
    for _, found in scenes:
        owners.append(torch.where(found.instance >= 0, found.instance + first, -1))
        first += len(found.score)
    stacked = {f.name: torch.cat([getattr(found, f.name) for _, found in scenes]) for f in fields(Detections)}
    together = Detections(**{**stacked, "instance": torch.stack(owners)})
    clouds = torch.stack([cloud for cloud, _ in scenes])
    return fit.refined(part, together, clouds, [len(found.score) for _, found in scenes])


def parts_of(found: Detections) -> tuple[torch.Tensor, ...]:
    return found.R, found.t, found.parameters, found.score


@pytest.fixture(scope="module")
def flange(tn34) -> tuple[ParametricPart, torch.Tensor, Seen]:
    """Three flanges: the part, its size and the scene with sizes 1 mm off."""
    size = torch.tensor([0.016, 0.016], dtype=torch.float64)
    return tn34, size, one_scene(tn34, size, 3, off=0.001)


def is_among(turn: torch.Tensor, turns: torch.Tensor) -> bool:
    return float(rotation_angle(turn.expand_as(turns), turns).min()) < 1e-9


def about(axis: str, quarters: int) -> torch.Tensor:
    return torch.from_numpy(Rotation.from_euler(axis, 90 * quarters, degrees=True).as_matrix())


def test_a_bars_quarter_turns_and_its_ends_look_alike(tn42):
    turns = similar_turns(tn42, 0.15)
    assert turns.shape == (8, 3, 3) and turns.dtype == torch.float64
    assert torch.equal(turns[0], EYE)
    quarters = [about("x", i) for i in range(4)]
    for turn in [*quarters, *(about("z", 2) @ quarter for quarter in quarters)]:
        assert is_among(turn, turns)


@pytest.mark.parametrize("alike", [0.08, 0.15, 0.4])
def test_every_quarter_turn_is_alike_or_not_by_its_distance(any_part, alike):
    """Of the 24 those that lay the surface near itself are tried, or an equivalent of them; none twice."""
    turns = similar_turns(any_part, alike)
    points = sample_surface(any_part, tuple(any_part.grids["L"].mean(0).tolist()), 500).points
    tree, radius = cKDTree(points), np.linalg.norm(points, axis=1).max()
    for turn in Rotation.create_group("O").as_matrix():
        near = tree.query(points @ turn.T)[0].mean() <= alike * radius
        exact = torch.from_numpy(turn).expand_as(turns)
        angle = rotation_angle(nearest_equivalent(exact, turns, any_part.symmetry), turns)
        known = int((angle < 1e-6).sum())
        # an equivalent turn may be a little nearer or farther: its samples are others
        assert known == 1 if near else known <= 1
    assert torch.equal(turns[0], EYE)
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(len(turns)).double())


@pytest.mark.parametrize(("name", "count"), [("tn06", 6), ("tn34", 6), ("tn42", 24)])
def test_no_turn_is_tried_twice_for_its_symmetry(name, count):
    """Of all 24, however unlike: the nut's four half turns and the flange's four turns about z count once."""
    symmetry = load_part(name).symmetry
    turns = similar_turns(load_part(name), 10.0)
    pairs = [(a, b) for i, a in enumerate(turns) for b in turns[:i]]
    apart = [rotation_angle(nearest_equivalent(a, b, symmetry), b) for a, b in pairs]
    assert len(turns) == count and min(map(float, apart)) > SAME


def test_without_a_share_nothing_is_turned(any_part):
    assert torch.equal(similar_turns(any_part, 0.0), EYE[None])


def test_sizes_and_poses_of_flanges_come_back(tn34):
    size = torch.tensor([0.018, 0.019], dtype=torch.float64)
    R, t = where(4, 0)
    sizes = size.expand(4, -1)
    scene = one_scene(tn34, size, 4, off=0.002)
    found = fitted(EXACT, tn34, scene)
    assert float((found.parameters - size).abs().max()) < 0.00015  # 2 mm before
    before = errors(tn34, sizes, R, t, scene[1].R, scene[1].t)
    after = errors(tn34, sizes, R, t, found.R, found.t)
    assert float(before.min()) > 0.0014 and float(after.max()) < 0.0001


def test_bars_come_back_though_one_lies_the_other_way_round_and_one_on_its_side(tn42):
    size = torch.tensor([0.042, 0.019, 0.011], dtype=torch.float64)
    R, t = where(4, 0)
    sizes = size.expand(4, -1)
    cloud, given = one_scene(tn42, size, 4, off=0.002)
    turned = given.R.clone()
    turned[1] = turned[1] @ about("z", 2)
    turned[2] = turned[2] @ about("x", 1)
    scene = cloud, replace(given, R=turned)
    before = errors(tn42, sizes, R, t, turned, given.t)
    assert float(before[1:3].min()) > 0.005
    found = fitted(EXACT, tn42, scene)
    assert float((found.parameters - size).abs().max()) < 0.0004  # 2 mm before; two slacks, an end each
    assert float(errors(tn42, sizes, R, t, found.R, found.t).max()) < 0.0003
    kept = fitted(replace(EXACT, alike=0.0, sizes=[]), tn42, scene)
    assert float(errors(tn42, sizes, R, t, kept.R, kept.t)[1:3].min()) > 0.005


def test_a_known_size_stays_and_the_poses_are_better(flange):
    part, size, (cloud, given) = flange
    R, t = where(3, 0)
    exact = replace(given, parameters=size.expand(3, -1).clone())
    found = fitted(replace(EXACT, sizes=[]), part, (cloud, exact))
    assert torch.equal(found.parameters, exact.parameters)
    before, after = (errors(part, exact.parameters, R, t, x.R, x.t) for x in (given, found))
    assert float(before.min()) > 0.0014 and float(after.max()) < 0.00002
    wrong = fitted(replace(EXACT, sizes=[]), part, (cloud, given))
    assert torch.equal(wrong.parameters, given.parameters)


@pytest.fixture(scope="module")
def bars_from_their_side(tn42) -> tuple[torch.Tensor, Seen]:
    """Three bars whose width lies along the ray to them, so that nobody sees it; said are 2 mm too much of
    their length and large end and 3 mm of their width."""
    size = torch.tensor([0.042, 0.019, 0.011], dtype=torch.float64)
    _, t = where(3, 0)
    away = t / torch.linalg.vector_norm(t, dim=1, keepdim=True)
    along = np.cross(away, np.random.default_rng(0).normal(size=(3, 3)))
    along = torch.from_numpy(along / np.linalg.norm(along, axis=1, keepdims=True))
    R = torch.stack([along, away, torch.linalg.cross(along, away)], -1)
    sizes = size.expand(3, -1)
    cloud, owner = view(tn42, sizes, R, t)
    said = sizes + torch.tensor([0.002, 0.002, 0.003])
    return size, (cloud, detections(tn42, said, *displaced(R, t, 0.0005, 1), owner))


def test_no_size_grows_beyond_what_is_seen(tn42, bars_from_their_side):
    """The floor beside the bars says where their outlines end; of the width it is cheaper to be less."""
    size, (cloud, given) = bars_from_their_side
    found = fitted(EXACT, tn42, (cloud, given)).parameters[0]
    assert (
        float((found - size)[:2].max()) < 0.0001 and float(found[2]) < float(given.parameters[0, 2]) - 0.001
    )
    blind = fitted(replace(EXACT, free=0.0, larger=0.0), tn42, (cloud, given)).parameters[0]
    assert float((blind - size)[:2].min()) > 0.001  # nothing but rays tells
    narrow = given.parameters - torch.tensor([0.0, 0.0, 0.006])
    again = fitted(EXACT, tn42, (cloud, replace(given, parameters=narrow))).parameters[0]
    assert float(again[2] - narrow[0, 2]) <= 0.0003  # the lattice's half step and the parabola's
    smallest = min(grid[:, 2].min() for grid in tn42.grids.values())
    least = min(smallest, float(narrow[0, 2])) - 0.0006
    assert float(again[2]) > least and float(found[2]) > least  # nor does it vanish


def test_bodies_of_two_sizes_find_each_its_own(tn34):
    """Their radii: a height may be hidden, as a body seen from above has its base behind it."""
    true = torch.tensor([[0.018, 0.013], [0.013, 0.018]], dtype=torch.float64)
    R, t = where(2, 3)
    cloud, owner = view(tn34, true, R, t)
    middle = true.mean(0).expand(2, -1)
    scene = cloud, detections(tn34, middle, *displaced(R, t, 0.001, 3), owner)
    each = fitted(replace(EXACT, shared=False), tn34, scene)
    assert float((each.parameters - true)[:, 0].abs().max()) < 0.00015  # 2.5 mm before
    shared = fitted(EXACT, tn34, scene)
    assert torch.equal(shared.parameters[0], shared.parameters[1])
    assert float((shared.parameters - true)[:, 0].abs().max()) > 0.002
    assert float(each.score.min()) > float(shared.score.min())


def test_a_part_with_one_size_only_keeps_it(flange, monkeypatch):
    part, _, scene = flange
    assert not torch.equal(fitted(QUICK, part, scene).parameters, scene[1].parameters)
    monkeypatch.setattr(type(part), "is_fixed", True)
    found = fitted(QUICK, part, scene)
    assert torch.equal(found.parameters, scene[1].parameters)
    assert bool((found.t != scene[1].t).all())


def test_an_unknown_size_is_sought_from_the_middle_of_the_grid(flange):
    part, size, (cloud, given) = flange
    unknown = cloud, replace(given, parameters=torch.full_like(given.parameters, math.nan))
    middle = torch.from_numpy(part.grids["L"].mean(0))  # 15 mm and 14.5 mm
    found = fitted(replace(QUICK, sizes=[]), part, unknown)
    said = fitted(replace(QUICK, sizes=[]), part, (cloud, replace(given, parameters=middle.expand(3, -1))))
    assert bool(found.parameters.isnan().all()) and torch.equal(found.R, said.R)  # nobody sought one
    near = fitted(EXACT, part, unknown).parameters
    assert float((near - size).abs().max()) < 0.00015
    told = given.parameters.clone()
    told[:2] = math.nan
    one = fitted(replace(QUICK, sizes=[]), part, (cloud, replace(given, parameters=told)))
    assert torch.equal(one.parameters, told[2].expand(3, -1))


def test_a_size_that_saves_too_little_is_not_taken(flange):
    """With a price of a metre a metre the said size stays, but for half a step."""
    part, _, scene = flange
    found = fitted(replace(QUICK, hold=1.0), part, scene)
    assert float((found.parameters - scene[1].parameters).abs().max()) <= 0.0003 + 0.0003 + 1e-12
    free = fitted(replace(QUICK, hold=0.0), part, scene)
    assert float((free.parameters - scene[1].parameters).abs().max()) > 0.0007


@pytest.fixture
def search(flange) -> _Fit:
    """That of a scene's size, by steps of 0.6 mm at last."""
    part, _, (cloud, given) = flange
    points = cloud[None, :32]
    own = OwnPoints(points, torch.ones(1, 32).double(), points[:, :0], torch.tensor([32.0]).double())
    return _Fit(QUICK, part, own, given.score[:1], lambda radius: points[:, :0])


@pytest.mark.parametrize(
    ("target", "expected"),
    [((0.0161, 0.0158), (0.0161, 0.0158)), ((0.0169, 0.0149), (0.0163, 0.0157)), ((0.016, 0.016),) * 2],
)
def test_between_the_steps_a_parabola_has_its_lowest_point(search, monkeypatch, target, expected):
    """At the target itself, but no farther than half a step from the lattice."""

    def total(size, poses):
        return (size[0] - target[0]) ** 2 + 3 * (size[1] - target[1]) ** 2

    monkeypatch.setattr(search, "_total", total)
    monkeypatch.setattr(search, "_moved", lambda size, poses: poses)
    monkeypatch.setattr(search, "_changed", lambda size, i, by: tuple(np.add(size, by * np.eye(2)[i])))
    assert search._between((0.016, 0.016), "poses") == pytest.approx(expected, abs=1e-12)


def test_a_change_costs_and_a_larger_size_besides(search):
    """Prices of 3 and 5 µm a millimetre of the mean parameter; and a misfit counts up to a limit only."""
    search._said = (0.016, 0.016)
    near, far = (
        _Poses(EYE[None], torch.zeros(1, 3).double(), torch.tensor([x]).double()) for x in (2e-4, 1.0)
    )
    same = search._total((0.016, 0.016), near)
    assert same == pytest.approx(2e-4 + 0.005 * 0.016)
    assert search._total((0.018, 0.016), near) - same == pytest.approx((0.003 + 0.005) * 0.001)
    assert search._total((0.016, 0.014), near) - same == pytest.approx((0.003 - 0.005) * 0.001)
    assert search._total((0.018, 0.014), near) - same == pytest.approx(0.003 * 0.002)
    tiny = search._total((0.0001, 0.0001), near)  # nothing is saved below the grids
    lowest = float(search._smallest.mean())
    assert tiny == pytest.approx(2e-4 + 0.003 * 0.0159 + 0.005 * lowest) and lowest > 0.003
    assert search._total((0.016, 0.016), far) - same == pytest.approx(0.0024 - 2e-4)  # two of the first steps


def test_sizes_are_found_between_the_steps(flange):
    """Not on the lattice of 0.6 mm that was tried."""
    part, _, scene = flange
    steps = fitted(QUICK, part, scene).parameters / 0.0006
    assert float((steps - steps.round()).abs().min()) > 0.01


def test_a_size_beside_one_that_makes_no_part_stays(search, monkeypatch):
    """Of the first parameter nothing larger is possible."""
    monkeypatch.setattr(search, "_total", lambda size, poses: sum((x - 0.0161) ** 2 for x in size))
    monkeypatch.setattr(search, "_moved", lambda size, poses: poses if size[0] < 0.0164 else None)
    monkeypatch.setattr(search, "_changed", lambda size, i, by: tuple(np.add(size, by * np.eye(2)[i])))
    assert search._between((0.016, 0.016), "poses") == pytest.approx((0.016, 0.0161), abs=1e-12)


def test_other_turns_are_tried_again_after_wide_steps(flange, monkeypatch):
    """Once at first, and after steps of 2.4 and 1.2 mm, not after 0.6."""
    part, _, scene = flange
    tried, plain = [], _Fit._best_of

    def noted(self, turns, surface, R, t):
        tried.append(len(turns))
        return plain(self, turns, surface, R, t)

    monkeypatch.setattr(_Fit, "_best_of", noted)
    fitted(replace(QUICK, sizes=[0.0024, 0.0012, 0.0006]), part, scene)
    assert tried == [1, 1, 1]
    fitted(replace(QUICK, sizes=[0.0006]), part, scene)
    assert tried == [1, 1, 1, 1]


def test_instances_that_are_left_out_stay_bit_for_bit(flange):
    part, _, (cloud, given) = flange
    score = given.score.clone()
    score[1] = -1.0
    marked = replace(given, score=score)
    found = fitted(QUICK, part, (cloud, marked))
    for before, after in zip(parts_of(marked), parts_of(found), strict=True):
        assert torch.equal(before[1], after[1])
        assert bool((before[[0, 2]] != after[[0, 2]]).any())
    # and they have no say in the others' size
    moved = replace(marked, parameters=given.parameters + torch.tensor([[0.0], [0.004], [0.0]]))
    again = fitted(QUICK, part, (cloud, moved))
    assert torch.equal(again.parameters[[0, 2]], found.parameters[[0, 2]])


def test_scenes_without_instances_are_passed_over(flange):
    part, _, (cloud, given) = flange
    nothing = replace(given, **{f.name: getattr(given, f.name)[:0] for f in fields(given)})
    empty = torch.zeros_like(cloud), replace(nothing, instance=torch.full_like(given.instance, -1))
    alone = fitted(QUICK, part, (cloud, given))
    for scenes in ([empty, (cloud, given)], [(cloud, given), empty], [empty, (cloud, given), empty]):
        for a, b in zip(parts_of(fitted(QUICK, part, *scenes)), parts_of(alone), strict=True):
            assert torch.equal(a, b)
    none = fitted(QUICK, part, empty)
    assert none.R.shape == (0, 3, 3) and none.parameters.shape == (0, 2)
    left_out = replace(given, score=torch.full_like(given.score, -1))
    for a, b in zip(parts_of(fitted(QUICK, part, (cloud, left_out))), parts_of(left_out), strict=True):
        assert torch.equal(a, b)


def test_scenes_of_a_batch_do_not_influence_each_other(flange):
    part, size, first = flange
    second = one_scene(part, size - 0.002, 2, seed=3, off=0.001)
    both = fitted(QUICK, part, first, second)
    alone = [fitted(QUICK, part, scene) for scene in (first, second)]
    for a, *b in zip(parts_of(both), *map(parts_of, alone), strict=True):
        torch.testing.assert_close(a, torch.cat(b), rtol=0, atol=1e-9)


def test_instances_of_fewer_points_than_count_are_fitted_too(flange):
    part, _, (cloud, given) = flange
    few = given.instance.clone()
    few[torch.nonzero(few == 1)[12:, 0]] = -1
    found = fitted(QUICK, part, (cloud, replace(given, instance=few)))
    assert all(bool(x.isfinite().all()) for x in parts_of(found))
    assert bool((found.t != given.t).all())


def test_where_sizes_make_no_part_the_search_starts_in_the_middle_of_the_grid(tn06):
    """A nut with a hole wider than itself between two good ones."""
    size = torch.from_numpy(tn06.part_object("L", 5))
    cloud, given = one_scene(tn06, size, 3)
    bad = given.parameters.clone()
    bad[1] = torch.tensor([0.02, 0.01, 0.012])
    marked = replace(given, parameters=bad)
    found = fitted(replace(QUICK, shared=False), tn06, (cloud, marked))
    middle = replace(given, parameters=torch.full_like(bad, math.nan))
    same = fitted(replace(QUICK, shared=False), tn06, (cloud, middle))
    for one, other in zip(parts_of(found), parts_of(same), strict=True):
        assert torch.equal(one[1], other[1])
    assert not torch.equal(found.parameters[1], bad[1]) and bool((found.t != given.t).all())
    outvoted = fitted(QUICK, tn06, (cloud, marked))  # of one part object the others know the size
    assert float((outvoted.parameters - size).abs().max()) < 0.0005


@pytest.mark.parametrize("wrong", [False, True])
def test_the_score_falls_by_the_misfit(flange, wrong):
    """Of the right size there is hardly any."""
    part, size, (cloud, given) = flange
    said = size + 0.001 * torch.tensor([1.0, -1.0]) if wrong else size
    told = cloud, replace(given, parameters=said.expand(3, -1))
    kept = fitted(replace(QUICK, sizes=[], doubtful=None), part, told)
    assert torch.equal(kept.score, given.score)
    found = fitted(replace(QUICK, sizes=[], doubtful=0.002), part, told)
    assert torch.equal(found.R, kept.R) and torch.equal(found.t, kept.t)
    points = torch.stack([cloud[given.instance == i][: QUICK.points] for i in range(3)])
    surface = sample_surface(part, tuple(said.tolist()), QUICK.samples)
    mine = given.instance == torch.arange(3)[:, None]
    radius = WIDER * np.linalg.norm(surface.points, axis=1).max()
    rays = Sight(cloud).around(given.t, mine, radius)
    own = OwnPoints(points, torch.ones(points.shape[:2]).double(), rays, mine.sum(1).double())
    off = misfit(surface, own, found.R, found.t, QUICK.slack, QUICK.free, QUICK.reach)
    torch.testing.assert_close(found.score, given.score * torch.exp(-off / 0.002), rtol=1e-9, atol=0)
    assert float(off.max()) < QUICK.reach if wrong else float(off.max()) < 0.00001
    assert float(off.min()) > (0.0001 if wrong else 0)


def test_a_pose_shares_its_score_with_those_that_explain_the_points_as_well(search):
    """The best pose, one turned about the flange's axis, which is the same, one that is 20° off and one end
    for end, 0.1 and 0.2 mm worse; the best pose again counts for nothing."""
    turns = [EYE, about("z", 1), Rotation.from_euler("x", 25, degrees=True).as_matrix(), about("x", 2)]
    R = torch.stack([torch.as_tensor(turn) for turn in turns])
    every = _Poses(R, torch.zeros(4, 3).double(), 0.001 * torch.tensor([1.0, 1.0, 1.1, 1.2]).double())
    best = search._least(every)
    assert torch.equal(best.R, EYE[None]) and best.off.tolist() == [0.001]
    share = float(search._share(every, best, 0.0001))
    assert share == pytest.approx(1 / (1 + math.exp(-1) + math.exp(-2)), rel=1e-4)
    assert float(search._share(every, best, 1e-6)) == pytest.approx(1)


def test_bars_that_may_lie_either_way_are_less_sure(tn42):
    """A bar without much taper, and one with: the first's ends look nearly the same."""
    lost = []
    for size in ([0.036, 0.007, 0.012], [0.036, 0.019, 0.008]):
        scene = one_scene(tn42, torch.tensor(size, dtype=torch.float64), 3)
        fit = replace(EXACT, sizes=[])
        plain, shared = (fitted(replace(fit, ambiguous=x), tn42, scene) for x in (None, 0.00002))
        assert torch.equal(plain.R, shared.R)
        lost.append(shared.score / plain.score)
    assert float(lost[0].max()) < 0.6
    assert float(lost[1].min()) > 0.99 and float(torch.cat(lost).max()) <= 1


def test_without_other_turns_no_pose_is_ambiguous(flange):
    part, _, scene = flange
    shared = fitted(replace(QUICK, ambiguous=0.0001), part, scene)
    assert torch.equal(shared.score, fitted(QUICK, part, scene).score)


def test_what_is_given_stays_and_the_rest_is_passed_on(flange):
    part, _, (cloud, alone) = flange
    given = replace(alone, instance=alone.instance[None])
    kept = [x.clone() for x in (cloud, *parts_of(given), given.keypoints, given.instance)]
    found = QUICK.refined(part, given, cloud[None], [3])
    now = (cloud, *parts_of(given), given.keypoints, given.instance)
    assert all(torch.equal(a, b) for a, b in zip(kept, now, strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(parts_of(found), parts_of(given), strict=True))
    assert torch.equal(found.keypoints, given.keypoints) and torch.equal(found.instance, given.instance)
    assert {x.dtype for x in parts_of(found)} == {torch.float64}


def test_every_run_gives_the_same(tn42):
    scene = one_scene(tn42, tn42.part_object("L", 5), 2, off=0.001)
    fit = replace(QUICK, alike=0.15)
    first = fitted(fit, tn42, scene)
    sample_surface.cache_clear()
    similar_turns.cache_clear()
    for a, b in zip(parts_of(first), parts_of(fitted(fit, tn42, scene)), strict=True):
        assert torch.equal(a, b)


def test_single_precision_clouds_are_taken(flange):
    part, _, (cloud, given) = flange
    found = fitted(QUICK, part, (cloud.float(), given))
    assert found.t.dtype == torch.float64
    torch.testing.assert_close(
        found.t, fitted(QUICK, part, (cloud.float().double(), given)).t, rtol=0, atol=0
    )


@pytest.mark.parametrize("name", ["samples", "points", "steps", "reach", "slack", "doubtful", "ambiguous"])
def test_settings_of_nothing_are_refused(name):
    with pytest.raises(ValueError, match=rf"postprocess\.refine\.{name} is 0, expected a positive number"):
        replace(QUICK, **{name: 0})


@pytest.mark.parametrize("name", ["free", "alike", "hold", "larger"])
def test_negative_weights_are_refused(name):
    with pytest.raises(ValueError, match=rf"postprocess\.refine\.{name} is -0.1, expected 0 or more"):
        replace(QUICK, **{name: -0.1})
    assert getattr(replace(QUICK, **{name: 0.0}), name) == 0


@pytest.mark.parametrize("sizes", [[-1], [0.001, 0.0]])
def test_steps_that_go_nowhere_are_refused(sizes):
    with pytest.raises(ValueError, match=r"postprocess\.refine\.sizes is \[.*\], expected positive steps"):
        replace(QUICK, sizes=sizes)


def config_fit() -> SurfaceFit:
    settings = OmegaConf.load(CONF / "postprocess" / "pprnet.yaml")
    cluster = OmegaConf.load(CONF / "cluster" / "paper.yaml")
    made = instantiate(OmegaConf.merge(settings, cluster, OmegaConf.load(CONF / "refine" / "surface.yaml")))
    assert isinstance(made, PoseAveraging) and isinstance(made.refine, SurfaceFit)
    return made.refine


def test_the_config_makes_it():
    expected = SurfaceFit(
        samples=1000,
        points=96,
        steps=16,
        reach=0.001,
        slack=0.0002,
        free=1.0,
        alike=0.15,
        sizes=STEPS,
        shared=True,
        hold=0.003,
        larger=0.005,
        doubtful=0.001,
        ambiguous=0.00002,
    )
    assert config_fit() == expected


@pytest.fixture(scope="module")
def rendered(flange) -> Scene:
    """The flanges' scene without its floor."""
    part, size, (cloud, given) = flange
    R, t = where(3, 0)
    on = given.instance >= 0
    return Scene(
        points=cloud[on].numpy().astype(np.float32),
        instance=given.instance[on].numpy(),
        R=R.numpy(),
        t=t.numpy(),
        parameters=np.tile(size.numpy(), (3, 1)),
        visibility=np.array([0.9, 0.8, 0.7]),
        occlusion=np.zeros(3),
        camera=CAMERA,
        part=part.name,
        id=SceneId("train", "pile", 0, 0, 3),
    )


def batch_of(scene: Scene) -> torch.Tensor:
    """As the predictions of these tests are: scene 1 of a batch, of scene 0 nothing is known."""
    points = torch.from_numpy(scene.points)
    return torch.stack([torch.zeros_like(points), points])


def test_a_method_that_says_no_size_gets_one_and_keypoints(flange, rendered):
    part, size, _ = flange
    prediction, points = predict_poses(part, rendered), batch_of(rendered)
    plain = AVERAGING(part, prediction, points)[1]
    assert bool(plain.parameters.isnan().all()) and bool(plain.keypoints.isnan().all())
    found = replace(AVERAGING, refine=config_fit())(part, prediction, points)[1]
    assert found.parameters.shape == (3, 2) and torch.equal(found.parameters[0], found.parameters[2])
    assert float((found.parameters - size).abs().max()) < 0.0001  # 2 mm in the middle of the grid's 15, 14.5
    keypoints = apply_pose(found.R, found.t, part.chain.keypoints_from_parameters(found.parameters))
    torch.testing.assert_close(found.keypoints, keypoints, rtol=0, atol=1e-12)
    t = found.t[matched(rendered, found)]
    assert float((t - torch.from_numpy(rendered.t)).norm(dim=1).max()) < 0.0001
    score = torch.stack([x.score[matched(rendered, x)] for x in (plain, found)])
    assert bool((score[1] < score[0]).all()) and float(score.min()) > 0


def test_votes_that_are_off_are_mended(flange, rendered):
    """Every vote by the same millimetre."""
    part, size, _ = flange
    exact, points = predict_keypoints(rendered, part), batch_of(rendered)
    shift = 0.001 * torch.ones(3)
    prediction = replace(exact, centroid=exact.centroid + shift, keypoints=exact.keypoints + shift)
    plain = RECOVERY(part, prediction, points)[1]
    found = replace(RECOVERY, refine=replace(EXACT, sizes=[]))(part, prediction, points)[1]
    truth = torch.from_numpy(rendered.t)
    off = [float((x.t[matched(rendered, x)] - truth).norm(dim=1).max()) for x in (plain, found)]
    assert off[0] == pytest.approx(0.001 * math.sqrt(3), rel=0.01)
    assert off[1] < 0.05 * off[0]
    torch.testing.assert_close(found.parameters, size.expand(3, -1), rtol=0, atol=1e-6)
    assert found.score.tolist() == sorted(found.score.tolist(), reverse=True)


def test_a_scene_is_nowhere_refined_without_its_points(flange, rendered):
    prediction = predict_poses(flange[0], rendered)
    with pytest.raises(ValueError, match=r"postprocess\.refine needs the scenes' points"):
        replace(AVERAGING, refine=QUICK)(flange[0], prediction, None)
