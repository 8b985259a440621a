"""pnet-part: what it prints and writes, parts of the user's own, and what it refuses."""

import contextlib
import io
import re
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from pnet.cli.app import config_dir
from pnet.cli.part import main
from pnet.data.poseutils import read_poseutils, write_poseutils
from pnet.reporting import part_picture

CRATE = """
_target_: pnet.parts.declared.DeclaredPart
name: crate
parameters: [l, w, h]
solid: [{add: box, x: [-l / 2, l / 2], y: [-w / 2, w / 2], z: [0, h]}]
symmetry: {cyclic: 2}
mirror: y
keypoints:
  base: {from: centroid, plane: -z, at: 0}
  top: {from: base, plane: z, measures: h}
  end: {from: base, plane: x, measures: l, factor: 0.5}
  side: {from: base, plane: y, measures: w, factor: 0.5}
learning: {l: [30, 40], w: [20, 25], h: [10]}
"""
CAD = "_target_: pnet.parts.cad.CadPart\nname: fitting\nmesh: ???\nbounds: cuboid\nsymmetry: none\n"
OWN = "_target_: my_parts.Bar\nlearning: {l: [30, 40], a: [10, 16], w: [8, 10]}\n"
MODULE = """
import os, subprocess
from pnet.parts.tn42 import TN42

class Bar(TN42):
    name = "bar"

class NoPart:
    pass

def make():
    return 1
"""
FEW = ("samples=5", "formats=[stl]")
MINE = ("--config-dir", "mine")


def no_image(camera, *_):
    return np.zeros((2, 2, 3)), np.zeros((2, 2))


@pytest.fixture
def bare(monkeypatch):
    """No ray casting: pictures are drawn at once, without the bodies."""
    monkeypatch.setattr(part_picture, "render_bodies", no_image)


@pytest.fixture
def folder(tmp_path):
    """A working directory with parts of the user's own."""
    (tmp_path / "mine" / "part").mkdir(parents=True)
    for name, text in {"crate": CRATE, "fitting": CAD, "own": OWN}.items():
        (tmp_path / "mine" / "part" / f"{name}.yaml").write_text(text)
    return tmp_path


@pytest.fixture
def trusted(folder, monkeypatch):
    """The same, with a class of the user's own; imports are forgotten afterwards."""
    (folder / "my_parts.py").write_text(MODULE)
    (folder / "my_parts_too.py").write_text(MODULE)
    monkeypatch.setenv("PNET_TRUSTED", "my_parts")
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield folder
    for name in ("my_parts", "my_parts_too"):
        sys.modules.pop(name, None)


def made(folder, name) -> set[str]:
    """The files of a part."""
    return {path.name for path in (folder / "outputs" / "parts" / name).iterdir()}


def table_cells(text: str) -> list[list[str]]:
    """The rows of the printed tables: an empty text before and after the cells."""
    rows = [[cell.strip() for cell in line.split("│")] for line in text.splitlines()]
    return [row for row in rows if len(row) > 2]


def volume(path) -> float:
    """Of a closed mesh in metres: cubic millimetres."""
    mesh = trimesh.load(path, force="mesh")
    mesh.merge_vertices()
    assert mesh.is_watertight
    return 1e9 * float(mesh.volume)


# a part of pnet's


