"""Instances of a batch to the detections of its scenes."""

import torch

from pnet.postprocess.detections import best_first, by_scene, no_detections, on_cpu
from pnet.records import Detections


def numbered(score: torch.Tensor, instance: torch.Tensor) -> Detections:
    """Instances of which every field says the number."""
    d, number = len(score), torch.arange(len(score)).double()
    return Detections(
        number[:, None, None].expand(d, 3, 3),
        number[:, None].expand(d, 3),
        number[:, None],
        score,
        number[:, None, None].expand(d, 3, 3),
        instance,
    )


def test_best_first_keeps_rows_and_labels_together():
    d, n = 5, 40
    generator = torch.Generator().manual_seed(0)
    score = torch.tensor([0.3, 0.9, 0.1, 0.9, 0.5], dtype=torch.float64)
    labels = torch.randint(-1, d, (n,), generator=generator)
    sorted_ = best_first(numbered(score, labels), torch.tensor([True, True, False, True, True]))
    assert sorted_.score.tolist() == [0.9, 0.9, 0.5, 0.3]
    assert sorted_.t[:, 0].tolist() == [1, 3, 4, 0]
    assert sorted_.R[:, 0, 0].tolist() == sorted_.keypoints[:, 0, 0].tolist() == [1, 3, 4, 0]
    for old, new in zip(labels.tolist(), sorted_.instance.tolist(), strict=True):
        assert new == {-1: -1, 1: 0, 3: 1, 4: 2, 0: 3, 2: -1}[old]


def test_no_detections_has_the_parts_shapes(part):
    found = no_detections(part, 5)
    assert found.parameters.shape == (0, part.k) and found.instance.tolist() == [-1] * 5


def test_every_scene_has_its_own_instances_by_its_own_numbers():
    score = torch.tensor([0.1, 0.7, 0.9, 0.2, 0.4], dtype=torch.float64)
    instance = torch.tensor([[0, 1, -1], [-1, -1, -1], [4, 3, 2]])
    keep = torch.tensor([True, True, True, False, True])
    first, second, third = by_scene(numbered(score, instance), keep, [2, 0, 3])
    assert first.t[:, 0].tolist() == [1, 0] and first.instance.tolist() == [1, 0, -1]
    assert second.R.shape == (0, 3, 3) and second.instance.tolist() == [-1] * 3
    assert third.t[:, 0].tolist() == [2, 4] and third.instance.tolist() == [1, -1, 0]
    assert third.score.tolist() == [0.9, 0.4] and third.keypoints[:, 0, 0].tolist() == [2, 4]
    assert {found.instance.dtype for found in (first, second, third)} == {torch.int64}
    assert by_scene(numbered(score[:0], instance[:0]), keep[:0], []) == []


def test_what_is_packed_for_the_way_to_the_cpu_is_unpacked_as_it_was():
    g = torch.Generator().manual_seed(0)
    shapes = {"R": (3, 3), "t": (3,), "parameters": (2,), "score": (), "keypoints": (5, 3)}
    for d in (4, 0):
        fields = {name: torch.rand(d, *shape, generator=g).double() for name, shape in shapes.items()}
        found = on_cpu(Detections(**fields, instance=torch.zeros(1, 3).long()))
        assert all(torch.equal(getattr(found, name), value) for name, value in fields.items())
        assert found.instance.tolist() == [[0, 0, 0]]
