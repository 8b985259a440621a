"""Which trainings a sweep is made of, what they share, and what is missing of each."""

import json
from collections import Counter
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf, open_dict

from pnet.cli.app import LONGEST_NAME, config_dir, hydra_value, short_name
from pnet.cli.build import build_parts
from pnet.cli.evaluate import Evaluation, recovery_settings, wanted_evaluations
from pnet.cli.jobs import cell_evaluation, changed, composed, expand, making, plain_jobs, sweep_jobs
from pnet.cli.runs import RunIndex, read_metrics
from pnet.cli.settings import training_settings
from pnet.cli.sweep_file import CellPlan, Heading, TablePlan, read_sweep
from pnet.scenes.manifest import settings_fingerprint

RUNS = Path("outputs/train")
ICP = {
    "_target_": "pnet.postprocess.icp.IcpRefinement",
    "model_points": 2000,
    "max_distance": 0.005,
    "iterations": 30,
    "min_points": 20,
}
CONF = Path(__file__).parents[2] / "conf"
SURFACE = OmegaConf.to_container(OmegaConf.load(CONF / "refine" / "surface.yaml").refine)


pytestmark = pytest.mark.usefixtures("hydra_app")


def planned(sweep, *words):
    return sweep_jobs(read_sweep(sweep), words)


def by_name(jobs):
    assert all(job.run.parent == RUNS for job in jobs)
    found = {job.run.name: job for job in jobs}
    assert len(found) == len(jobs)
    return found


def resolved(*overrides):
    """A run's settings as its folder would keep them, composed without the code that is tested here."""
    cfg = compose("train", overrides=list(overrides), return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    with open_dict(cfg):
        del cfg["hydra"]
    return OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))


def write_run(name, *overrides, metrics=None):
    run = RUNS / name
    run.mkdir(parents=True)
    (run / "resolved.yaml").write_text(OmegaConf.to_yaml(resolved(*overrides)))
    if metrics is not None:
        (run / "metrics.json").write_text(json.dumps(metrics))
    return run


# what is shared


def test_tables_3_4_and_5_share_the_full_models_run():
    jobs = by_name(planned("table3,table4,table5", "protocol=smoke", "part=tn34"))
    assert sorted(jobs) == [
        "tn34_smoke",
        "tn34_smoke_ablation-no_gu",
        "tn34_smoke_ablation-no_mv",
        "tn34_smoke_ablation-rule_camera",
        "tn34_smoke_data.learn-1-3",
        "tn34_smoke_data.learn-1-3_method-pprnet",
        "tn34_smoke_data.learn-1-5",
        "tn34_smoke_data.learn-1-5_method-pprnet",
        "tn34_smoke_method-pprnet",
    ]
    assert set(jobs["tn34_smoke"].cells) == {
        "Table III: ParametricNet / TN34",
        "Table IV: TN34 / Learn all, Ours",
        "Table V: ParametricNet (w/o RF) / TN34",
        "Table V: ParametricNet / TN34",
        "Table V: Keypoints nearest to the point / TN34",
    }
    assert jobs["tn34_smoke_method-pprnet"].cells == [
        "Table III: PPR-Net / TN34",
        "Table IV: TN34 / Learn all, PPR-Net",
    ]
    assert list(jobs["tn34_smoke_method-pprnet"].evaluations) == ["test_l", "test_g"]


def test_the_order_of_tables_does_not_change_what_is_trained():
    words = ("protocol=smoke", "part=tn34")
    jobs = {order: by_name(planned(order, *words)) for order in ("table3,table5", "table5,table3")}
    first, second = jobs.values()
    assert first.keys() == second.keys()
    for name, job in first.items():
        assert set(job.evaluations) == set(second[name].evaluations)
        assert job.settings == second[name].settings


