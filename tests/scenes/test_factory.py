"""What a cycle's scenes promise to whoever learns from them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pnet.records import Scene
from pnet.scenes.bullet import BulletPhysics
from pnet.scenes.factory import SceneFactory
from pnet.scenes.noise import GaussianNoise, NoNoise, StructuredLightNoise
from pnet.scenes.pile import Bin, Pile
from pnet.scenes.pile_store import PileFile, write_piles
from pnet.scenes.protocol import SPLITS, CycleTask, Protocol, SplitPlan
from pnet.scenes.rendering import render_view
from pnet.scenes.view_factory import EDGE_SLOPE, ViewFactory
from pnet.scenes.viewpoints import Viewpoints

PILE = CycleTask("train", "pile", "L", 0, 5)
CLUTTER = CycleTask("train", "clutter", "L", 0, 5)
BOTH = pytest.mark.parametrize("task", [PILE, CLUTTER], ids=["pile", "clutter"])
VAL = CycleTask("val", "pile", "L", 0, 5)  # the same piles
LABELS = ("R", "t", "parameters", "visibility", "occlusion")
ARRAYS = ("points", "instance", "incidence", "edge", *LABELS)
AROUND = Viewpoints(distance=(0.6, 0.7), tilt=(5, 20), turn=True)
LIGHT = StructuredLightNoise(baseline=0.1, disparity_sigma=0.1, edge_pixels=2, edge_loss=0.5, dropout=0.01)

pytestmark = pytest.mark.usefixtures("bullet")


def change(factory: SceneFactory, piles: dict = {}, views: dict = {}, **own) -> SceneFactory:  # noqa: B006
    """The same factory with other settings of its stages."""
    return replace(
        factory, piles=replace(factory.piles, **piles), views=replace(factory.views, **views), **own
    )


def assert_same(scenes: list[Scene], others: list[Scene], names: tuple[str, ...] = ARRAYS) -> None:
    """To the bit."""
    assert [scene.id.drop for scene in scenes] == [scene.id.drop for scene in others]
    for a, b in zip(scenes, others, strict=True):
        for name in names:
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def drops_of(limit: int, step: int = 1) -> Protocol:
    return Protocol("tiny", limit, 256, {"train": SplitPlan("L", 1)}, step)


@BOTH
def test_a_scene_is_taken_after_every_drop(factory, task):
    cycle = factory.make_cycle(task)
    assert cycle.header.drops == (1, 2, 3)
    assert [str(scene.id) for scene in cycle.scenes] == [
        f"train/{task.kind}_0000_part_05/00{drop}" for drop in (1, 2, 3)
    ]
    assert [len(scene.R) for scene in cycle.scenes] == [1, 2, 3]
    assert (cycle.header.split, cycle.header.kind, cycle.header.part) == ("train", task.kind, "tn34")


@BOTH
def test_arrays_have_the_shapes_and_types_of_a_scene(factory, task):
    scene = factory.make_cycle(task).scenes[-1]
    assert scene.points.shape == (256, 3) and scene.points.dtype == np.float32
    assert scene.instance.shape == (256,) and scene.instance.dtype == np.int64
    for name in ("incidence", "edge"):
        assert getattr(scene, name).shape == (256,) and getattr(scene, name).dtype == np.uint8
    assert scene.R.shape == (3, 3, 3) and scene.t.shape == (3, 3)
    assert scene.parameters.shape == (3, 2)
    assert scene.visibility.shape == scene.occlusion.shape == (3,)


@BOTH
def test_every_point_lies_on_the_surface_of_its_instance(factory, task):
    mesh = factory.piles.part.mesh(factory.piles.part.part_object("L", 5))
    for scene in factory.make_cycle(task).scenes:
        assert scene.instance.min() >= 0 and scene.instance.max() < len(scene.R)
        R, t = scene.R[scene.instance], scene.t[scene.instance]
        local = np.einsum("nji,nj->ni", R, scene.points - t)
        distance = trimesh.proximity.closest_point_naive(mesh, local)[1]
        assert distance.max() < 1e-4


@BOTH
def test_visibility_and_occlusion_are_shares(factory, task):
    for scene in factory.make_cycle(task).scenes:
        for share in (scene.visibility, scene.occlusion):
            assert (share >= 0).all() and (share <= 1).all()
        assert scene.visibility.max() == 1
        assert (scene.occlusion[scene.visibility == 0] == 1).all()


def test_labels_are_the_part_objects_own(factory):
    scene = factory.make_cycle(PILE).scenes[-1]
    np.testing.assert_array_equal(scene.parameters, np.tile(factory.piles.part.part_object("L", 5), (3, 1)))
    np.testing.assert_allclose(scene.R @ scene.R.transpose(0, 2, 1), np.stack([np.eye(3)] * 3), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(scene.R), 1)


def test_the_camera_looks_straight_down_on_the_bin(factory):
    """One flange on its end: the centroid is as far from the camera as it lies above the floor."""
    scene = factory.make_cycle(PILE).scenes[0]
    lowest = (factory.piles.part.mesh(scene.parameters[0]).vertices @ scene.R[0].T + scene.t[0])[:, 2].max()
    assert lowest == pytest.approx(0.65, abs=0.0005)
    assert (np.abs(scene.t[0, :2]) < factory.piles.box.width / 2).all()


def test_points_come_in_farthest_point_order(factory):
    """Progressive: each point is at most as far from those before it as the one before was."""
    points = factory.make_cycle(PILE).scenes[-1].points.astype(float)
    gaps = [np.linalg.norm(points[:i] - points[i], axis=1).min() for i in range(1, len(points))]
    assert (np.diff(gaps) <= 1e-7).all() and gaps[0] > 0.01


def test_few_pixels_are_repeated_to_fill_a_scene(factory):
    many = change(factory, piles={"protocol": drops_of(1)}, views={"points": 4096})
    scene = many.make_cycle(PILE).scenes[0]
    assert scene.points.shape == (4096, 3)
    distinct = len(np.unique(scene.points, axis=0))
    assert distinct < 2048
    np.testing.assert_array_equal(scene.points[:distinct], scene.points[distinct : 2 * distinct])
    np.testing.assert_array_equal(scene.instance[:distinct], scene.instance[distinct : 2 * distinct])


def test_a_step_keeps_the_full_bin_and_changes_no_scene(factory):
    every = change(factory, piles={"protocol": drops_of(5)}).make_cycle(PILE)
    some = change(factory, piles={"protocol": drops_of(5, step=2)}).make_cycle(PILE)
    assert some.header.drops == (1, 3, 5)
    assert_same(some.scenes, every.scenes[::2])


@BOTH
def test_a_cycle_is_a_function_of_settings_and_task(factory, task):
    first, again = factory.make_cycle(task), factory.make_cycle(task)
    assert first.header == again.header
    assert_same(first.scenes, again.scenes)
    other = change(factory, piles={"seed": 1}).make_cycle(task)
    assert np.abs(other.scenes[-1].t - first.scenes[-1].t).max() > 1e-3


def test_bodies_that_left_the_bin_are_counted(factory: SceneFactory):
    low = change(factory, piles={"box": Bin(0.02, 0.02, 0.001), "protocol": drops_of(6)})
    cycle = low.make_cycle(PILE)
    assert cycle.header.escaped > 0
    assert len(cycle.scenes[-1].R) + cycle.header.escaped == cycle.scenes[-1].id.drop


def test_a_scene_without_a_visible_body_is_left_out_and_counted(factory, camera):
    blind = change(factory, views={"camera": replace(camera, near=0.3, far=0.31)})
    cycle = blind.make_cycle(PILE)
    assert cycle.scenes == [] and cycle.header.drops == () and cycle.header.empty == 3


def test_a_scene_not_at_rest_is_counted(factory):
    hasty = change(factory, piles={"physics": BulletPhysics(max_seconds=0.04)})
    assert hasty.make_cycle(PILE).header.unsettled == 3


def test_a_camera_too_near_to_the_bin_is_refused(factory):
    low = change(factory, views={"viewpoints": Viewpoints(distance=(0.31, 0.31))})
    with pytest.raises(ValueError, match="nearer than its near plane"):
        low.make_cycle(PILE)


def test_times_are_kept_by_stage(factory):
    times = factory.make_cycle(PILE).times
    assert min(times.simulate, times.render, times.sample) > 0 and times.write == 0


# two stages


@BOTH
@pytest.mark.parametrize("noise", [NoNoise(), LIGHT], ids=["exact", "noisy"])
def test_two_stages_with_files_between_give_the_bytes_of_one(factory, task, noise, tmp_path):
    around = change(factory, views={"viewpoints": AROUND, "noise": noise})
    write_piles(tmp_path / "piles", *around.piles.make_piles(task))
    file = PileFile(tmp_path / "piles")
    piles = [file.pile(i) for i in range(len(file))]
    cycle, whole = around.render_cycle(task, file.header, piles), around.make_cycle(task)
    assert cycle.header == whole.header
    assert_same(cycle.scenes, whole.scenes)


@BOTH
def test_a_pile_header_says_what_was_piled(factory, task):
    header, piles = change(factory, piles={"fingerprint": "of the piles"}).piles.make_piles(task)
    assert (header.fingerprint, header.part, header.grid) == ("of the piles", "tn34", "L")
    assert (header.split, header.kind, header.cycle, header.part_index) == ("train", task.kind, 0, 5)
    assert header.parameters == tuple(factory.piles.part.part_object("L", 5)) and header.drops == (1, 2, 3)
    assert [len(pile.R) for pile in piles] == [pile.drop for pile in piles] == [1, 2, 3]


def test_chance_of_a_view_depends_on_the_drop_only(factory):
    """Rendering some of the piles, or from another place in the order, gives the same scenes."""
    around = change(factory, views={"viewpoints": AROUND, "noise": LIGHT})
    header, piles = around.piles.make_piles(PILE)
    every = around.render_cycle(PILE, header, piles).scenes
    for chosen in ([1], [2, 0], [0, 2]):
        some = around.render_cycle(PILE, header, [piles[i] for i in chosen]).scenes
        assert_same(some, [every[i] for i in chosen])
    distances = [np.linalg.norm(scene.t[0] - every[0].t[0]) for scene in every[1:]]
    assert min(distances) > 0.005  # every scene has a place of its own


def test_another_view_shows_the_same_pile(factory):
    """Distances between bodies and angles between their axes are kept; the world is turned as a whole."""
    above, around = factory.make_cycle(PILE), change(factory, views={"viewpoints": AROUND}).make_cycle(PILE)
    for scene, other in zip(above.scenes, around.scenes, strict=True):
        turn = other.R[0] @ scene.R[0].T
        np.testing.assert_allclose(other.R, turn @ scene.R, atol=1e-12)
        np.testing.assert_allclose(other.t - other.t[0], (scene.t - scene.t[0]) @ turn.T, atol=1e-12)
        tilt = np.degrees(np.arccos(turn[2, 2]))
        assert 5 - 1e-6 < tilt < 20 + 1e-6


def test_piles_poured_anew_have_nothing_in_common(factory):
    plan = Protocol("tiny", 3, 256, {"train": SplitPlan("L", 1)}, dropping="anew")
    _, anew = change(factory, piles={"protocol": plan}).piles.make_piles(PILE)
    _, grown = factory.piles.make_piles(PILE)
    assert [len(pile.R) for pile in anew] == [1, 2, 3]
    assert np.abs(anew[0].t[0] - anew[1].t[0]).max() > 1e-3
    assert np.abs(grown[0].t[0] - grown[1].t[0]).max() < 1e-3


# what a sensor's noise needs, and what it does


def lying_nut(views: ViewFactory, at: tuple[float, float], points: int = 4000) -> Scene:
    """One nut on its end, seen from straight above."""
    parameters = views.part.part_object("L", 0)
    pile = Pile(np.eye(3)[None], np.array([[*at, parameters[1] / 2]]), 1)
    scene = replace(views, points=points).view(pile, parameters, PILE.scene_id(1), np.random.default_rng(0))
    assert scene is not None
    return scene


@pytest.fixture
def nut_views(tn06, camera) -> ViewFactory:
    fine = replace(camera, width=640, height=512, fx=1500.0, fy=1500.0, cx=319.5, cy=255.5)
    return ViewFactory(tn06, fine, Viewpoints(), NoNoise(), 256)


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.05, 0.0), (-0.06, 0.04)])
def test_incidence_on_a_level_face_is_the_cosine_of_the_rays_angle(nut_views, at):
    """The face's normal is the optical axis: the cosine is z / |p|."""
    scene = lying_nut(nut_views, at)
    height = scene.parameters[0, 1]
    face = np.abs(scene.points[:, 2] - (0.65 - height)) < 1e-5
    assert face.sum() > 200
    points = scene.points[face].astype(float)
    expected = 255 * points[:, 2] / np.linalg.norm(points, axis=1)
    assert np.abs(scene.incidence[face] - expected).max() <= 0.501
    if at == (0.0, 0.0):
        assert (scene.incidence[face] == 255).all()
    assert scene.incidence[~face].max(initial=0) < 128  # upright sides, seen at a grazing angle


