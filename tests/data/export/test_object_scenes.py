"""Dividing a set by part object."""

from dataclasses import replace

import numpy as np
import pytest

from pnet.data.export.object_scenes import object_scenes


def ids_of(groups):
    return [[(one.kind, one.part_index, one.cycle, one.drop) for one in group.ids] for group in groups]


def test_each_part_object_and_kind_has_its_scenes_in_order(flange, make_set, listed):
    piles = make_set(flange, drops=(1, 2), cycles=(4, 3), objects=(1, 0)).scenes
    clutter = make_set(flange, drops=(2,), kind="clutter").scenes
    groups = list(object_scenes(listed(piles[::-1] + clutter), flange))
    drops = [(3, 1), (3, 2), (4, 1), (4, 2)]
    assert ids_of(groups) == [
        [("pile", 0, *drop) for drop in drops],
        [("clutter", 0, 3, 2)],
        [("pile", 1, *drop) for drop in drops],
    ]
    assert [group.parameters.tolist() for group in groups] == [[0.015, 0.012]] * 2 + [[0.02, 0.012]]
    assert groups[2].named_parameters == {"r": 0.02, "h": 0.012}
    assert groups[2].mesh.extents == pytest.approx([0.04, 0.04, 0.012], rel=1e-6)
    for group in groups:
        assert [scene.id for scene in group] == group.ids


def bodiless(scene):
    none = {name: getattr(scene, name)[:0] for name in ("R", "t", "parameters", "visibility", "occlusion")}
    return replace(scene, **none)


def test_a_scene_without_bodies_takes_the_size_of_the_others(flange, make_set, listed):
    first, second = make_set(flange, drops=(1, 2))
    (group,) = object_scenes(listed([bodiless(first), second]), flange)
    assert group.parameters.tolist() == second.parameters[0].tolist() and len(list(group)) == 2


def test_a_part_object_without_any_body_is_refused(flange, make_set, listed):
    first, second = make_set(flange, drops=(1, 2))
    with pytest.raises(ValueError, match=r"pile_0003_part_00/001 and the 1 others .* show no body"):
        list(object_scenes(listed([bodiless(first), bodiless(second)]), flange))


def test_other_sizes_in_a_part_object_are_named(flange, make_set, listed):
    first, second = make_set(flange, drops=(2, 3))
    strange = second.parameters.copy()
    strange[2] = [0.016, 0.012]
    (group,) = object_scenes(listed([first, replace(second, parameters=strange)]), flange)
    with pytest.raises(ValueError, match=r"/003: shows r = 16 mm, h = 12 mm, .* r = 15 mm, h = 12 mm; one"):
        list(group)


def test_another_camera_is_refused(flange, make_set, listed, eye):
    first, second = make_set(flange, drops=(2, 3))
    (group,) = object_scenes(listed([first, replace(second, camera=replace(eye, fx=230.0))]), flange)
    with pytest.raises(ValueError, match=r"/003: seen by Camera\(.*fx=230.0.*one folder has one camera"):
        list(group)


def test_another_template_is_refused(flange, tn06, make_set):
    (group,) = object_scenes(make_set(flange, drops=(2,)), tn06)
    with pytest.raises(ValueError, match="/002: shows tn34, not tn06"):
        list(group)


def test_several_splits_are_refused(flange, make_set, listed):
    both = [*make_set(flange, drops=(2,)), *make_set(flange, drops=(2,), split="train")]
    with pytest.raises(ValueError, match="splits test_l, train; export each split apart"):
        list(object_scenes(listed(both), flange))


def test_no_scene_and_one_scene_twice_are_refused(flange, make_set, listed):
    (scene,) = make_set(flange, drops=(2,))
    with pytest.raises(ValueError, match="no scene to export"):
        list(object_scenes(listed([]), flange))
    with pytest.raises(ValueError, match="two scenes have the same id"):
        list(object_scenes(listed([scene, replace(scene, R=np.zeros((0, 3, 3)))]), flange))