def test_without_the_radius_filter_is_an_evaluation_of_the_full_models_run():
    jobs = planned("table5", "protocol=smoke", "part=tn34", "ablation=no_rf")
    assert [job.run.name for job in jobs] == ["tn34_smoke"]
    assert not any(word.startswith("ablation") for word in jobs[0].overrides)
    assert jobs[0].postprocess["radius_filter"]["radius"] == 0.01
    name = "test_g_radius_filter-None"
    assert jobs[0].evaluations == {name: Evaluation("test_g", {"radius_filter": None})}
    assert wanted_evaluations(OmegaConf.to_container(resolved(*jobs[0].command()).evaluate)) == [
        Evaluation("test_g", {"radius_filter": None})
    ]


@pytest.mark.parametrize(
    ("words", "shared", "alone"),
    [
        (("protocol=small",), "point", "camera"),
        (("protocol=smoke",), "point", "camera"),
        (("protocol=paper",), "camera", "point"),
        (("protocol=small", "experiment=paper"), "camera", "point"),
    ],
)
def test_the_keypoint_rule_of_the_full_model_needs_no_run_of_its_own(words, shared, alone):
    jobs = planned("table5", *words, "part=tn34")
    assert len(jobs) == 4  # full, w/o GU, w/o M_V, the other rule
    full = next(job for job in jobs if "Table V: ParametricNet / TN34" in job.cells)
    assert f"Table V: Keypoints nearest to the {shared} / TN34" in full.cells
    assert not any(word.startswith("ablation") for word in full.overrides)
    other = next(job for job in jobs if f"Table V: Keypoints nearest to the {alone} / TN34" in job.cells)
    assert other.cells == [f"Table V: Keypoints nearest to the {alone} / TN34"]
    assert other.settings["data"]["targets"]["rule"] == alone
    assert full.settings["data"]["targets"]["rule"] == shared


def test_icp_refines_the_poses_of_pprnets_run():
    jobs = by_name(planned("table2", "protocol=smoke", "part=gear"))
    assert sorted(jobs) == ["gear_smoke", "gear_smoke_method-pprnet"]
    baseline = jobs["gear_smoke_method-pprnet"]
    assert baseline.cells == ["Table II: PPR-Net / Gear", "Table II: PPR-Net with ICP / Gear"]
    assert [e.postprocess for e in baseline.evaluations.values()] == [{}, {"refine": ICP}]
    assert baseline.generate == ("bin=box_400", "view=far", "camera.far=2")
    assert "data.generate=['bin=box_400','view=far','camera.far=2']" in baseline.command()


def test_icp_alone_trains_pprnet_under_its_plain_name():
    (job,) = planned("table2", "protocol=smoke", "part=gear", "method=pprnet_icp")
    assert [e.postprocess for e in job.evaluations.values()] in ([{}], [{"refine": ICP}])
    again = resolved(*job.command())
    assert again.model._target_.endswith("PPRNet")
    (evaluation,) = wanted_evaluations(OmegaConf.to_container(again.evaluate))
    assert OmegaConf.to_container(recovery_settings(evaluation.postprocess, again))["refine"] == ICP


def test_the_tables_of_the_surface_evaluate_the_runs_of_table_3_once_more():
    plain, fitted = {}, {"refine": SURFACE}
    jobs = by_name(planned("surface", "protocol=small", "part=tn42"))
    assert sorted(jobs) == ["tn42_small", "tn42_small_method-pprnet"]
    for method, name in (("PPR-Net", "tn42_small_method-pprnet"), ("ParametricNet", "tn42_small")):
        job = jobs[name]
        assert job.cells == [
            f"Table {number}: {method}{how} / TN42"
            for number in ("S1", "S2")
            for how in ("", " fitted to the surface")
        ]
        assert [(each.split, each.postprocess) for each in job.evaluations.values()] == [
            ("test_l", plain),
            ("test_l", fitted),
            ("test_g", plain),
            ("test_g", fitted),
        ]
        assert job.postprocess["refine"] is None and not any("refine" in word for word in job.overrides)
    both = by_name(planned("surface,table3", "protocol=small", "part=tn42"))
    assert {name: len(job.cells) for name, job in both.items()} == dict.fromkeys(jobs, 5)
    assert {name: len(job.evaluations) for name, job in both.items()} == dict.fromkeys(jobs, 4)


