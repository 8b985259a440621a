"""Which runs a table's figures come from, and what it says where they are missing or do not fit together."""

import json
import shutil
from pathlib import Path

import pytest
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf, open_dict
from torch.utils.tensorboard import SummaryWriter

from pnet.cli.evaluate import Evaluation
from pnet.cli.jobs import composed
from pnet.cli.runs import RunIndex
from pnet.cli.sweep_file import Heading, TablePlan, read_sweep
from pnet.cli.table import collect, sweep_name
from pnet.cli.table_runs import Collected

RUNS = Path("outputs/train")
SMOKE = ("protocol=smoke",)
PLAN = TablePlan(
    number="IX",
    title="Try",
    metric="mAP",
    split="test_g",
    caption="mAP on G",
    columns=(Heading("TN34", ("part=tn34",)), Heading("TN06", ("part=tn06",))),
    rows=(
        Heading("quoted", published=(0.25, None), origin="published"),
        Heading("full", ("ablation=none",), published=(0.5, None)),
        Heading("w/o RF", ("ablation=no_rf",), origin="ours"),
    ),
)
FULL, WITHOUT = "test_g", "test_g_radius_filter-None"


pytestmark = pytest.mark.usefixtures("hydra_app")


def resolved(*overrides):
    """A run's settings as its folder keeps them."""
    cfg = compose("train", overrides=list(overrides), return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    with open_dict(cfg):
        del cfg["hydra"]
    return OmegaConf.to_yaml(cfg, resolve=True)


def write_run(name, *overrides, evaluations=None, state=None, **metrics):
    """A run that has ended: mAP by evaluation, its provenance, and more of its metrics."""
    run = RUNS / name
    run.mkdir(parents=True)
    (run / "resolved.yaml").write_text(resolved("part=tn34", *SMOKE, *overrides))
    found = {
        key: {"mAP": value, "AP": 0.0, "data": "d1"} if not isinstance(value, dict) else value
        for key, value in (evaluations or {}).items()
    }
    whole = {"steps": 4, "training_seconds": 60.0, "network": {"parameters": 1234}, "evaluations": found}
    (run / "metrics.json").write_text(json.dumps({**whole, **metrics}))
    clean = {"git": {"commit": "a" * 40, "changed": False}, "packages": {"torch": "2.10", "numpy": "2.0"}}
    (run / "provenance.json").write_text(
        json.dumps({**clean, "device": "cpu", "threads": 2, **(state or {})})
    )
    return run


def collected(*words, plan=PLAN):
    return collect(plan, [*SMOKE, *words], RunIndex(RUNS), "smoke")


def mixed():
    """What the table says of runs that do not fit together; the seeds of these tests do not count."""
    return tuple(line for line in collected().warnings if not line.endswith(" seeds"))


def values(table):
    """What stands in the first column, by row."""
    return {row.name: row.cells[0].values for row in table.rows}


# figures


def test_a_cell_has_the_figure_of_its_evaluation():
    write_run("one", evaluations={FULL: 0.5, WITHOUT: 0.25, "test_l": 0.75})
    table = collected()
    assert values(table) == {"quoted": (), "full": (0.5,), "w/o RF": (0.25,)}
    assert [cell.published for cell in table.rows[0].cells] == [0.25, None]
    assert [cell.published for cell in table.rows[1].cells] == [0.5, None]
    assert [row.origin for row in table.rows] == ["published", "both", "ours"]
    assert (table.number, table.metric, table.protocol, table.corner) == ("IX", "mAP on G", "smoke", "Object")
    assert table.warnings == () and len(table.runs) == 1


def test_a_cell_is_the_mean_over_seeds():
    for seed, value in ((0, 0.5), (1, 0.75), (2, 0.25)):
        write_run(f"run_{seed}", f"seed={seed}", evaluations={FULL: value})
    cell = collected().rows[1].cells[0]
    assert sorted(cell.values) == [0.25, 0.5, 0.75]
    assert cell.mean == pytest.approx(0.5) and cell.deviation == pytest.approx(0.25)
    assert sorted(run.seed for run in collected().runs) == [0, 1, 2]


def test_one_seed_is_chosen_by_naming_it():
    for seed, value in ((0, 0.5), (1, 0.75)):
        write_run(f"run_{seed}", f"seed={seed}", evaluations={FULL: value})
    assert values(collected("seed=1"))["full"] == (0.75,)
    assert values(collected("seed=0"))["full"] == (0.5,)
    assert values(collected("seed=2"))["full"] == ()


def test_two_equal_runs_count_once():
    write_run("first", evaluations={FULL: 0.5})
    write_run("second", "trainer.threads=3", "run_dir=elsewhere", evaluations={FULL: 0.75})
    table = collected()
    assert values(table)["full"] == (0.5,)
    assert [run.folder for run in table.runs] == [str(RUNS / "first")]


def test_of_two_equal_runs_the_one_that_has_ended_counts():
    (write_run("a_begun") / "metrics.json").unlink()
    write_run("b_ended", evaluations={FULL: 0.5})
    assert values(collected())["full"] == (0.5,)


@pytest.mark.parametrize(
    "other", ["trainer.steps=8", "data.learn=1/3", "backbone=range_unet", "data.root=mine"]
)
def test_runs_with_other_settings_are_not_taken(other):
    write_run("other", other, evaluations={FULL: 0.5})
    assert values(collected())["full"] == ()
    assert values(collected(other))["full"] == (0.5,)


def test_runs_of_another_protocol_are_not_taken():
    run = write_run("other", evaluations={FULL: 0.5})
    (run / "resolved.yaml").write_text(resolved("part=tn34", "protocol=small"))
    assert values(collected())["full"] == ()


def test_a_run_with_other_post_processing_is_read_by_the_difference():
    write_run("mine", "postprocess.trust=null", evaluations={FULL: 0.125, "test_g_trust-0.001": 0.5})
    assert values(collected())["full"] == (0.5,)
    assert values(collected("postprocess.trust=null"))["full"] == (0.125,)


def test_the_tables_of_the_surface_find_a_runs_two_evaluations():
    fitted = composed(("part=tn34", *SMOKE, "method=pprnet", "refine=surface")).postprocess["refine"]
    names = [Evaluation(split, {"refine": fitted}).name for split in ("test_l", "test_g")]
    scores = {"test_l": 0.25, "test_g": 0.125, names[0]: 0.75, names[1]: 0.5}
    run = write_run("one", "method=pprnet", evaluations=scores)
    for name, figures in (("surface_l", (0.25, 0.75)), ("surface_g", (0.125, 0.5))):
        (plan,) = read_sweep(name)
        found = Collected(plan)
        table = collect(plan, [*SMOKE, "part=tn34"], RunIndex(RUNS), "smoke", found)
        assert [row.cells[2].values for row in table.rows] == [(figures[0],), (figures[1],), (), ()]
        assert [(each.run, each.cell.row, each.cell.column) for each in found.served] == [
            (run, 0, 2),
            (run, 1, 2),
        ]
        assert table.missing == tuple(
            f"Table {plan.number}: {row} / TN34: no run"
            for row in ("ParametricNet", "ParametricNet fitted to the surface")
        )
        assert [row.title for row in table.rows][:2] == [
            "PPR-Net",
            "PPR-Net fitted to the surface (ours, not in the paper)",
        ]


def test_naming_a_part_leaves_the_other_columns_out():
    write_run("one", evaluations={FULL: 0.5, WITHOUT: 0.25})
    table = collected("part=tn34")
    assert values(table)["full"] == (0.5,) and table.missing == ()
    assert table.rows[1].cells[1].values == ()


def test_the_papers_table_takes_what_another_table_trained():
    write_run("shared", evaluations={FULL: 0.5, WITHOUT: 0.25, "test_l": 0.75})
    five, three = (collected(plan=read_sweep(name)[0]) for name in ("table5", "table3"))
    found = {row.name: row.cells[2].values for row in five.rows}
    assert found["ParametricNet"] == found["Keypoints nearest to the point"] == (0.5,)
    assert found["ParametricNet (w/o RF)"] == (0.25,) and found["ParametricNet (w/o GU)"] == ()
    assert {row.name: row.cells[2].values for row in three.rows} == {"PPR-Net": (), "ParametricNet": (0.75,)}


# what is missing


def lines(table):
    """The reasons of the first column."""
    return [line for line in table.missing if "TN34" in line]


def test_without_any_run_every_cell_says_so():
    table = collected()
    assert table.missing == tuple(
        f"Table IX: {row} / {column}: no run" for row in ("full", "w/o RF") for column in ("TN34", "TN06")
    )
    assert table.runs == () and table.warnings == ()


@pytest.mark.parametrize("content", [None, "{", "[]", '{"steps": null}', "\ufffd"])
def test_a_run_that_has_not_ended_is_named(content):
    run = write_run("begun")
    (run / "metrics.json").unlink()
    if content is not None:
        (run / "metrics.json").write_text(content)
    table = collected()
    assert lines(table)[0] == f"Table IX: full / TN34: {run} has not ended" and table.runs == ()


def test_a_run_that_was_not_evaluated_is_named_with_what_lacks():
    run = write_run("one", evaluations={FULL: 0.5})
    assert lines(collected()) == [f"Table IX: w/o RF / TN34: {run} was not evaluated: {WITHOUT}"]


def test_a_figure_that_could_not_be_measured_is_missing():
    write_run("one", evaluations={FULL: {"mAP": None, "data": "d1"}, WITHOUT: 0.5})
    table = collected()
    assert values(table)["full"] == ()
    assert lines(table) == [f"Table IX: full / TN34: {RUNS / 'one'} has no mAP of {FULL}"]


def test_seeds_that_have_not_ended_are_left_out_of_the_mean():
    write_run("run_0", evaluations={FULL: 0.5})
    (write_run("run_1", "seed=1") / "metrics.json").unlink()
    table = collected()
    assert values(table)["full"] == (0.5,) and [run.seed for run in table.runs] == [0]


def test_a_folder_with_damaged_settings_is_passed_over():
    run = write_run("damaged", evaluations={FULL: 0.25})
    (run / "resolved.yaml").write_text("a: [1")
    write_run("good", evaluations={FULL: 0.5})
    assert values(collected())["full"] == (0.5,)


# what must be the same for all


def other_code(commit="b" * 40, changed=False):
    return {"git": {"commit": commit, "changed": changed}}


def write_two(state=None, data="d1", part="tn34"):
    write_run("full", evaluations={FULL: 0.5, WITHOUT: 0.25})
    run = write_run("other", "seed=1", evaluations={FULL: {"mAP": 0.5, "data": data}}, state=state)
    if part != "tn34":
        (run / "resolved.yaml").write_text(resolved(f"part={part}", *SMOKE))


def test_runs_of_the_same_code_and_data_need_no_note():
    write_two()
    assert mixed() == ()


def test_runs_of_different_commits_are_told():
    write_two(other_code())
    assert mixed() == ("the runs are of different code versions: aaaaaaa (1 runs), bbbbbbb (1 runs)",)


def test_uncommitted_changes_are_told():
    write_two(other_code("a" * 40, changed=True))
    warnings = mixed()
    assert "some runs are of code with changes that are in no commit" in warnings
    assert warnings[0].startswith("the runs are of different code versions: ")
    assert {run.commit for run in collected().runs} == {"aaaaaaa", "aaaaaaa+changes"}


def test_different_versions_of_torch_are_told():
    write_two({"packages": {"torch": "2.11", "numpy": "2.0"}})
    assert mixed() == ("the runs are of different versions of torch: 2.10, 2.11",)


def test_different_data_of_a_part_is_told():
    write_two(data="d2")
    assert mixed() == ("the runs of TN34 were scored on different data: d1, d2",)


def test_different_parts_have_different_data():
    write_two(data="d2", part="tn06")
    assert collected().warnings == ()


def test_runs_that_serve_no_cell_are_no_mixture():
    write_run("full", evaluations={FULL: 0.5})
    write_run("other", "trainer.steps=8", evaluations={FULL: 0.5}, state=other_code())
    assert collected().warnings == ()


def test_a_run_without_provenance_counts_and_is_of_unknown_code():
    run = write_run("one", evaluations={FULL: 0.5})
    for content in (None, "{", "[]"):
        (run / "provenance.json").unlink(missing_ok=True)
        if content is not None:
            (run / "provenance.json").write_text(content)
        table = collected()
        assert values(table)["full"] == (0.5,)
        assert table.runs[0].commit == "unknown" and table.runs[0].device == "unknown, ? threads"


def test_the_plans_note_comes_first():
    write_run("one", "part=gear", evaluations={"test_l": {"AP": 0.5, "mAP": 0.0, "data": "d1"}})
    (plan,) = read_sweep("table2")
    table = collected(plan=plan)
    assert table.warnings == (plan.note,) and "synthetic scenes" in plan.note
    assert {row.name: row.cells[1].values for row in table.rows}["ParametricNet"] == (0.5,)


# what stands behind


def test_a_run_says_what_it_took():
    run = write_run(
        "one", "trainer.steps=20", "data.batch_size=3", evaluations={FULL: 0.5, WITHOUT: 0.25}, steps=20
    )
    (facts,) = collected("trainer.steps=20", "data.batch_size=3").runs
    assert (facts.steps, facts.scene_iterations, facts.training_seconds) == (20, 60, 60.0)
    assert (facts.folder, facts.seed, facts.parameters) == (str(run), 0, 1234)
    assert (facts.device, facts.commit) == ("cpu, 2 threads", "aaaaaaa")
    assert facts.data == "outputs/data/tn34_smoke (d1)"
    assert facts.cells == "full / TN34; w/o RF / TN34"


def test_every_device_takes_a_batch_of_its_own():
    write_run("two", "trainer.devices=2", evaluations={FULL: 0.5})
    (facts,) = collected("trainer.devices=2").runs
    assert facts.scene_iterations == 4 * 4 * 2  # steps, batch, devices


# the command


def test_a_number_stands_for_the_papers_table():
    assert sweep_name("5") == "table5" and sweep_name("2,3") == "table2,table3"
    assert sweep_name("all") == "all" and sweep_name("mine.yaml") == "mine.yaml"


def test_cells_of_unequal_numbers_of_seeds_are_told():
    write_run("both", evaluations={FULL: 0.5, WITHOUT: 0.25})
    assert collected().warnings == ()
    write_run("other", "seed=1", evaluations={FULL: 0.75})
    assert collected().warnings == ("cells are means of 1 to 2 seeds",)


def test_runs_trained_on_different_data_are_told():
    for seed, corner in ((0, "r"), (1, "d")):
        run = write_run(f"run_{seed}", f"seed={seed}", evaluations={FULL: 0.5, WITHOUT: 0.25})
        (run / "dataset.json").write_text(json.dumps({"seed": corner}))
    assert [line.split(":")[0] for line in mixed()] == ["the runs of TN34 were trained on different data"]


def test_code_that_trained_first_or_evaluated_later_is_told():
    state = {"commits": ["aaaaaaa", "bbbbbbb"]}
    scores = {FULL: {"mAP": 0.5, "data": "d1", "commit": "ccccccc+changes"}}
    write_run("one", evaluations=scores, state=state)
    assert [run.commit for run in collected().runs] == ["aaaaaaa, bbbbbbb, ccccccc+changes"]
    assert mixed() == ("some runs are of code with changes that are in no commit",)


def test_the_command_writes_what_it_prints(run_here, tmp_path):
    write_run("one", evaluations={FULL: 0.5, WITHOUT: 0.25})
    shutil.move("outputs/train", "moved")
    outcome = run_here(tmp_path, "table", "table=5", "protocol=smoke", "runs=moved", "output=to", "part=tn34")
    assert outcome.code == 0, outcome
    assert {path.name for path in (tmp_path / "to").iterdir()} == {
        f"table_V_smoke_part-tn34.{ending}" for ending in ("md", "csv", "tex", "png")
    }
    assert "· Table V: ParametricNet (w/o GU) / TN34: no run" in outcome.out
    assert "1 runs stand behind it, 1 min 0 s of training in all, 16 scene iterations each" in outcome.out
    assert "3 cells are missing" in outcome.out
    text = (tmp_path / "to" / "table_V_smoke_part-tn34.csv").read_text()
    assert (
        "V,smoke part=tn34,ParametricNet,,TN34,mAP on the G-dataset" in text and ",0.5,,1,1.0,-0.5\n" in text
    )


def test_the_command_writes_errors_and_learning_curves_beside_the_table(run_here, tmp_path):
    """Of two seeds, one without TensorBoard files."""
    scores = {"mAP": 0.5, "data": "d1", "parameter_error_mm": 0.3, "position_error_mm": 1.0}
    scores |= {"parameter_error_mm/h": 0.4, "parameter_error_mm/r": 0.2, "axis_error_deg": 2.0}
    for seed in (0, 1):
        run = write_run(f"run_{seed}", f"seed={seed}", evaluations={FULL: scores})
    with SummaryWriter(RUNS / "run_0" / "tensorboard") as writer:
        writer.add_scalar("val/mAP", 0.25, 3)
    shutil.move("outputs/train", "moved")
    outcome = run_here(tmp_path, "table", "table=5", "protocol=smoke", "runs=moved", "output=to", "part=tn34")
    assert outcome.code == 0, outcome
    stem = tmp_path / "to" / "table_V_smoke_part-tn34"
    assert (
        "| ParametricNet / TN34 | 0.500 | 0.30 | r 0.20, h 0.40 | 1.00 | 2.00 |"
        in Path(f"{stem}.md").read_text()
    )
    assert "Table V: Parameter errors, mm" in outcome.out
    lines = Path(f"{stem}_errors.csv").read_text().splitlines()
    assert [line.split(",")[-5:] for line in lines[1:]] == [["0.3", "0.2", "0.4", "1.0", "2.0"]] * 2
    assert Path(f"{stem}_curves.png").read_bytes().startswith(b"\x89PNG")
    assert f"· {Path('moved', run.name)}: no val/mAP in TensorBoard files" in outcome.out
    assert ".md, .csv, .tex, _errors.csv, .png, _curves.png" in outcome.out


def test_a_table_without_runs_says_how_to_make_them(run_here, tmp_path):
    outcome = run_here(tmp_path, "table", "table=5", "protocol=smoke")
    assert outcome.code == 0 and "no run yet: pnet-train --multirun sweep=table" in outcome.out
    assert "[0.93]" in (tmp_path / "outputs" / "tables" / "table_V_smoke.md").read_text()


def test_a_table_that_is_not_there_is_named(run_here, tmp_path):
    assert "did you mean table5" in run_here(tmp_path, "table", "table=tabel5").error
    assert "table is missing" in run_here(tmp_path, "table").error
