"""What the runs behind a table say beside its figures."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from pnet.cli.evaluate import Evaluation
from pnet.cli.sweep_file import CellPlan, Heading, TablePlan
from pnet.cli.table_runs import Collected, Served, curve_run, curve_runs, error_rows, name_of, scores_of

PLAN = TablePlan(
    number="IX",
    title="Try",
    metric="AP",
    split="test_g",
    caption="AP on G",
    columns=(Heading("PPR-Net", group="Learn all"), Heading("Ours", ("data.learn=1/3",), group="Learn 1/3")),
    rows=(
        Heading("TN34", ("part=tn34",)),
        Heading("w/o RF", ("ablation=no_rf",)),
        Heading("Rule", origin="ours"),
    ),
)
SETTINGS = {
    "part": {"_target_": "pnet.parts.tn34.TN34", "learning": {"r": [1], "h": [2]}},
    "data": {"batch_size": 3},
    "trainer": {"devices": 2},
}
SCORES = {"AP": 0.5, "parameter_error_mm": 0.3, "commit": "abc"}
WITHOUT = {"radius_filter": None}


def served(row, column, run="run", postprocess=None, scores=SCORES):
    cell = CellPlan(PLAN, row, column)
    return Served(Path(run), cell, Evaluation("test_g", postprocess or {}), dict(scores))


def collected(*found):
    return Collected(PLAN, served=list(found))


def index(*runs):
    return SimpleNamespace(settings=dict.fromkeys(map(Path, runs), SETTINGS))


# names of learning curves


def test_a_heading_that_names_the_part_is_no_word():
    assert name_of([served(0, 1)]) == ("", "Learn 1/3", "Ours")
    assert name_of([served(2, 0)]) == ("Rule", "Learn all", "PPR-Net")


def test_a_run_of_several_cells_has_the_words_of_all():
    assert name_of([served(1, 0), served(2, 0)]) == ("w/o RF = Rule", "Learn all", "PPR-Net")


def test_a_cell_that_is_scored_with_other_post_processing_does_not_name_the_training():
    assert name_of([served(1, 0, postprocess=WITHOUT), served(2, 0)]) == ("Rule", "Learn all", "PPR-Net")
    assert name_of([served(1, 0, postprocess=WITHOUT)])[0] == "w/o RF"


def test_each_run_is_drawn_once_by_the_metric_of_the_table(tmp_path):
    metrics = {"steps": 40, "training_seconds": 60.0, "evaluations": {}}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    found = curve_runs(
        collected(*(served(i, 0, tmp_path) for i in (0, 1)), served(2, 0)), index("run", tmp_path)
    )
    assert [run.folder for run in found] == [tmp_path, Path("run")]
    first, second = found
    assert (first.part, first.metric, first.scenes_a_step) == ("TN34", "AP", 6)
    assert (first.steps, first.training_seconds) == (40, 60.0)
    assert (second.steps, second.training_seconds) == (0, None)


def test_a_part_from_a_file_is_called_by_its_name():
    named = {**SETTINGS, "part": {"_target_": "pnet.parts.declared.DeclaredPart", "name": "knob"}}
    assert curve_run(Path("run"), named, ("mine",)).part == "knob"


# errors


def test_the_rows_of_a_cell_are_means_over_its_runs_in_the_parts_order():
    each = {"parameter_error_mm/h": 0.25, "parameter_error_mm/r": 0.5}
    rows = error_rows(
        collected(
            served(0, 0, "a", scores={**SCORES, **each}),
            served(0, 0, "b", scores={**SCORES, **each, "parameter_error_mm/h": 0.75}),
            served(0, 1, "c", scores={"AP": 0.5, "parameter_error_mm": None}),
            served(2, 0, "a"),
        ),
        index("a", "b", "c"),
    )
    assert [(row.name, row.seeds) for row in rows] == [
        ("TN34 / Learn all: PPR-Net", 2),
        ("Rule / Learn all: PPR-Net", 1),
    ]
    assert rows[0].parameters == ("r", "h") and rows[0].means["parameter_error_mm/h"] == pytest.approx(0.5)
    assert rows[1].row.title == "Rule (ours, not in the paper)" and rows[1].means["AP"] == 0.5


def written(run, content):
    """What pnet-evaluate left in the run's folder."""
    path = run / "evaluation" / "test_g" / "metrics.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content) if isinstance(content, dict) else content)


def test_what_a_later_scoring_of_the_same_predictions_adds_is_taken(tmp_path):
    written(tmp_path, {"AP": 0.5, "parameter_error_mm": 0.3, "parameter_error_mm/r": 0.1, "predictions": "f"})
    found = scores_of(served(0, 0, tmp_path))
    assert found["parameter_error_mm/r"] == 0.1 and found["commit"] == "abc"


@pytest.mark.parametrize("content", [{"AP": 0.75, "parameter_error_mm/r": 0.1}, "{", "[]"])
def test_what_was_scored_on_other_predictions_is_not(tmp_path, content):
    written(tmp_path, content)
    assert scores_of(served(0, 0, tmp_path)) == SCORES