def test_the_surface_alone_trains_under_the_plain_name():
    (job,) = planned("surface_g", "protocol=smoke", "part=tn34", "method=pprnet", "refine=surface")
    assert job.run.name == "tn34_smoke_method-pprnet"
    again = resolved(*job.command())
    (evaluation,) = wanted_evaluations(OmegaConf.to_container(again.evaluate))
    assert again.postprocess.refine is None and evaluation.split == "test_g"
    assert OmegaConf.to_container(recovery_settings(evaluation.postprocess, again))["refine"] == SURFACE
    again.postprocess.refine = ICP  # of a run that was trained with another refinement nothing stays
    assert OmegaConf.to_container(recovery_settings(evaluation.postprocess, again))["refine"] == SURFACE


# how many


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("all"))
        GlobalHydra.instance().clear()
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            jobs = sweep_jobs(read_sweep("all"), ["protocol=smoke"])
    return jobs


def test_all_tables_are_44_trainings(everything):
    jobs = by_name(everything)
    assert len(jobs) == 44
    assert Counter(name.split("_")[0] for name in jobs) == {
        **dict.fromkeys(("candlestick", "gear", "tless20", "tless29"), 2),
        **dict.fromkeys(("tn06", "tn16", "tn34", "tn42"), 9),
    }
    cells = [cell for job in everything for cell in job.cells]
    assert len(cells) == len(set(cells)) == 3 * 4 + 2 * 4 + 4 * 6 + 6 * 4
    assert sum(len(job.evaluations) for job in everything) == 4 * 3 + 4 * 12
    assert all(job.missing() == ["training", *job.evaluations] for job in everything)
    for i, job in enumerate(everything):
        assert all(job.settings != other.settings for other in everything[:i])


def test_the_siléane_parts_lie_in_the_wider_bin(everything):
    wide = {name.split("_")[0] for name, job in by_name(everything).items() if job.generate}
    assert wide == {"candlestick", "gear", "tless20", "tless29"}
    assert {job.generate for job in everything} == {(), ("bin=box_400", "view=far", "camera.far=2")}


def test_the_tables_of_the_surface_are_two_trainings_a_part():
    jobs = planned("surface", "protocol=smoke")
    assert Counter(job.run.name.split("_")[0] for job in jobs) == dict.fromkeys(
        ("tn06", "tn16", "tn34", "tn42"), 2
    )
    assert sum(len(job.evaluations) for job in jobs) == sum(len(job.cells) for job in jobs) == 2 * 4 * 4
    trained = [job.settings for job in planned("table3", "protocol=smoke")]
    assert len(trained) == 8 and all(job.settings in trained for job in jobs)


def test_a_part_restricts_a_sweep_to_its_cells():
    jobs = by_name(planned("table3", "protocol=smoke", "part=tn34"))
    assert sorted(jobs) == ["tn34_smoke", "tn34_smoke_method-pprnet"]
    assert all("TN34" in cell for job in jobs.values() for cell in job.cells)


def test_two_parts_restrict_a_sweep_to_both():
    jobs = planned("table3", "protocol=smoke", "part=tn34,tn06", "method=pprnet")
    assert [job.run.name for job in jobs] == ["tn34_smoke_method-pprnet", "tn06_smoke_method-pprnet"]


def test_what_only_one_table_sweeps_changes_the_runs_of_the_others():
    jobs = planned("table3", "protocol=smoke", "part=tn34", "data.learn=1/3")
    assert [str(job.settings["data"]["learn"]) for job in jobs] == ["1/3", "1/3"]
    chosen = planned("table4", "protocol=smoke", "part=tn34", "data.learn=1/3")
    assert [job.run.name for job in chosen] == [
        "tn34_smoke_data.learn-1-3_method-pprnet",
        "tn34_smoke_data.learn-1-3",
    ]


