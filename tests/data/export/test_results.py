"""Results files, read and scored by other code than wrote them."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pnet.data.export.results import BopImage, write_bop_results, write_sileane_results
from pnet.data.export.sileane import export_sileane, sileane_name
from pnet.engine.evaluation import SceneScorer
from pnet.metrics.sileane_results import score_folder
from pnet.parts.tless20 import TLess20
from pnet.records import Detections


def detections(R, t, parameters, score, dtype=torch.float64):
    n = len(R)
    values = [torch.as_tensor(np.asarray(x), dtype=dtype) for x in (R, t, parameters, score)]
    return Detections(*values, keypoints=torch.zeros(n, 1, 3), instance=torch.zeros(5, dtype=torch.int64))


def perfect(scene):
    return detections(scene.R, scene.t, scene.parameters, np.linspace(1, 0.5, len(scene.R)))


def worsened(scene, seed):
    """Some bodies missed, some found twice, poses moved and turned, scores at random."""
    rng = np.random.default_rng([seed, scene.id.drop])
    pick = rng.integers(0, len(scene.R), len(scene.R))
    turns = Rotation.from_rotvec(rng.normal(0, 0.1, (len(pick), 3))).as_matrix()
    t = scene.t[pick] + rng.normal(0, 0.0015, (len(pick), 3))
    return detections(turns @ scene.R[pick], t, scene.parameters[pick], rng.random(len(pick)))


@pytest.fixture
def some():
    R = Rotation.random(3, np.random.default_rng(0)).as_matrix()
    parameters = [[0.015, 0.012], [np.nan, 0.0121], [np.nan, np.nan]]
    return detections(R, [[0.1, -0.02, 0.65], [1 / 3, 0, 0.5], [0, 0, 0.7]], parameters, [0.9, 0.5, 0.1])


def score(folder, scenes, found, part):
    names = [sileane_name(part.name, one) for one in scenes.ids]
    write_sileane_results(folder.parent / "results", names, found, part.parameter_names)
    return score_folder(folder, folder.parent / "results", folder / "poseutils.json")


def test_perfect_results_score_one(part, make_set, tmp_path):
    scenes = make_set(part, drops=(4, 7, 10))
    (folder,) = export_sileane(scenes, part, tmp_path)
    assert score(folder, scenes, [perfect(scene) for scene in scenes], part) == pytest.approx(
        {"AP": 1, "MAP": 1, "F1": 1}, abs=1e-12
    )


@pytest.mark.parametrize("seed", range(3))
def test_other_results_score_as_in_pnets_own_evaluation(part, make_set, tmp_path, seed):
    scenes = make_set(part, drops=(4, 7, 10))
    (folder,) = export_sileane(scenes, part, tmp_path)
    found = [worsened(scene, seed) for scene in scenes]
    own = SceneScorer(part).add_all(scenes, found).compute()
    assert 0.05 < own["AP"] < 0.95
    expected = {name: own[name] for name in ("AP", "MAP", "F1")}
    assert score(folder, scenes, found, part) == pytest.approx(expected, abs=1e-12)


def test_a_finite_symmetry_scores_alike_too(make_set, tmp_path):
    """Every result turned by the half turn that leaves the part as it is."""
    part = TLess20({"l": [30], "w": [20], "b": [10], "r": [9], "h": [20]}, sections=12)
    scenes = make_set(part, drops=(4, 6))
    (folder,) = export_sileane(scenes, part, tmp_path)
    found = [replace(perfect(s), R=torch.from_numpy(s.R @ np.diag([-1.0, -1, 1]))) for s in scenes]
    assert score(folder, scenes, found, part)["AP"] == pytest.approx(1, abs=1e-12)
    turned = [replace(f, R=f.R @ torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()) for f in found]
    assert score(folder, scenes, turned, part)["AP"] < 0.2


def test_every_scene_has_a_file_with_poses_scores_and_known_parameters(some, tmp_path):
    none = detections(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))
    steps = []
    write_sileane_results(
        tmp_path / "new" / "results", ["a_0_001", "a_0_002"], [some, none], ("r", "h"), steps.append
    )
    assert steps == [1, 1]
    first, second = (json.loads((tmp_path / "new/results" / f"a_0_00{i}.json").read_text()) for i in (1, 2))
    assert second == []
    np.testing.assert_array_equal([row["R"] for row in first], some.R.numpy())
    np.testing.assert_array_equal([row["t"] for row in first], some.t.numpy())
    assert [row["score"] for row in first] == [0.9, 0.5, 0.1]
    assert [row["parameters"] for row in first] == [{"r": 0.015, "h": 0.012}, {"h": 0.0121}, {}]


def test_single_precision_is_kept_as_it_is(some, tmp_path):
    single = replace(some, R=some.R.float(), t=some.t.float(), score=some.score.float())
    write_sileane_results(tmp_path, ["a"], [single], ("r", "h"))
    rows = json.loads((tmp_path / "a.json").read_text())
    np.testing.assert_array_equal([row["t"] for row in rows], single.t.double().numpy())


@pytest.mark.parametrize(
    ("names", "count", "what"),
    [
        (["a", "b"], 1, "1 scenes with 2 different names"),
        (["a", "a"], 2, "2 scenes with 1 different names"),
        (["../a"], 1, r"'\.\./a' is no name of a scene"),
    ],
)
def test_names_that_do_not_fit_are_refused(some, tmp_path, names, count, what):
    with pytest.raises(ValueError, match=what):
        write_sileane_results(tmp_path, names, [some] * count, ("r", "h"))


@pytest.mark.parametrize("name", ["R", "t", "score"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_poses_and_scores_that_are_no_numbers_are_refused(some, tmp_path, name, value):
    broken = getattr(some, name).clone()
    broken.view(-1)[1] = value
    with pytest.raises(ValueError, match=rf"a\.json: key '{name}' of a detection is NaN or infinite"):
        write_sileane_results(tmp_path, ["a"], [replace(some, **{name: broken})], ("r", "h"))
    with pytest.raises(ValueError, match=rf"x\.csv: scene 7, image 3: key '{name}'"):
        write_bop_results(tmp_path / "x.csv", [BopImage(7, 3, 1, replace(some, **{name: broken}))])
    assert not list(tmp_path.iterdir())


def read_bop_results(path):
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row["R"] = np.array(row["R"].split(" "), float).reshape(3, 3)
        row["t"] = np.array(row["t"].split(" "), float)
    return rows


def test_a_bop_file_gives_the_poses_back(some, tmp_path):
    path = tmp_path / "results" / "pnet_tn34-test.csv"
    other = replace(some, t=-some.t)
    write_bop_results(path, [BopImage(10003, 60, 2, some, 0.125), BopImage(3, 5, 1, other)])
    assert path.read_text().splitlines()[0] == "scene_id,im_id,obj_id,score,R,t,time"
    rows = read_bop_results(path)
    ids = [tuple(int(row[key]) for key in ("scene_id", "im_id", "obj_id")) for row in rows]
    assert ids == [(10003, 60, 2)] * 3 + [(3, 5, 1)] * 3
    assert [float(row["score"]) for row in rows] == [0.9, 0.5, 0.1] * 2
    assert [float(row["time"]) for row in rows] == [0.125] * 3 + [-1] * 3
    np.testing.assert_array_equal([row["R"] for row in rows], torch.cat([some.R, some.R]).numpy())
    error = np.abs([row["t"] / 1000 for row in rows] - torch.cat([some.t, other.t]).numpy())
    assert error.max() < 1e-15


def test_an_image_has_one_time(some, tmp_path):
    images = [BopImage(3, 5, 1, some, 0.5), BopImage(3, 6, 1, some, 0.25), BopImage(3, 5, 2, some, 0.75)]
    with pytest.raises(ValueError, match=r"scene 3, image 5: took 0\.5 s and 0\.75 s"):
        write_bop_results(tmp_path / "x.csv", images)
    write_bop_results(tmp_path / "x.csv", [*images[:2], replace(images[2], seconds=0.5)])
    assert len(read_bop_results(tmp_path / "x.csv")) == 9


@pytest.mark.parametrize("seconds", [-0.5, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(some, tmp_path, seconds):
    with pytest.raises(ValueError, match="expected 0 or more, or -1 for unknown"):
        write_bop_results(tmp_path / "x.csv", [BopImage(3, 5, 1, some, seconds)])


def test_nothing_found_is_a_header(tmp_path):
    write_bop_results(tmp_path / "x.csv", [])
    assert (tmp_path / "x.csv").read_text() == "scene_id,im_id,obj_id,score,R,t,time\n"
