"""Scoring of folders in the public benchmark's format."""

import json
import math
import re

import pytest

from pnet.metrics.sileane_results import read_scenes, score_folder

EYE = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]


def true_pose(x, occlusion=0.0):
    return {"R": EYE, "t": [x, 0, 0], "segmentation_id": 65535, "occlusion_rate": occlusion}


def result(x, score):
    return {"R": EYE, "t": [x, 0, 0], "score": score}


@pytest.fixture
def folders(tmp_path):
    """Two scenes: one with two poses to find and a hidden one, one with a single pose."""
    (tmp_path / "object" / "gt").mkdir(parents=True)
    (tmp_path / "results").mkdir()
    poseutils = {"type": "SphericalPoseUtils", "distance_threshold": 0.1}
    (tmp_path / "object" / "poseutils.json").write_text(json.dumps(poseutils))
    gt = tmp_path / "object" / "gt"
    write(gt / "a.json", [true_pose(0), true_pose(1), true_pose(2, 0.8)])
    write(gt / "b.json", [true_pose(0)])
    return gt, tmp_path / "results", tmp_path / "object" / "poseutils.json"


def write(path, entries):
    path.write_text(json.dumps(entries))


def test_scores_by_hand(folders):
    gt, results, _ = folders
    # falling score: a hits, a strays, b hits, a finds the hidden pose
    write(results / "a.json", [result(0, 0.9), result(5, 0.8), result(2, 0.1)])
    write(results / "b.json", [result(0.05, 0.5)])
    # macro points (P, R): (1, 1/4), ((1/2 + 1)/2, 1/4), (3/4, (1/2 + 1)/2), the same again
    assert score_folder(*folders) == pytest.approx(
        {"AP": 1 / 4 + 1 / 2 * 3 / 4, "MAP": (1 / 2 + 1) / 2, "F1": 3 / 4}
    )
    assert score_folder(gt.parent, *folders[1:]) == score_folder(*folders)


def test_a_scene_without_results_file_counts_as_found_nothing(folders):
    write(folders[1] / "b.json", [result(0, 0.5)])
    # one point: precision (1 + 1)/2, recall (0 + 1)/2
    assert score_folder(*folders) == pytest.approx({"AP": 1 / 2, "MAP": 1 / 2, "F1": 2 / 3})


def test_an_empty_results_folder_counts_as_found_nothing_everywhere(folders):
    assert score_folder(*folders) == {"AP": 0, "MAP": 0, "F1": 0}


def test_an_empty_list_is_a_scene(folders):
    write(folders[0] / "c.json", [])
    scenes = read_scenes(*folders[:2])
    assert list(scenes) == ["a.json", "b.json", "c.json"]
    assert [len(truth.t) for truth, _ in scenes.values()] == [3, 1, 0]
    assert score_folder(*folders) == pytest.approx({"AP": 1 / 3, "MAP": 1 / 3, "F1": 1 / 2})


def test_results_without_truth_are_refused(folders):
    write(folders[1] / "stranger.json", [])
    with pytest.raises(ValueError, match=r"stranger\.json: no ground truth"):
        score_folder(*folders)


def test_missing_folders_are_refused(folders, tmp_path):
    gt, results, poseutils = folders
    with pytest.raises(ValueError, match="nowhere: no such folder of ground truth"):
        score_folder(tmp_path / "nowhere", results, poseutils)
    with pytest.raises(ValueError, match="nowhere: no such folder of results"):
        score_folder(gt, tmp_path / "nowhere", poseutils)
    with pytest.raises(ValueError, match=r"results: holds no \.json"):
        score_folder(results, results, poseutils)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"R": EYE, "t": [0, 0, 0]}, "'score' is missing"),
        ({"R": EYE, "score": 1}, "'t' is missing"),
        ({"t": [0, 0, 0], "score": 1}, "'R' is missing"),
        (result(0, 1) | {"t": [0, 0]}, "'t' has shape"),
        (result(0, 1) | {"R": [1, 0, 0]}, "'R' has shape"),
        (result(0, [1.0]), "'score' has shape"),
        (result(0, "high"), "'score' does not hold numbers"),
        (result(0, None), "'score' does not hold numbers"),
        (result(0, math.nan), "'score' holds NaN"),
        (result(math.nan, 1), "'t' holds NaN"),
        (result(math.inf, 1), "'t' holds NaN or infinity"),
        (result(0, 1) | {"R": [[1.01, 0, 0], [0, 1, 0], [0, 0, 1]]}, "'R' is not a rotation"),
        (result(0, 1) | {"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "'R' is not a rotation"),
        ([0, 0], "is a list, expected an object"),
    ],
)
def test_a_fault_names_file_entry_and_key(folders, entry, message):
    path = folders[1] / "a.json"
    write(path, [result(0, 1), entry])
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}: entry 1: .*{message}"):
        score_folder(*folders)


def test_a_fault_in_the_truth_names_file_entry_and_key(folders):
    write(folders[0] / "a.json", [{"R": EYE, "t": [0, 0, 0]}])
    with pytest.raises(ValueError, match=r"a\.json: entry 0: key 'occlusion_rate' is missing"):
        score_folder(*folders)


def test_a_slightly_rounded_rotation_is_accepted(folders):
    rounded = [[0.866, -0.5, 0], [0.5, 0.866, 0], [0, 0, 1]]
    write(folders[1] / "b.json", [result(0, 1) | {"R": rounded}])
    assert score_folder(*folders)["AP"] == pytest.approx(1 / 2)


@pytest.mark.parametrize("text", ["[", "", '{"R": 1}', "\xff"])
def test_malformed_files_are_named(folders, text):
    path = folders[1] / "a.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=re.escape(str(path))):
        score_folder(*folders)