def test_two_seeds_are_twice_the_jobs():
    jobs = by_name(planned("table3", "protocol=smoke", "part=tn34", "seed=0,1"))
    assert sorted(jobs) == [
        "tn34_smoke",
        "tn34_smoke_method-pprnet",
        "tn34_smoke_method-pprnet_seed-1",
        "tn34_smoke_seed-1",
    ]
    assert {name: job.settings["seed"] for name, job in jobs.items() if "method" not in name} == {
        "tn34_smoke": 0,
        "tn34_smoke_seed-1": 1,
    }


def test_further_overrides_reach_every_job():
    words = ("protocol=smoke", "part=tn34", "trainer.steps=20", "backbone=range_unet", "trainer.threads=3")
    jobs = planned("table3,table5", *words)
    assert len(jobs) == 5
    for job in jobs:
        again = resolved(*job.command())
        assert job.steps == again.trainer.steps == job.settings["trainer"]["steps"] == 20
        assert again.backbone._target_.endswith("RangeUNet")
        assert again.trainer.threads == 3  # decides nothing, and is obeyed
        assert "_backbone-range_unet" in job.run.name and "_trainer.steps-20" in job.run.name
        assert "threads" not in job.run.name


def test_what_a_protocol_has_anyway_is_not_in_a_folders_name():
    words = ("protocol=smoke", "part=tn34", "seed=0", "trainer.steps=4", "method=parametricnet")
    (job,) = planned("table3", *words)
    assert job.run.name == "tn34_smoke"
    (paper,) = planned("table3", "protocol=paper", "experiment=paper", *words[1:2], "method=parametricnet")
    assert paper.run.name == "tn34_paper"


def test_a_key_that_only_another_override_brings_is_kept_with_it():
    words = ("protocol=smoke", "part=tn34", "method=pprnet", "backbone=range_unet", "backbone.cell=0.002")
    (job,) = planned("table3", *words)
    assert job.run.name == "tn34_smoke_backbone.cell-0.002_backbone-range_unet_method-pprnet"
    assert job.settings["backbone"]["cell"] == 0.002


def test_post_processing_alone_makes_no_new_run():
    (job,) = planned(
        "table3", "protocol=smoke", "part=tn34", "method=parametricnet", "postprocess.trust=null"
    )
    assert job.run.name == "tn34_smoke"
    assert job.evaluations == {"test_l_trust-None": Evaluation("test_l", {"trust": None})}


def test_an_evaluation_that_the_user_asks_for_comes_beside_the_tables():
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=pprnet", "evaluate=[val]")
    assert list(job.evaluations) == ["val", "test_l"]


def test_data_of_ones_own_is_not_made():
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=pprnet", "data.root=mine")
    assert job.generate is None
    again = resolved(*job.command())
    assert again.data.root == "mine" and again.data.generate is None


def test_settings_of_the_data_reach_pnet_generate():
    words = ("protocol=smoke", "part=gear", "method=parametricnet", "data.generate=['workers=0']")
    (job,) = planned("table2", *words)
    assert job.generate == ("bin=box_400", "view=far", "camera.far=2", "workers=0")
    assert list(resolved(*job.command()).data.generate) == [
        "bin=box_400",
        "view=far",
        "camera.far=2",
        "workers=0",
    ]


def test_a_choice_that_no_cell_has_is_refused():
    with pytest.raises(ValueError, match="part=gear"):
        planned("table3", "protocol=smoke", "part=gear")


# runs that are there


def test_a_run_with_the_same_settings_is_taken_whatever_its_name():
    run = write_run("my_own_name", "part=tn34", "protocol=smoke", "run_dir=elsewhere", "evaluate=[val]")
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=parametricnet")
    assert job.run == run
    assert resolved(*job.command()).run_dir == str(run)


@pytest.mark.parametrize("other", ["trainer.steps=8", "seed=1", "data.learn=1/3", "method=pprnet"])
def test_a_run_with_other_settings_is_not_taken(other):
    write_run("my_own_name", "part=tn34", "protocol=smoke", other)
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=parametricnet")
    assert job.run.name == "tn34_smoke"