def test_a_part_is_shown_checked_and_written(run_here, tmp_path, tn06):
    outcome = run_here(tmp_path, "part", "part=tn06", "samples=20", "output=new/parts")
    assert outcome.code == 0 and outcome.err == ""
    for title in ("tn06: parameters, mm", "tn06: keypoints; symmetry: 12 rotations", "checks"):
        assert f"{title}\n" in outcome.out
    assert "distance threshold of a match" in outcome.out
    assert len(re.findall("│ ok +│", outcome.out)) == 9 and "FAILED" not in outcome.out
    folder, size = tmp_path / "new" / "parts" / "tn06", tn06.part_object("L", 0)
    expected = ["poseutils.json", "tn06.glb", "tn06.obj", "tn06.png", "tn06.stl"]
    assert sorted(path.name for path in folder.iterdir()) == expected
    for ending in ("stl", "obj", "glb"):
        assert volume(folder / f"tn06.{ending}") == pytest.approx(1e9 * tn06.mesh(size).volume, rel=1e-4)
    with Image.open(folder / "tn06.png") as picture:
        assert picture.size == part_picture.SIZE
        assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 100


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize("name", ["tn06", "tn34"])
def test_the_constants_read_back(run_here, tmp_path, request, name):
    part = request.getfixturevalue(name)
    assert run_here(tmp_path, "part", f"part={name}", "index=3", *FEW).code == 0
    assert made(tmp_path, name) == {"poseutils.json", f"{name}.png", f"{name}.stl"}
    expected = part.pose_space(part.part_object("L", 3))
    write_poseutils(tmp_path / "expected.json", expected)
    path = tmp_path / "outputs" / "parts" / name / "poseutils.json"
    assert path.read_bytes() == (tmp_path / "expected.json").read_bytes()
    found = read_poseutils(path)
    assert type(found.symmetry) is type(expected.symmetry)
    assert found.distance_threshold == expected.distance_threshold
    np.testing.assert_array_equal(found.scale, expected.scale)
    np.testing.assert_array_equal(found.frame_t, expected.frame_t)


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("settings", "size"),
    [
        (("values={r:3,h:10.5,d:14}",), [3, 10.5, 14]),
        (("grid=G", "index=63"), None),
        (("values={d:14,r:3,h:10}", "formats=[ply]", "index=5"), [3, 10, 14]),
    ],
)
def test_the_chosen_sizes_are_shown(run_here, tmp_path, tn06, settings, size):
    outcome = run_here(tmp_path, "part", "part=tn06", *FEW, *settings)
    assert outcome.code == 0
    parameters = tn06.part_object("G", 63) if size is None else np.array(size) / 1000
    shown = {cells[1]: cells[2] for cells in table_cells(outcome.out) if len(cells) == 6}
    for name, value in zip(tn06.parameter_names, parameters, strict=True):
        assert shown[name] == f"{1000 * value:g}"
    ending = "ply" if "formats=[ply]" in settings else "stl"
    mesh = tmp_path / "outputs" / "parts" / "tn06" / f"tn06.{ending}"
    assert volume(mesh) == pytest.approx(1e9 * tn06.mesh(parameters).volume, rel=1e-4)


# all of them


class Everything:
    """`part=all`, once."""

    def __init__(self, folder):
        self.folder, out = folder, io.StringIO()
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
            patch.setattr(part_picture, "render_bodies", no_image)
            patch.chdir(folder)
            patch.setattr(sys, "argv", ["pnet-part", "part=all", *FEW])
            main()
        self.out = out.getvalue()


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    return Everything(tmp_path_factory.mktemp("all"))


def test_all_parts_have_their_folder_and_the_gallery(everything):
    names = sorted(path.stem for path in (config_dir() / "part").glob("*.yaml"))
    assert len(names) >= 9
    root = everything.folder / "outputs" / "parts"
    assert sorted(path.name for path in root.iterdir()) == sorted([*names, "gallery.png"])
    for name in names:
        assert made(everything.folder, name) == {"poseutils.json", f"{name}.png", f"{name}.stl"}
        assert f"{name}: parameters, mm" in everything.out
    with Image.open(root / "gallery.png") as picture:
        assert picture.size[0] > 1000 and picture.size[1] > 1000


def test_every_part_of_pnets_passes_its_checks(everything):
    names = list((config_dir() / "part").glob("*.yaml"))
    assert len(re.findall("│ ok +│", everything.out)) == 9 * len(names) and "FAILED" not in everything.out


# parts of the user's own


@pytest.mark.usefixtures("bare")
def test_a_part_out_of_a_yaml_of_ones_own(run_here, folder):
    outcome = run_here(folder, "part", *MINE, "part=crate", "values={l:30,w:20,h:10}", *FEW)
    assert outcome.code == 0 and len(re.findall("│ ok +│", outcome.out)) >= 8 and "FAILED" not in outcome.out
    assert "crate: keypoints; symmetry: 2 rotations, and a mirror plane" in outcome.out
    assert volume(folder / "outputs" / "parts" / "crate" / "crate.stl") == pytest.approx(6000)


@pytest.mark.usefixtures("bare")
def test_a_wrong_symmetry_fails_its_check(run_here, folder):
    outcome = run_here(folder, "part", *MINE, "part=crate", "part.symmetry={cyclic:4}", *FEW)
    assert outcome.error == "checks failed for crate: see the lines marked FAILED"
    failed = [line for line in outcome.out.splitlines() if "FAILED" in line]
    assert len(failed) == 1 and "symmetry carries the solid onto" in failed[0]
    assert made(folder, "crate") == {"crate.png", "crate.stl", "poseutils.json"}


