"""The tutorial's files are what a reader would type: they must work."""

import re
import runpy
from pathlib import Path

import pytest
import torch
import trimesh
from omegaconf import OmegaConf

from pnet.cli.instantiate import TRUSTED, instantiate
from pnet.cli.part import part_checks

ROOT = Path(__file__).parents[1]


def blocks(page: str) -> dict[str, str]:
    """File name → content of the code blocks whose first line names a file."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return dict(re.findall(r"```\w+\n# (\S+)\n(.*?)```", text, re.DOTALL))


@pytest.fixture
def tutorial(tmp_path, monkeypatch) -> Path:
    for name, content in blocks("parts.md").items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
    plate = trimesh.creation.box(bounds=[[0, -15, 0], [40, 15, 4]])
    wall = trimesh.creation.box(bounds=[[0, -15, 0], [4, 15, 25]])
    trimesh.boolean.union([plate, wall], engine="manifold").export(tmp_path / "bracket.stl")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(TRUSTED, "my_parts")
    return tmp_path


@pytest.fixture
def backbones(tmp_path, monkeypatch) -> Path:
    for name, content in blocks("backbones.md").items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(TRUSTED, "my_backbones")
    return tmp_path


def test_the_page_on_backbones_holds_what_it_says(backbones):
    runpy.run_path(str(backbones / "compare.py"))
    net = instantiate(OmegaConf.load(backbones / "my_conf" / "backbone" / "patches.yaml"))
    points = 0.1 * torch.rand(2, 50, 3)
    assert net(points, net.tables(points)).shape == (2, 50, net.features)
    assert net.tables(points)["ball_1_0"].shape == (2, 50, 16)


def test_the_page_on_backbones_names_every_config():
    text = (ROOT / "docs" / "backbones.md").read_text(encoding="utf-8")
    configs = {path.stem for path in (ROOT / "conf" / "backbone").glob("*.yaml")}
    assert {name for name in re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)} >= configs


@pytest.mark.parametrize("name", ["bolt", "pin", "bracket"])
def test_the_tutorials_parts_pass_their_checks(tutorial, name):
    part = instantiate(OmegaConf.load(tutorial / "my_conf" / "part" / f"{name}.yaml"))
    checks = list(part_checks(part, samples=50))
    assert len(checks) == 9 and [check for check in checks if not check.passed] == []


def test_the_tutorials_class_is_as_short_as_it_says(tutorial):
    lines = [line for line in (tutorial / "my_parts.py").read_text().splitlines() if line.strip()]
    assert len(lines) < 40