def test_what_is_there_with_other_post_processing_is_evaluated_by_the_difference():
    metrics = {"steps": 4, "evaluations": {"test_l": {"mAP": 0.5}}}
    write_run("mine", "part=tn34", "protocol=smoke", "postprocess.trust=null", metrics=metrics)
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=parametricnet")
    assert job.run.name == "mine"
    assert job.evaluations == {"test_l_trust-0.001": Evaluation("test_l", {"trust": 0.001})}
    assert job.missing() == ["test_l_trust-0.001"]
    assert training_settings(resolved(*job.command())) == job.settings


def test_a_begun_run_gets_the_sweeps_post_processing():
    run = write_run("mine", "part=tn34", "protocol=smoke", "postprocess.trust=null")
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=parametricnet")
    assert job.run == run and list(job.evaluations) == ["test_l"]
    assert resolved(*job.command()).postprocess.trust == job.postprocess["trust"] == 0.001


def test_of_two_equal_runs_the_one_that_has_ended_is_taken():
    write_run("a_begun", "part=tn34", "protocol=smoke")
    run = write_run("b_ended", "part=tn34", "protocol=smoke", metrics={"steps": 4})
    settings = training_settings(resolved("part=tn34", "protocol=smoke"))
    assert RunIndex(RUNS).find(settings) == run
    assert RunIndex(RUNS).matching(settings, any_seed=True) == [run]


def test_an_index_leaves_out_what_is_no_run_of_this_version():
    for name, text in {
        "empty": "",
        "list": "[1, 2]",
        "garble": "a: [1",
        "old": "seed: 0\ntrainer: {steps: 4}\n",
        "bytes": "\x00",
    }.items():
        (RUNS / name).mkdir(parents=True)
        (RUNS / name / "resolved.yaml").write_text(text)
    (RUNS / "no_settings").mkdir()
    run = write_run("good", "part=tn34", "protocol=smoke")
    assert list(RunIndex(RUNS).settings) == [run]
    assert RunIndex(Path("nowhere")).find({}) is None


# what is missing


def full_job():
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=parametricnet")
    job.run.mkdir(parents=True)
    (job.run / "resolved.yaml").write_text(OmegaConf.to_yaml(resolved("part=tn34", "protocol=smoke")))
    return job


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        (None, ["training", "test_l"]),
        ("{", ["training", "test_l"]),
        ("[]", ["training", "test_l"]),
        ("\ufffd", ["training", "test_l"]),
        ("{}", ["training", "test_l"]),
        ('{"steps": null}', ["training", "test_l"]),
        ('{"steps": 2, "evaluations": {"test_l": {}}}', ["training", "test_l"]),
        ('{"steps": 4}', ["test_l"]),
        ('{"steps": 4, "evaluations": {"test_g": {}}}', ["test_l"]),
        ('{"steps": 4, "evaluations": {"test_l": {}}}', []),
        ('{"steps": 8, "evaluations": {"test_l": {}}}', []),
    ],
)
def test_what_is_missing_is_read_from_the_metrics(text, missing):
    job = full_job()
    if text is not None:
        (job.run / "metrics.json").write_text(text)
    assert job.missing() == missing


def done_job():
    """A job whose run has ended, with the data that it was trained and scored on."""
    job = full_job()
    made = making((*job.overrides, "data.root='outputs/data/tn34_smoke'"))
    manifest = {**made, "files": {"train": 1}}
    Path("outputs/data/tn34_smoke").mkdir(parents=True)
    for folder in (job.run, Path("outputs/data/tn34_smoke")):
        (folder / "dataset.json").write_text(json.dumps(manifest))
    scores = {"mAP": 0.5, "data": settings_fingerprint(manifest)}
    (job.run / "metrics.json").write_text(json.dumps({"steps": 4, "evaluations": {"test_l": scores}}))
    assert job.missing() == []
    return job, manifest