@pytest.mark.usefixtures("bare")
def test_a_class_of_ones_own_is_built_where_its_module_is_trusted(run_here, trusted):
    outcome = run_here(trusted, "part", *MINE, "part=own", *FEW)
    assert outcome.code == 0 and "bar: keypoints; symmetry: one mirror plane" in outcome.out
    assert made(trusted, "bar") == {"bar.png", "bar.stl", "poseutils.json"}


@pytest.mark.parametrize("named", ["", ",", "my_part", "my_parts_too", "mine"])
def test_a_class_of_ones_own_is_refused_otherwise(run_here, trusted, monkeypatch, named):
    monkeypatch.setenv("PNET_TRUSTED", named)
    error = run_here(trusted, "part", *MINE, "part=own", *FEW).error
    assert error.startswith("part._target_: my_parts.Bar is not allowed; pnet builds only from ")
    assert error.endswith("name a module of your own in the environment variable PNET_TRUSTED")
    assert not (trusted / "outputs").exists() and "my_parts" not in sys.modules


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("os.system", "os.system is not allowed"),
        ("my_parts_too.Bar", "my_parts_too.Bar is not allowed"),
        ("my_parts", "my_parts is not allowed"),
        ("my_parts.os.system", "is posix.system, which is not allowed"),
        ("my_parts.subprocess.Popen", "is subprocess.Popen, which is not allowed"),
        ("my_parts.make", "is my_parts.make, which is not allowed"),
        ("my_parts.Gone", "my_parts.Gone does not exist"),
    ],
)
def test_trust_in_one_module_opens_no_other(run_here, trusted, target, message):
    error = run_here(trusted, "part", *MINE, "part=own", f"part._target_={target}", *FEW).error
    assert error.startswith("part._target_: ") and message in error
    assert not (trusted / "outputs").exists() and "my_parts_too" not in sys.modules


def test_a_class_that_is_no_part_is_refused(run_here, trusted):
    arguments = ("part=own", "part._target_=my_parts.NoPart", "~part.learning", *FEW)
    assert (
        run_here(trusted, "part", *MINE, *arguments).error
        == "part._target_: my_parts.NoPart is no ParametricPart"
    )


# a CAD mesh


@pytest.fixture
def meshes(folder):
    """A cuboid, an upright cylinder and a ball beside the origin, and files that hold no closed mesh."""
    cuboid = trimesh.creation.box([20, 30, 40]).apply_translation([5, -5, 100])
    cuboid.export(folder / "cuboid.stl")
    trimesh.creation.cylinder(10, 30, sections=48).export(folder / "cylinder.stl")
    trimesh.creation.icosphere(3, 8).export(folder / "sphere.stl")
    trimesh.Trimesh(cuboid.vertices, cuboid.faces[1:]).export(folder / "open.stl")
    (folder / "empty.stl").write_bytes(b"")
    return folder


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("bounds", "symmetry", "sizes"),
    [
        ("cuboid", "none", {"l": 20, "w": 30, "h": 40}),
        ("cylinder", "revolution", {"h": 30, "r": 10}),
        ("sphere", "sphere", {"r": 8}),
    ],
)
def test_a_mesh_is_a_part_by_its_bounding_primitive(run_here, meshes, bounds, symmetry, sizes):
    settings = (f"part.mesh={bounds}.stl", f"part.bounds={bounds}", f"part.symmetry={symmetry}")
    outcome = run_here(meshes, "part", *MINE, "part=fitting", *settings, *FEW)
    assert outcome.code == 0 and len(re.findall("│ ok +│", outcome.out)) >= 8 and "FAILED" not in outcome.out
    found = {cells[1]: cells[2] for cells in table_cells(outcome.out) if cells[1] in sizes}
    assert found == {name: f"{size}" for name, size in sizes.items()}
    written = volume(meshes / "outputs" / "parts" / "fitting" / "fitting.stl")
    assert 1e9 * written == pytest.approx(volume(meshes / f"{bounds}.stl"), rel=1e-5)  # that one is in mm


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((), "part.mesh is missing: give part.mesh=…"),
        (("part.mesh=null",), "mesh is None, expected a file's path"),
        (("part.mesh=gone.stl",), "gone.stl: no such file; give the mesh's path as part.mesh="),
        (("part.mesh=open.stl",), "open.stl: the mesh is not watertight"),
        (("part.mesh=empty.stl",), "empty.stl: holds no triangles"),
        (("part.mesh=mine",), "mine: ends in nothing, expected one of .stl"),
        (("part.mesh=cuboid.stl", "part.bounds=cone"), "bounds is 'cone', choose"),
        (("part.mesh=cuboid.stl", "+part.unit=ft"), "unit is 'ft', choose mm"),
        (
            ("part.mesh=cuboid.stl", "+part.keypoints={top:{from:centroid,plane:z,measures:h}}",
             "+part.sizes={h:tall}"),
            "sizes.h is 'tall', expected a number in mm",
        ),
    ],
)  # fmt: skip
def test_what_is_no_closed_mesh_is_refused(run_here, meshes, settings, message):
    assert message in run_here(meshes, "part", *MINE, "part=fitting", *settings, *FEW).error
    assert not (meshes / "outputs").exists()


