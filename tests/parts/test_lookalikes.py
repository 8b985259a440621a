"""Keypoints that change places: which exchange a point is taught, and that it can be undone."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.geometry.symmetry import RevolutionSymmetry, cyclic, dihedral, reflection
from pnet.parts.choice import NearestToPoint
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Circle, Plane
from pnet.parts.selection import Keypoint
from pnet.parts.tn42 import TN42

ENDS = [  # a bar of two ends of nearly the same height, a foot and a shoulder on each; a half turn about z
    Keypoint("near", "centroid", Plane("z"), "a"),
    Keypoint("far", "centroid", Plane("-z"), "b"),
    Keypoint("arm", "near", Plane("x"), "c"),
    Keypoint("leg", "far", Plane("x"), "d"),
]
TURNED = ((("near", "far"), ("arm", "leg")),)


@pytest.fixture(scope="module")
def bar() -> KeypointChain:
    return TN42({"l": [30, 48], "a": [10, 19], "w": [8, 17]}).chain


@pytest.fixture(scope="module")
def turned() -> KeypointChain:
    return KeypointChain(ENDS, "abcd", cyclic(2), reflection((0, 1, 0)), lookalikes=TURNED)


def random_case(chain: KeypointChain, n: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points about n templates of as many sizes."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(n, len(chain.parameters), generator=generator).double()
    template = chain.keypoints_from_parameters(0.010 + 0.015 * share)
    return 0.02 * torch.randn(n, 3, generator=generator).double(), template


@pytest.mark.parametrize("name", ["bar", "turned"])
def test_exchanged_twice_is_as_before(request, name):
    chain = request.getfixturevalue(name)
    q, m = chain.lookalikes.shape
    values = torch.randn(50, m, 2, generator=torch.Generator().manual_seed(0))
    which = torch.arange(50) % q
    once = chain.exchanged(values, which)
    assert torch.equal(chain.exchanged(once, which), values)
    assert torch.equal(once[which == 0], values[which == 0])
    assert not any(torch.equal(a, b) for a, b in zip(once[which > 0], values[which > 0], strict=True))


def test_an_exchange_moves_each_to_its_partners_place(bar):
    """foot, side, toe, head, tip; then toe, side, foot, tip, head; with further dimensions in front."""
    values = torch.arange(5.0).view(1, 1, 5, 1).expand(2, 4, 5, 1)
    found = bar.exchanged(values, torch.arange(4).expand(2, 4))
    assert found[0, :, :, 0].tolist() == [[0, 1, 2, 3, 4], [2, 1, 0, 4, 3], [3, 1, 4, 0, 2], [4, 1, 3, 2, 0]]
    assert torch.equal(found[0], found[1])


@pytest.mark.parametrize("name", ["bar", "turned"])
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_first_keypoint_is_the_nearest_of_all_that_could_stand_there(bar, turned, name, seed):
    """Tried exchange by exchange; its lead is the margin of what an exchange moves, unless less is known."""
    chain = {"bar": bar, "turned": turned}[name]
    points, template = random_case(chain, 60, seed)
    labels, margin, which = chain.nearest(points, template)
    chosen, own = chain.choose(NearestToPoint(points), template)
    orders = chain.lookalikes.tolist()
    moved = [len({order[i] for order in orders}) > 1 for i in range(len(chain))]
    for n in range(60):
        far = [float((chosen[n, order[0]] - points[n]).norm()) for order in orders]
        best = int(np.argmin(far))
        assert int(which[n]) == best
        lead = min(abs(a - far[best]) for i, a in enumerate(far) if i != best)
        assert float((labels[n, 0] - points[n]).norm()) == pytest.approx(min(far), abs=1e-15)
        for place, source in enumerate(orders[best]):
            assert torch.equal(labels[n, place], chosen[n, source])
            expected = float(own[n, source])
            expected = min(expected, lead) if moved[place] else expected
            assert float(margin[n, place]) == pytest.approx(expected, abs=1e-12)
    assert len(set(which.tolist())) == len(orders)


def test_where_two_exchanges_are_as_near_the_earlier_is_taught_with_no_margin(bar):
    template = bar.keypoints_from_parameters(torch.tensor([0.036, 0.013, 0.011]).double())[None]
    foot, toe = template[:, 0], template[:, 2]
    labels, margin, which = bar.nearest((foot + toe) / 2, template)
    assert which.tolist() == [0] and torch.equal(labels, template)
    assert margin[0, [0, 2, 3, 4]].tolist() == pytest.approx([0] * 4, abs=1e-9)


def test_without_lookalikes_the_nearest_are_the_chosen(chain, sizes):
    """Bit for bit, for every declaration."""
    parameters = sizes(chain, 40)
    points = 0.02 * torch.randn(40, 3, generator=torch.Generator().manual_seed(3)).double()
    template = chain.keypoints_from_parameters(parameters)
    chosen, own = chain.choose(NearestToPoint(points), template)
    labels, margin, which = chain.nearest(points, template)
    assert torch.equal(labels, chosen) and torch.equal(margin, own)
    assert which.tolist() == [0] * 40 and chain.lookalikes.tolist() == [list(range(len(chain)))]


def test_labels_carried_back_measure_the_part(bar):
    points, template = random_case(bar, 200, 7)
    labels, _, which = bar.nearest(points, template)
    zero = torch.zeros(200, 3).double()
    found = bar.parameters_from_keypoints(zero, bar.exchanged(labels, which))
    torch.testing.assert_close(found, bar.parameters_from_keypoints(zero, template), rtol=0, atol=1e-12)


def test_every_point_of_the_surface_is_taught_an_end_that_it_lies_at(bar):
    """The eighths of a bar about its corners belong to them."""
    part = TN42({"l": [40], "a": [12], "w": [10]})
    size = part.part_object("L", 0)
    points = torch.from_numpy(part.mesh(size).sample(400, seed=0)).double()
    template = part.chain.keypoints_from_parameters(torch.from_numpy(size)).expand(400, -1, -1)
    labels, _, which = part.chain.nearest(points, template)
    assert torch.equal(labels[:, 0], template[:, 0].where((which == 0)[:, None], labels[:, 0]))
    middle = float(template[0, [0, 2], 0].mean())  # the toe's half, of either height
    beyond = points[:, 0] > middle + 0.003
    short = points[:, 0] < middle - 0.003
    assert set(which[beyond].tolist()) == {1, 3} and set(which[short].tolist()) == {0, 2}


EXCHANGES = [
    ([(("near", "knee"),)], "lookalikes exchange 'knee', which is none of .*: near, far, arm, leg"),
    ([(("knee", "near"),)], "lookalikes exchange 'knee'"),
    ([(("near", "far"), ("far", "leg"))], r"\('far', 'leg'\)\) exchanges a keypoint twice; name it in one"),
    ([(("near", "far"), ("arm", "leg"), ("arm", "near"))], "exchanges a keypoint twice"),
    ([(("arm", "leg"),)], "every exchange must bring another keypoint to the place of 'near'"),
    ([*TURNED, (("near", "far"),)], "every exchange must bring another keypoint to the place of 'near'"),
    ([()], "leave out what does not, or declare another keypoint first"),
]


@pytest.mark.parametrize(("exchanges", "message"), EXCHANGES)
def test_exchanges_that_cannot_be_are_refused(exchanges, message):
    with pytest.raises(ValueError, match=message):
        KeypointChain(ENDS, "abcd", cyclic(2), lookalikes=exchanges)


def test_keypoints_free_on_a_circle_cannot_be_exchanged():
    keypoints = [
        Keypoint("end", "centroid", Plane("-z"), "h"),
        Keypoint("top", "centroid", Plane("z"), "g"),
        Keypoint("rim", "end", Circle("z"), "r"),
    ]
    text = "lookalikes exchange 'rim', which is none of the keypoints that have finitely many .*: end, top$"
    with pytest.raises(ValueError, match=text):
        KeypointChain(keypoints, "hgr", RevolutionSymmetry(), lookalikes=[(("end", "rim"),)])
    chain = KeypointChain(keypoints, "hgr", RevolutionSymmetry(), lookalikes=[(("end", "top"),)])
    assert chain.lookalikes.tolist() == [[0, 1, 2], [1, 0, 2]]


def test_a_pair_may_be_named_either_way_round_and_in_any_order():
    pairs = [("near", "far"), ("arm", "leg")]
    found = [
        KeypointChain(ENDS, "abcd", dihedral(1), lookalikes=[tuple(order)]).lookalikes.tolist()
        for order in itertools.permutations([*pairs, ("far", "near")], 3)
    ]
    assert all(one == [[0, 1, 2, 3], [1, 0, 3, 2]] for one in found)


def test_exchanges_that_make_another_one_need_it_in_the_list():
    class Bar(TN42):
        lookalikes = TN42.lookalikes[:2]

    match = r"lookalikes: two exchanges after one another bring \(tip, .*add it"
    with pytest.raises(ValueError, match=match):
        Bar(learning={"l": [40], "a": [12], "w": [10]})