def test_a_run_of_other_settings_in_the_folder_is_missing():
    job, _ = done_job()
    other = resolved("part=tn34", "protocol=smoke", "optimizer.lr=0.5")
    (job.run / "resolved.yaml").write_text(OmegaConf.to_yaml(other))
    assert job.missing() == ["training", "test_l"]


def test_data_made_anew_with_other_settings_makes_the_run_missing():
    job, manifest = done_job()
    Path("outputs/data/tn34_smoke/dataset.json").write_text(json.dumps({**manifest, "seed": 7}))
    assert job.missing() == ["training", "test_l"]


def test_asking_for_other_data_makes_the_run_missing():
    job, _ = done_job()
    job.generate = ("seed=7",)
    assert job.missing() == ["training", "test_l"]


def test_an_evaluation_on_other_data_is_missing():
    job, _ = done_job()
    scores = {"mAP": 0.5, "data": "another"}
    (job.run / "metrics.json").write_text(json.dumps({"steps": 4, "evaluations": {"test_l": scores}}))
    assert job.missing() == ["test_l"]


def test_figures_stay_where_the_data_is_gone():
    job, _ = done_job()
    Path("outputs/data/tn34_smoke/dataset.json").unlink()
    assert job.missing() == []


@pytest.mark.parametrize("text", ['{"steps": "many"}', '{"steps": 4, "evaluations": null}', '{"steps": []}'])
def test_metrics_that_make_no_sense_are_missing(text):
    job = full_job()
    (job.run / "metrics.json").write_text(text)
    assert "test_l" in job.missing()


def test_metrics_that_are_no_text_are_missing(tmp_path):
    (tmp_path / "metrics.json").write_bytes(b"\xff\xfe\x00")
    assert read_metrics(tmp_path) is None


# the command


@pytest.mark.parametrize("sweep", ["table2", "table5", "surface"])
@pytest.mark.parametrize("words", [("protocol=smoke",), ("protocol=small", "experiment=paper", "seed=3")])
def test_a_jobs_command_composes_to_its_settings(sweep, words):
    for job in planned(sweep, *words, "part=gear" if sweep == "table2" else "part=tn34"):
        again = resolved(*job.command())
        assert training_settings(again) == job.settings
        assert OmegaConf.to_container(again.postprocess) == job.postprocess
        assert wanted_evaluations(OmegaConf.to_container(again.evaluate)) == list(job.evaluations.values())
        assert Path(again.run_dir) == job.run and again.ckpt == "auto"
        assert composed(tuple(job.command())).settings == job.settings


def test_a_folder_with_odd_characters_reaches_the_command():
    run = write_run("it's {mine}, a=b", "part=tn34", "protocol=smoke")
    (job,) = planned("table3", "protocol=smoke", "part=tn34", "method=parametricnet")
    assert job.run == run and resolved(*job.command()).run_dir == str(run)


# a multirun without a sweep


def test_a_plain_multirun_is_all_combinations_in_folders_of_their_own():
    jobs = by_name(plain_jobs(["part=tn34", "protocol=smoke", "backbone=pointnet2,range_unet", "seed=0,1"]))
    assert sorted(jobs) == sorted(
        f"tn34_smoke_backbone-{backbone}_seed-{seed}"
        for backbone in ("pointnet2", "range_unet")
        for seed in (0, 1)
    )
    assert all(job.generate is None and job.missing() == ["training"] for job in jobs.values())


def test_a_plain_multirun_in_one_folder_is_refused():
    with pytest.raises(ValueError, match="same"):
        plain_jobs(["part=tn34", "protocol=smoke", "run_dir=same", "seed=0,1"])


def test_a_plain_multirun_over_evaluations_does_all_of_them_in_one_run():
    (job,) = plain_jobs(["part=tn34", "protocol=smoke", "evaluate=[test_l],[test_g]"])
    assert list(job.evaluations) == ["test_l", "test_g"]