# what is refused

BAD = [
    (("index=64",), "tn06 has no part object 64 in grid L: choose 0 to 63"),
    (("index=-1",), "index is -1, expected a whole number of at least 0"),
    (("index=first",), "index is first, expected a whole number"),
    (("grid=X",), "tn06 has no grid 'X': choose L or G"),
    (("values={r:3,h:10}",), "values is {'r': 3, 'h': 10}, expected numbers for r, h, d"),
    (("values={r:3,h:10,w:14}",), "expected numbers for r, h, d"),
    (("values=[3,10,14]",), "values is [3, 10, 14], expected numbers for r, h, d"),
    (("values={r:a,h:10,d:14}",), "expected numbers in mm"),
    (("values={r:-3,h:10,d:14}",), "parameters must be positive, got r = -3 mm"),
    (("values={r:13,h:10,d:14}",), "the hole (r = 13 mm) is as wide as the hexagon"),
    (("formats=[stl,step]",), "formats is ['stl', 'step'], expected a list out of stl, obj, glb, ply"),
    (("formats=stl",), "formats is stl, expected a list"),
    (("samples=0",), "samples is 0, expected a whole number of at least 1"),
    (("samples=many",), "samples is many, expected a whole number"),
    (("sample=5",), "sample: unknown key, did you mean samples"),
    (("output=null",), "output is null, expected a folder"),
    (("part.learning.r=[a]",), "part.learning.r is ['a'], expected a list of values in mm"),
    (("part.learning.r=[13]",), "the hole (r = 13 mm)"),
    (("part.sections=7",), "sections is 7, expected a multiple of 6"),
    (("part=tn6",), "part=tn6: no such choice, did you mean"),
    (("part=all", "samples=0"), "samples is 0"),
]


@pytest.mark.parametrize(("settings", "message"), BAD, ids=[" ".join(settings) for settings, _ in BAD])
def test_settings_that_do_not_fit_are_named_and_nothing_is_written(run_here, tmp_path, settings, message):
    first = () if settings[0].startswith("part=") else ("part=tn06",)
    assert message in run_here(tmp_path, "part", *first, *settings).error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (("part.name=../out",), "part.name is '../out': files are named by it"),
        (("part.name=3",), "part.name is 3: files are named by it"),
        (("part.parameters=3",), "parameters is 3, expected a list"),
        (("part.solid=3",), "crate: solid is 3, expected a list"),
        (("part.keypoints=3",), "crate: keypoints is 3, expected a mapping"),
        (("part.learning=3",), "part.learning names 3, crate has"),
        (("part.mirror=3",), "crate: mirror is 3, expected x, y, z"),
        (("+part.require=[3]",), "crate: require: '3' compares nothing"),
        (("+part.require=['l > 35']",), "crate: l > 35 does not hold for l = 30 mm"),
        (("+part.colour=red",), "unexpected keyword argument 'colour'"),
        (("grid=G",), "crate has no grid 'G': choose L"),
    ],
)
def test_a_declaration_that_does_not_fit_is_named(run_here, folder, settings, message):
    assert message in run_here(folder, "part", *MINE, "part=crate", *settings, *FEW).error
    assert not (folder / "outputs").exists()


@pytest.mark.usefixtures("bare")
def test_a_file_in_the_folders_place_is_named(run_here, tmp_path):
    (tmp_path / "taken").write_text("")
    assert "taken" in run_here(tmp_path, "part", "part=tn06", *FEW, "output=taken").error
