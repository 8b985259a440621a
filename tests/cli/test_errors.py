"""pnet-errors on the small run."""

import csv
import json

import numpy as np
import pytest

from pnet.cli.errors import worst_scenes
from pnet.metrics.breakdown import Breakdown


def test_help_and_job_config(run_here, tmp_path):
    outcome = run_here(tmp_path, "errors", "--help")
    assert outcome.code == 0 and "pnet-errors" in outcome.out
    outcome = run_here(tmp_path, "errors", "--cfg", "job", "run=x")
    assert outcome.code == 0 and "worst: 4" in outcome.out and not list(tmp_path.iterdir())


def test_files_and_tables_agree_with_the_evaluation(smoke_copy, run_here):
    stale = smoke_copy.run / "evaluation" / "test_l" / "errors" / "worst_9.png"
    stale.parent.mkdir()
    stale.touch()
    outcome = run_here(smoke_copy.folder, "errors", "run=outputs/run", "worst=1")
    assert outcome.code == 0 and not outcome.err, outcome
    folder = stale.parent
    told = json.loads((folder / "errors.json").read_text())
    metrics = json.loads((folder.parent / "metrics.json").read_text())
    assert told["score"]["ap"] == pytest.approx(metrics["AP"], abs=1e-9)
    assert told["truths_to_find"] == metrics["truths_to_find"] and told["results"] == metrics["results"]
    found = told["outcomes"]["found"]["count"]
    assert found == metrics["true_positives"] == told["kinds"]["right"]
    names = {path.name for path in folder.iterdir()}
    drawn = {"worst_1.png"} if found < told["truths_to_find"] else set()
    assert names == {"errors.json", "instances.csv", "results.csv", "errors.png"} | drawn
    with (folder / "instances.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == told["truths_to_find"]
    assert sum(row["outcome"] == "found" for row in rows) == found
    assert "wrong pose" in outcome.out and "false results before right ones" in outcome.out


def test_what_is_missing_is_named(smoke_copy, run_here):
    outcome = run_here(smoke_copy.folder, "errors", "run=outputs/run", "evaluation=val")
    assert "val/predictions.safetensors: no predictions there; run pnet-evaluate" in outcome.error
    assert "worst=-1: expected" in run_here(smoke_copy.folder, "errors", "run=outputs/run", "worst=-1").error
    manifest = smoke_copy.data / "dataset.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "seed": 99}))
    assert "evaluate again" in run_here(smoke_copy.folder, "errors", "run=outputs/run").error


def test_the_worst_scenes_are_of_different_cycles():
    class Rows:
        scene = np.array([0, 0, 1, 1, 1, 2, 2, 3, 4])
        fate = type("Fates", (), {"outcome": np.array([1, 0, 1, 4, 0, 2, 4, 0, 3])})

        def __len__(self):
            return 9

    breakdown = Breakdown(Rows(), None, [None] * 5)
    ids = ["a/1", "a/2", "b/1", "b/2", "c/1"]
    # of two lost ones the scene with the larger share goes first; nothing is lost in b/2
    assert worst_scenes(breakdown, ids, 4) == [2, 1, 4]
    assert worst_scenes(breakdown, ids, 2) == [2, 1] and worst_scenes(breakdown, ids, 0) == []
