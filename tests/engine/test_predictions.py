"""The prediction file: exact, and never read wrongly."""

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save

from pnet.engine.predictions import PredictionHeader, read_predictions, write_predictions
from pnet.records import Detections

HEADER = PredictionHeader("tn34", "val", "0123", "4567", "89ab", ["a", "b", "c"], {"network": 0.25})


def detections(d: int, points: int) -> Detections:
    generator = torch.Generator().manual_seed(d)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    instance = torch.randint(-1, max(d, 1), (points,), generator=generator)
    return Detections(random(d, 3, 3), random(d, 3), random(d, 2), random(d), random(d, 3, 3), instance)


FOUND = [detections(4, 50), detections(0, 20), detections(2, 0)]


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "evaluation" / "val" / "predictions.safetensors"
    write_predictions(path, HEADER, FOUND)
    return path


def test_they_come_back_exactly(path):
    header, found = read_predictions(path)
    assert header == HEADER and len(found) == 3
    for one, other in zip(found, FOUND, strict=True):
        for name, value in vars(other).items():
            assert torch.equal(getattr(one, name), value) and getattr(one, name).dtype == value.dtype, name


def test_equal_predictions_give_equal_bytes(path):
    first = path.read_bytes()
    write_predictions(path, HEADER, FOUND)
    assert path.read_bytes() == first
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.9999])
def test_a_truncated_file_is_refused(path, share):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(
        ValueError, match=r"predictions\.safetensors: not a whole prediction file .*predict again"
    ):
        read_predictions(path)


def test_garble_is_refused(path):
    path.write_bytes(b"\xff" * 1000)
    with pytest.raises(ValueError, match=r"predictions\.safetensors: not a whole prediction file"):
        read_predictions(path)


def test_another_safetensors_file_is_refused(path):
    path.write_bytes(save({"x": torch.zeros(3)}))
    with pytest.raises(ValueError, match="not a whole prediction file"):
        read_predictions(path)


def with_header(path, **changes):
    whole = path.read_bytes()
    length = int.from_bytes(whole[:8], "little")
    top = json.loads(whole[8 : 8 + length])
    content = {**json.loads(top["__metadata__"]["pnet-predictions"]), **changes}
    top["__metadata__"]["pnet-predictions"] = json.dumps({k: v for k, v in content.items() if v is not None})
    header = json.dumps(top).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + whole[8 + length :])


@pytest.mark.parametrize("changes", [{}, {"recovery": None}])
def test_a_newer_file_says_so_whatever_it_holds(path, changes):
    with_header(path, version=2, **changes)
    with pytest.raises(ValueError, match=r"predictions\.safetensors: written by a newer pnet"):
        read_predictions(path)


@pytest.mark.parametrize("missing", ["part", "scenes", "version"])
def test_a_header_with_a_gap_is_refused(path, missing):
    with_header(path, **{missing: None})
    with pytest.raises(ValueError, match="not a whole prediction file"):
        read_predictions(path)


def test_a_missing_file_says_what_to_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="no predictions there; run pnet-evaluate first"):
        read_predictions(tmp_path / "predictions.safetensors")


def test_no_scene_found_anything(tmp_path):
    write_predictions(tmp_path / "p", replace(HEADER, scenes=["a"]), [detections(0, 5)])
    assert len(read_predictions(tmp_path / "p")[1][0].score) == 0
