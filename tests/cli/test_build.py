"""What a config's values mean."""

import pytest
import torch
from omegaconf import OmegaConf

from pnet.cli.app import config_dir
from pnet.cli.build import finds_tables_itself, loader_workers, share
from pnet.cli.instantiate import instantiate
from pnet.ops.operators import KERNELS


def test_loaders_share_the_cores_beside_a_gpu_and_take_none_from_a_cpu(monkeypatch):
    monkeypatch.setattr("pnet.cli.build.cores", lambda: 12)
    assert loader_workers(None, "cpu") == 0 and loader_workers(3, "cpu") == loader_workers(3, "auto") == 3
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert [loader_workers(None, "auto", devices) for devices in (1, 2, 4, 24)] == [8, 6, 3, 1]
    assert loader_workers(None, "cpu") == 0


@pytest.mark.parametrize("backbone, itself", [("pointsift", True), ("range_unet", False)])
def test_a_gpu_with_kernels_finds_neighbour_tables_itself(monkeypatch, backbone, itself):
    """Cells of a range image are the loaders': their number would have to be read back."""
    made = instantiate(OmegaConf.load(config_dir() / "backbone" / f"{backbone}.yaml"))
    assert not finds_tables_itself(made, "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(KERNELS, "cuda", ["octants"])
    assert finds_tables_itself(made, "auto") is itself
    monkeypatch.setitem(KERNELS, "cuda", [])
    assert not finds_tables_itself(made, "auto")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("1/3", 1 / 3),
        ("1/5", 0.2),
        (1, 1.0),
        (0.2, 0.2),
        ("0.2", 0.2),
        (" 2/4 ", 0.5),
        ("1e-1", 0.1),
        (1.5, 1.5),
    ],
)
def test_a_share_may_be_a_fraction(value, expected):
    """Whether it lies in (0, 1] the data module says."""
    assert share("data.learn", value) == expected and isinstance(share("data.learn", value), float)


@pytest.mark.parametrize("value", ["a third", "", "1/0", "1/3/5", None, True, "nan", "inf", [1, 3]])
def test_what_is_no_share_is_refused(value):
    with pytest.raises(ValueError, match=r"data\.learn is .*, expected a share, for instance 1/3"):
        share("data.learn", value)