def test_expanding_keeps_what_hydra_understands():
    words = ["+a='x y'", "data.learn=1/3", "b={c:[1,2]}", "~d", "~e=1", "f='g,h'"]
    assert expand(words) == [words]
    assert expand(["a=1,2", "b=choice(x,y)"]) == [
        ["a=1", "b=x"],
        ["a=1", "b=y"],
        ["a=2", "b=x"],
        ["a=2", "b=y"],
    ]
    assert expand(["a=[1],[2]"]) == [["a=[1]"], ["a=[2]"]]
    assert expand(["seed=range(3)"]) == [["seed=0"], ["seed=1"], ["seed=2"]]
    with pytest.raises(ValueError, match=r"interval\(0,1\): give the values one by one"):
        expand(["a=interval(0,1)"])


# values


names = st.from_regex(r"[a-z_][a-z0-9_]{0,5}", fullmatch=True).filter(
    lambda name: name not in ("null", "true", "false", "nan", "inf")
)
leaves = st.none() | st.booleans() | st.integers(-999, 999) | st.floats(allow_nan=False, allow_infinity=False)
text = st.text(st.characters(min_codepoint=32, max_codepoint=0x2FF, exclude_characters="\\"), max_size=8)


def nested(leaf):
    return st.recursive(
        leaf,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
        max_leaves=8,
    )


@given(nested(leaves | text))
@settings(deadline=None, max_examples=150)
def test_a_plain_value_survives_hydras_parser(value):
    parsed = OverridesParser.create().parse_override(f"key={hydra_value(value)}").value()
    assert same(parsed, value)


def same(parsed, value):
    """Equal in value and in type, quoted strings unpacked."""
    if isinstance(value, dict):
        return parsed.keys() == value.keys() and all(same(parsed[key], value[key]) for key in value)
    if isinstance(value, list):
        return len(parsed) == len(value) and all(map(same, parsed, value))
    if isinstance(value, str):
        return str(getattr(parsed, "text", parsed)) == value
    return type(parsed) is type(value) and parsed == value


@pytest.mark.parametrize(
    "value",
    [
        *("\\", "a\\", "\\'", "\\\\'", "a\\b", "a\\\\b'c\\\\"),
    ],
)
def test_backslashes_survive_hydras_parser(value):
    parsed = OverridesParser.create().parse_override(f"key={hydra_value(value)}").value()
    assert str(parsed) == value


trees = st.dictionaries(names, nested(leaves), max_size=4)


@given(trees, trees)
@settings(deadline=None, max_examples=200)
def test_merging_what_has_changed_gives_the_new_settings(old, new):
    assert_merges(old, new)


@given(trees, st.data())
@settings(deadline=None, max_examples=200)
def test_merging_gives_settings_of_which_only_values_changed(old, data):
    new = {key: data.draw(st.just(value) | nested(leaves)) for key, value in old.items()}
    assert_merges(old, new)


def assert_merges(old, new):
    changes = changed(old, new)
    if changes is not None:
        merged = OmegaConf.merge(OmegaConf.create(old), OmegaConf.create(changes))
        assert OmegaConf.to_container(merged) == new


def test_what_has_changed_is_as_little_as_possible():
    old = {"a": {"b": 1, "c": [1, 2]}, "d": None, "e": 3}
    assert changed(old, old) == {}
    assert changed(old, {**old, "e": None}) == {"e": None}
    assert changed(old, {**old, "a": {"b": 2, "c": [1, 2]}}) == {"a": {"b": 2}}
    assert changed(old, {**old, "a": None}) == {"a": None}
    assert changed(old, {**old, "d": {"f": 1}}) == {"d": {"f": 1}}
    assert changed(old, {"a": old["a"], "d": None}) is None
    assert changed(old, {**old, "a": {"b": 1}}) is None


CELL = CellPlan(
    TablePlan("9", "Try", "mAP", "test_g", "", (Heading("A"),), (Heading("B"),)),
    row=0,
    column=0,
)


