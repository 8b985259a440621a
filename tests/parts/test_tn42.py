"""The tapered bar."""

import numpy as np
import pytest
import torch

from pnet.parts.choice import NearestToCamera
from pnet.parts.tn42 import SMALL_END, TN42

SIZE = np.array([0.030, 0.012, 0.008])


@pytest.fixture(scope="module")
def part() -> TN42:
    return TN42({"l": [30, 40], "a": [12], "w": [8, 10]})


def test_the_volume_is_the_trapezoids_times_the_thickness(part):
    mesh = part.mesh(SIZE)
    assert mesh.volume == pytest.approx(0.030 * (0.012 + SMALL_END) / 2 * 0.008, rel=1e-9)
    assert len(mesh.vertices) == 8 and mesh.euler_number == 2
    np.testing.assert_allclose(np.ptp(mesh.bounds, axis=0), [0.030, 0.008, 0.012], atol=1e-12)


def test_the_centroid_is_the_trapezoids(part):
    """x = l/3 (a + 2b)/(a + b), z = (a² + ab + b²) / (3 (a + b)) from the large end's lower edge."""
    l, a, b = SIZE[0], SIZE[1], SMALL_END  # noqa: E741
    expected = [l / 3 * (a + 2 * b) / (a + b), 0, (a * a + a * b + b * b) / (3 * (a + b))]
    np.testing.assert_allclose(part.centroid(SIZE[None])[0], expected, atol=1e-12)
    foot, *_ = part.chain.keypoints_from_parameters(torch.from_numpy(SIZE))
    np.testing.assert_allclose(foot, [-x for x in expected], atol=1e-12)


def test_the_keypoints_measure_length_height_and_thickness(part):
    keypoints = dict(
        zip(part.chain.names, part.chain.keypoints_from_parameters(torch.from_numpy(SIZE)), strict=True)
    )
    assert (keypoints["toe"] - keypoints["foot"]).tolist() == pytest.approx([0.030, 0, 0])
    assert (keypoints["head"] - keypoints["foot"]).tolist() == pytest.approx([0, 0, 0.012])
    assert keypoints["side"].tolist() == pytest.approx([0, 0.004, 0])
    assert (keypoints["tip"] - keypoints["toe"]).tolist() == pytest.approx([0, 0, SMALL_END])


def test_the_side_is_the_one_nearer_to_the_camera_and_nothing_else_is_chosen(part, rotations):
    R = rotations(60)
    template = part.chain.keypoints_from_parameters(torch.from_numpy(SIZE)).expand(60, -1, -1)
    labels, margin = part.chain.choose(NearestToCamera(R), template)
    side = part.chain.names.index("side")
    torch.testing.assert_close(labels[:, side, 1], -0.004 * R[:, 2, 1].sign())
    torch.testing.assert_close(margin[:, side], 0.008 * R[:, 2, 1].abs())
    others = [i for i in range(5) if i != side]
    assert torch.equal(labels[:, others], template[:, others]) and bool(margin[:, others].isinf().all())


def test_its_keypoints_are_the_corners_of_the_mirror_plane(part):
    """Each at a corner of the trapezoid, so that an exchange carries corners to corners."""
    keypoints = part.chain.keypoints_from_parameters(torch.from_numpy(SIZE)).numpy()
    corners = np.unique(part.mesh(SIZE).vertices[:, [0, 2]].round(9), axis=0)
    outline = [i for i, name in enumerate(part.chain.names) if name != "side"]
    found = keypoints[outline][:, [0, 2]].round(9)
    assert len(outline) == 4 and np.abs(keypoints[outline][:, 1]).max() == 0
    np.testing.assert_allclose(found[np.lexsort(found.T[::-1])], corners, atol=1e-9)


def test_its_lookalikes_turn_it_end_for_end_side_for_side_and_both(part):
    names = part.chain.names
    assert names == ["foot", "side", "toe", "head", "tip"]
    exchanged = [[names[i] for i in order] for order in part.chain.lookalikes]
    assert exchanged == [
        ["foot", "side", "toe", "head", "tip"],
        ["toe", "side", "foot", "tip", "head"],
        ["head", "side", "tip", "foot", "toe"],
        ["tip", "side", "head", "toe", "foot"],
    ]


def test_its_labels_have_two_structures_that_are_mirror_images(part):
    one, other = part.chain.chiralities
    assert torch.equal(one, torch.eye(3).double())
    assert torch.equal(other, torch.diag(torch.tensor([1.0, -1, 1]).double()))


@pytest.mark.parametrize("a", [6.0, 5.0])
def test_a_large_end_that_is_no_larger_is_refused(a):
    text = rf"tn42: the large end \(a = {a:g} mm\) must be higher than the small one \(6 mm\)"
    with pytest.raises(ValueError, match=text):
        TN42({"l": [30], "a": [a], "w": [8]})