def test_edges_are_at_silhouettes_and_jumps_of_the_depth(nut_views):
    """A pixel has 0 where one of its four neighbours is background, or nearer or farther by a step."""
    scene = lying_nut(nut_views, (0.03, 0.02))
    mesh = nut_views.part.mesh(scene.parameters[0])
    depth = render_view(nut_views.camera, mesh, scene.R, scene.t).depth
    u, v = np.rint(nut_views.camera.project(scene.points.astype(float))).astype(int).T
    step = EDGE_SLOPE * depth[depth > 0].mean() / nut_views.camera.fx
    jumps = [
        (depth[v + dv, u + du] == 0) | (np.abs(depth[v + dv, u + du] - depth[v, u]) > step)
        for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    np.testing.assert_array_equal(scene.edge == 0, np.any(jumps, axis=0))
    assert 50 < (scene.edge == 0).sum() < len(u) / 2 and (scene.edge > 3).any()


@BOTH
def test_noise_changes_points_and_no_label(factory, task):
    noisy = change(factory, views={"noise": GaussianNoise(0.0005)}).make_cycle(task)
    exact = factory.make_cycle(task)
    assert_same(noisy.scenes, exact.scenes, LABELS)
    mesh = factory.piles.part.mesh(factory.piles.part.part_object("L", 5))
    for scene in noisy.scenes:
        R, t = scene.R[scene.instance], scene.t[scene.instance]
        local = np.einsum("nji,nj->ni", R, scene.points - t)
        distance = trimesh.proximity.closest_point_naive(mesh, local)[1]
        assert 0.0001 < distance.mean() < 0.0005 and distance.max() < 5 * 0.0005


def test_noise_comes_in_the_splits_that_are_named(factory):
    light = {"noise": LIGHT}
    exact, noisy = factory, change(factory, views=light)
    assert noisy.noise_in == SPLITS
    some = change(factory, views=light, noise_in=("val", "test_g"))
    assert_same(some.make_cycle(PILE).scenes, exact.make_cycle(PILE).scenes)
    assert_same(some.make_cycle(VAL).scenes, noisy.make_cycle(VAL).scenes)
    first, second = (made.make_cycle(VAL).scenes[-1].points for made in (exact, some))
    assert not np.isin(first[:, 2], second[:, 2]).all()


def test_noise_leaves_the_viewpoint_alone(factory):
    """A noisy scene is taken from where the exact one is."""
    around, noisy = (
        change(factory, views={"viewpoints": AROUND, "noise": noise}) for noise in (NoNoise(), LIGHT)
    )
    assert_same(noisy.make_cycle(PILE).scenes, around.make_cycle(PILE).scenes, LABELS)


def test_a_scene_whose_pixels_are_all_lost_is_left_out_and_counted(factory):
    lost = replace(LIGHT, dropout=1.0)
    cycle = change(factory, views={"noise": lost}).make_cycle(PILE)
    assert cycle.scenes == [] and cycle.header.empty == 3


def test_a_pile_that_left_the_bin_is_an_empty_scene(factory):
    header, piles = factory.piles.make_piles(PILE)
    gone = Pile(np.zeros((0, 3, 3)), np.zeros((0, 3)), 1, escaped=1)
    cycle = factory.render_cycle(PILE, header, [gone, *piles[1:]])
    assert cycle.header.empty == 1 and cycle.header.drops == (2, 3)