@pytest.mark.parametrize("trained", ["paper", "sparse", "folded", "pprnet"])
@pytest.mark.parametrize(
    "wanted",
    [
        *("paper", "sparse", "folded", "pprnet"),
        *("paper refine=icp", "folded postprocess.radius_filter=null", "folded postprocess.trust=null"),
    ],
)
def test_evaluating_for_a_cell_has_the_cells_post_processing(trained, wanted):
    have, want = (
        resolved("part=tn34", "protocol=smoke", *f"postprocess={name}".split()) for name in (trained, wanted)
    )
    target = OmegaConf.to_container(want.postprocess)
    evaluation = cell_evaluation(OmegaConf.to_container(have.postprocess), CELL, target)
    assert evaluation.split == "test_g"
    assert OmegaConf.to_container(recovery_settings(evaluation.postprocess, have)) == target


def test_another_class_of_post_processing_keeps_all_settings():
    have = resolved("part=tn34", "protocol=smoke")
    target = {**OmegaConf.to_container(have.postprocess), "_target_": "mine.Recovery"}
    evaluation = cell_evaluation(OmegaConf.to_container(have.postprocess), CELL, target)
    assert OmegaConf.to_container(recovery_settings(evaluation.postprocess, have)) == target


# names


@given(st.text(max_size=300))
@settings(deadline=None)
def test_a_folders_name_is_short_and_has_no_separators(text):
    name = short_name(text)
    assert len(name) <= LONGEST_NAME == 120
    assert not set(name) & set("/\\[]'\", ")


@given(
    st.text("abc/.-_", min_size=121, max_size=200).map(lambda text: text.replace("/", "-")),
    st.integers(min_value=0),
)
@settings(deadline=None)
def test_long_names_that_differ_in_one_place_stay_distinct(text, place):
    i = place % len(text)
    other = text[:i] + "x" + text[i + 1 :]
    assert short_name(text) != short_name(other)
    assert short_name(text)[:100] == text[:100] and short_name(text) == short_name(text)


def test_a_name_of_the_longest_length_is_kept():
    assert short_name("a" * 120) == "a" * 120
    assert short_name("a" * 121) == f"{'a' * 111}-{short_name('a' * 121)[-8:]}"
    assert short_name("data.learn-1/3_x-[1, 2]") == "data.learn-1-3_x-1+2"


@pytest.mark.parametrize(("head", "word"), [("sizes", "loss.sizes=0"), ("doubt", "loss.doubt=0.0")])
def test_a_head_that_nothing_teaches_is_refused(head, word):
    with pytest.raises(ValueError, match=rf"model\.{head} is true and loss\.{head} is 0"):
        build_parts(resolved("part=tn34", "protocol=smoke", "recipe=small", word))


@pytest.mark.parametrize("loss", ["paper", "released", "each"])
def test_every_parametric_loss_teaches_the_heads_of_a_compact_network(loss):
    cfg = resolved("part=tn34", "protocol=smoke", "recipe=small", f"loss={loss}")
    assert cfg.model.sizes and cfg.model.doubt and cfg.loss.sizes > 0 and cfg.loss.doubt > 0


@pytest.mark.parametrize(
    ("word", "exchanged"),
    [("ablation=none", True), ("ablation=no_gu", False), ("ablation=rule_camera", False)],
)
def test_lookalikes_are_sought_only_where_they_were_taught(word, exchanged):
    recovery = build_parts(resolved("part=tn42", "protocol=smoke", "recipe=small", word)).recovery
    assert recovery.voting.lookalikes is exchanged


def test_runs_of_before_a_head_was_there_are_found():
    now = resolved("part=tn34", "protocol=smoke", "experiment=paper")
    before = OmegaConf.to_container(now)
    for group, key in (("model", "sizes"), ("model", "doubt"), ("model", "pooling"), ("loss", "sizes")):
        del before[group][key]
    assert training_settings(before) == training_settings(now)
    with_pooling = resolved("part=tn34", "protocol=smoke", "experiment=paper", "model.pooling=0.006")
    assert training_settings(with_pooling) != training_settings(now)
