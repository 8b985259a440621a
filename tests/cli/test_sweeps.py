"""Sweeps as a user runs them: done again, failed, killed, at the same time, on a queue, repeated."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import lightning
import pytest
import torch
import yaml

import pnet
from pnet.cli.build import build_parts
from pnet.cli.settings import read_run
from pnet.engine.checkpoints import read_checkpoint

DOCS = Path(__file__).parents[2] / "docs"
TINY = ("protocol=smoke", "part=tn34", "protocol.drop_limit=2", "protocol.points=256")
SHORT = (*TINY, "trainer.steps=2")
MAKE = "data.generate=['workers=0']"
STEM = "protocol.drop_limit-2_protocol.points-256_trainer.steps-2"
FULL = f"tn34_smoke_{STEM}"
NO_GU, NO_MV, CAMERA = (f"tn34_smoke_ablation-{name}_{STEM}" for name in ("no_gu", "no_mv", "rule_camera"))
PPRNET = f"tn34_smoke_method-pprnet_{STEM}"


class Swept(NamedTuple):
    """A folder in which Table V was swept for one part, and what the command said."""

    folder: Path
    out: str

    @property
    def data(self) -> Path:
        return self.folder / "outputs" / "data" / "tn34_smoke"

    def run(self, name: str) -> Path:
        return self.folder / "outputs" / "train" / name


@pytest.fixture(scope="module")
def swept(bullet, tmp_path_factory, run_process):
    folder = tmp_path_factory.mktemp("sweep")
    outcome = run_process(folder, "train", "--multirun", "sweep=table5", *SHORT, MAKE)
    assert outcome.code == 0, outcome
    return Swept(folder, outcome.out)


@pytest.fixture
def spoilt(swept, tmp_path):
    """A copy to spoil."""
    shutil.copytree(swept.folder, tmp_path / "copy", symlinks=True)
    return Swept(tmp_path / "copy", swept.out)


@pytest.fixture
def place(swept, tmp_path):
    """A folder with the scenes alone."""
    shutil.copytree(swept.data, tmp_path / "place" / "outputs" / "data" / "tn34_smoke")
    return Swept(tmp_path / "place", "")


@pytest.fixture
def environment():
    """Of a process that a test starts itself."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(pnet.__file__).parents[1])}


def snapshot(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def scores(run):
    """A run's metrics without the times."""
    metrics = json.loads((run / "metrics.json").read_text())
    return without_times(metrics)


def without_times(node):
    if isinstance(node, dict):
        return {key: without_times(value) for key, value in node.items() if "second" not in key}
    return node


def weights(run):
    return read_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]


def assert_same_weights(first, second):
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


def runs_in(folder):
    return sorted(path.parent.name for path in (folder / "outputs" / "train").glob("*/metrics.json"))


def jobs_started(out):
    return [int(count) for count in re.findall(r"^job \d+ of (\d+): ", out, re.MULTILINE)]


# once, and again


def test_a_sweep_makes_the_data_and_trains_every_cell_once(swept):
    assert runs_in(swept.folder) == sorted([FULL, NO_GU, NO_MV, CAMERA])
    assert jobs_started(swept.out) == [4, 4, 4, 4]
    assert "4 jobs: 0 done, 4 missing; no run of this kind has ended yet" in swept.out
    assert "4 of 4 jobs done" in swept.out
    for name in (FULL, NO_GU, NO_MV, CAMERA):
        metrics = scores(swept.run(name))
        assert metrics["steps"] == 2
        expected = {"test_g", "test_g_radius_filter-None"} if name == FULL else {"test_g"}
        assert set(metrics["evaluations"]) == expected
        for found in metrics["evaluations"].values():
            assert 0 <= found["mAP"] <= 1 and found["scenes"] == 2


def test_the_evaluation_without_the_radius_filter_says_so(swept):
    evaluations = scores(swept.run(FULL))["evaluations"]
    assert evaluations["test_g"]["postprocess"] == {}
    assert evaluations["test_g_radius_filter-None"]["postprocess"] == {"radius_filter": None}
    digests = {found["data"] for found in evaluations.values()}
    assert len(digests) == 1


def test_the_same_command_again_runs_nothing_and_changes_nothing(swept, run_here):
    before = snapshot(swept.folder)
    outcome = run_here(swept.folder, "train", "--multirun", "sweep=table5", *SHORT, MAKE)
    assert outcome.code == 0, outcome
    assert "4 jobs: 4 done, 0 missing; nothing to do" in outcome.out
    assert not jobs_started(outcome.out)
    assert snapshot(swept.folder) == before


def test_a_dry_run_lists_and_runs_nothing(run_here, tmp_path):
    outcome = run_here(tmp_path, "train", "--multirun", "sweep=table5", *SHORT, MAKE, "dry_run=true")
    assert outcome.code == 0, outcome
    assert "4 jobs: 0 done, 4 missing" in outcome.out
    assert re.search(rf"^{FULL} +Table V: training, test_g_radius_filter-None, test_g$", outcome.out, re.M)
    assert re.search(rf"^{NO_GU} +Table V: training, test_g$", outcome.out, re.M)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_dry_run_estimates_by_the_runs_that_have_ended(spoilt, run_here):
    shutil.rmtree(spoilt.run(NO_GU))
    metrics = spoilt.run(FULL) / "metrics.json"
    for name in (FULL, CAMERA, NO_MV):
        path = spoilt.run(name) / "metrics.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "training_seconds": 120.0}))
    before = metrics.read_bytes()
    outcome = run_here(spoilt.folder, "train", "--multirun", "sweep=table5", *SHORT, MAKE, "dry_run=true")
    assert "4 jobs: 3 done, 1 missing; about 2 min 0 s of training" in outcome.out
    assert re.search(rf"^{FULL} +Table V: done$", outcome.out, re.M)
    assert metrics.read_bytes() == before and not spoilt.run(NO_GU).exists()


def test_a_value_that_no_cell_has_is_an_error(run_here, tmp_path):
    outcome = run_here(tmp_path, "train", "--multirun", "sweep=table5", "protocol=smoke", "part=gear")
    assert "part=gear" in outcome.error


def test_a_misspelt_sweep_is_answered_with_the_closest(run_here, tmp_path):
    outcome = run_here(tmp_path, "train", "--multirun", "sweep=tabel5")
    assert "sweep=tabel5: no such sweep, did you mean table5" in outcome.error


def test_a_sweep_without_multirun_says_what_to_add(run_here, tmp_path):
    assert "add --multirun" in run_here(tmp_path, "train", "sweep=table5", *SHORT).error


# failures


def forget_evaluation(run, name):
    """As if the run had ended before anybody asked for it."""
    metrics = json.loads((run / "metrics.json").read_text())
    del metrics["evaluations"][name]
    (run / "metrics.json").write_text(json.dumps(metrics))
    shutil.rmtree(run / "evaluation" / name)


def test_a_failing_job_is_told_and_the_others_are_done(spoilt, run_process):
    """Of four jobs one fails, one has an evaluation to do, one everything, one nothing."""
    checkpoint = spoilt.run(NO_GU) / "checkpoints" / "last.ckpt"
    checkpoint.write_bytes(b"garble")
    (spoilt.run(NO_GU) / "metrics.json").unlink()
    forget_evaluation(spoilt.run(FULL), "test_g_radius_filter-None")
    parts = [spoilt.run(FULL) / "checkpoints", spoilt.run(FULL) / "evaluation" / "test_g", spoilt.run(CAMERA)]
    kept = list(map(snapshot, parts))
    shutil.rmtree(spoilt.run(NO_MV))
    command = ("train", "--multirun", "sweep=table5", *SHORT, MAKE)
    outcome = run_process(spoilt.folder, *command)
    assert outcome.code == 1
    told = [line for line in outcome.out.splitlines() if "FAILED" in line]
    assert len(told) == 2 and all("last.ckpt: not a readable checkpoint" in line for line in told)
    assert told[0].startswith("FAILED, the other jobs go on: ")
    assert told[1].startswith(f"FAILED outputs/train/{NO_GU}: ")
    assert jobs_started(outcome.out) == [3, 3, 3] and "3 of 4 jobs done" in outcome.out
    assert "the same command runs again what failed" in outcome.err and "Traceback" not in outcome.err
    assert runs_in(spoilt.folder) == sorted([FULL, NO_MV, CAMERA])
    assert set(scores(spoilt.run(FULL))["evaluations"]) == {"test_g", "test_g_radius_filter-None"}
    assert list(map(snapshot, parts)) == kept

    kept = {name: snapshot(spoilt.run(name)) for name in (FULL, NO_MV, CAMERA)}
    checkpoint.unlink()
    again = run_process(spoilt.folder, *command)
    assert again.code == 0 and jobs_started(again.out) == [1], again
    assert runs_in(spoilt.folder) == sorted([FULL, NO_GU, NO_MV, CAMERA])
    assert {name: snapshot(spoilt.run(name)) for name in kept} == kept


def test_a_place_that_cannot_be_written_is_one_clear_line(swept, run_process, tmp_path):
    (tmp_path / "taken").write_text("")
    words = ("part=tn34", "run_dir=taken/run", f"data.root={swept.data}", *SHORT)
    outcome = run_process(tmp_path, "train", "--multirun", *words)
    assert outcome.code == 1
    told = [line for line in outcome.out.splitlines() if line.startswith("FAILED taken/run: ")]
    assert len(told) == 1 and "taken" in told[0].removeprefix("FAILED taken/run: ")
    assert "Traceback" not in outcome.err
    assert (tmp_path / "taken").read_text() == ""


# killed


def descendants(pid):
    """Ids of the processes that a process started, and they."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except OSError:
        return []
    children = [int(word) for word in text.split()]
    return [*children, *(pid for child in children for pid in descendants(child))]


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def test_a_killed_sweep_takes_its_job_along_and_the_same_command_goes_on(place, start, run_process, run_here):
    long = (*TINY, "trainer.steps=40", "trainer.validate_every=10", "ablation=none")
    run = place.run(
        "tn34_smoke_protocol.drop_limit-2_protocol.points-256_trainer.steps-40_trainer.validate_every-10"
    )
    command = ("train", "--multirun", "sweep=table5", *long, MAKE)
    process = start(place.folder, *command)
    wait_for(lambda: (run / "checkpoints" / "last.ckpt").exists() or process.poll() is not None, 90)
    assert process.poll() is None, process.communicate()
    jobs = descendants(process.pid)
    process.kill()
    assert jobs and any(map(is_running, jobs))
    process.communicate(timeout=30)
    wait_for(lambda: not any(map(is_running, jobs)), 10)
    reached = read_checkpoint(run / "checkpoints" / "last.ckpt")["global_step"]
    assert 2 <= reached < 40 and not (run / "metrics.json").exists()

    again = run_process(place.folder, *command)
    assert again.code == 0 and jobs_started(again.out) == [1], again
    whole = place.run("whole")
    words = (*long[:-1], "trainer.threads=1", "evaluate=[test_g]", "run_dir=outputs/train/whole")
    assert run_here(place.folder, "train", *words).code == 0
    assert_same_weights(weights(run), weights(whole))
    assert scores(run)["validation"] == pytest.approx(scores(whole)["validation"], rel=1e-6)
    ours, theirs = scores(run)["evaluations"]["test_g"], scores(whole)["evaluations"]["test_g"]
    assert ours == theirs and scores(run)["steps"] == 40


# at the same time


def test_two_sweeps_at_the_same_time_share_the_work(bullet, swept, start, tmp_path):
    command = ("train", "--multirun", "sweep=table3", *SHORT, MAKE)
    both = [start(tmp_path, *command) for _ in range(2)]
    outcomes = [(*process.communicate(timeout=120), process.returncode) for process in both]
    assert [code for *_, code in outcomes] == [0, 0], outcomes
    assert runs_in(tmp_path) == sorted([FULL, PPRNET])
    assert all("2 of 2 jobs done" in out for out, *_ in outcomes)
    once = len(list(swept.run(NO_GU).rglob("events.*")))
    for name in (FULL, PPRNET):
        run = tmp_path / "outputs" / "train" / name
        assert len(list(run.rglob("events.*"))) == once
        assert set(scores(run)["evaluations"]) == {"test_l"}
    assert_same_weights(weights(tmp_path / "outputs" / "train" / FULL), weights(swept.run(FULL)))
    made = [int(count) for out, *_ in outcomes for count in re.findall(r"(\d+) cycles made", out)]
    assert sum(made) == 7  # each file once, whoever made it


# on a queue


@pytest.mark.skipif(find_spec("submitit") is None, reason="needs the extra [slurm]")
def test_jobs_of_a_queue_run_and_fail_alike(place, swept, run_process):
    run, bad = (place.run(name) for name in (FULL, PPRNET))
    (bad / "checkpoints").mkdir(parents=True)
    (bad / "checkpoints" / "last.ckpt").write_bytes(b"garble")
    command = ("train", "--multirun", "hydra/launcher=submitit_local", "sweep=table3", *SHORT, MAKE)
    outcome = run_process(place.folder, *command)
    assert outcome.code == 1, outcome
    told = [line for line in outcome.out.splitlines() if line.startswith("FAILED outputs/train/")]
    assert len(told) == 1 and told[0].startswith(f"FAILED outputs/train/{PPRNET}: ")
    assert "last.ckpt: not a readable checkpoint" in told[0]
    assert runs_in(place.folder) == [FULL]
    assert_same_weights(weights(run), weights(swept.run(FULL)))

    (bad / "checkpoints" / "last.ckpt").unlink()
    kept = snapshot(run)
    again = run_process(place.folder, *command)
    assert again.code == 0 and "2 jobs: 1 done, 1 missing" in again.out, again
    assert runs_in(place.folder) == sorted([FULL, PPRNET]) and snapshot(run) == kept


# repeated


def test_a_repeated_run_is_the_same_bit_for_bit(spoilt, run_process, run_here):
    run = spoilt.run(FULL)
    again = run.with_name(f"{FULL}_again")
    command = ("train", f"repeat=outputs/train/{FULL}")
    before = snapshot(run)
    outcome = run_process(spoilt.folder, *command)
    assert outcome.code == 0, outcome
    assert_same_weights(weights(again), weights(run))
    assert scores(again) == scores(run)
    assert snapshot(run) == before

    shutil.rmtree(again)
    scenes = snapshot(spoilt.data)
    shutil.rmtree(spoilt.data)
    outcome = run_here(spoilt.folder, *command, "run_dir=elsewhere")
    assert outcome.code == 0, outcome
    assert snapshot(spoilt.data) == scenes and not again.exists()
    assert_same_weights(weights(spoilt.folder / "elsewhere"), weights(run))
    assert scores(spoilt.folder / "elsewhere") == scores(run)

    manifest = spoilt.data / "dataset.json"
    manifest.write_text(manifest.read_text().replace('"seed": 0', '"seed": 1'))
    error = run_here(spoilt.folder, *command, "run_dir=third").error
    assert "outputs/data/tn34_smoke: holds other data than" in error
    assert not (spoilt.folder / "third").exists()


def test_what_cannot_be_repeated_is_named(place, run_here):
    error = run_here(place.folder, "train", "repeat=nowhere").error
    assert "nowhere/resolved.yaml: no such file" in error


# several devices


def test_two_devices_train_one_network_on_twice_the_scenes(place, environment):
    run = place.folder / "two"
    words = (*SHORT, "trainer.devices=2", "trainer.accelerator=cpu", "evaluate=[test_l]", "run_dir=two")
    # as a module, because the second process is started by the first one's own name
    command = [sys.executable, "-m", "pnet.cli.train", *words]
    outcome = subprocess.run(
        command, cwd=place.folder, env=environment, capture_output=True, text=True, timeout=120
    )
    assert outcome.returncode == 0, outcome
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["steps"] == 2 and set(metrics["evaluations"]) == {"test_l"}
    scenes = metrics["scenes_per_second"] * metrics["training_seconds"]
    assert scenes == pytest.approx(2 * 2 * 4)  # devices, steps, batch
    assert len(list(place.folder.rglob("metrics.json"))) == 2  # the run's and its evaluation's
    assert outcome.stdout.count("2 steps in") == 1

    settings = read_run(run)
    lightning.seed_everything(settings.seed, verbose=False)
    begun = build_parts(settings).network.state_dict()
    trained = {
        name.split(".", 1)[1]: value for name, value in weights(run).items() if name.split(".", 1)[1] in begun
    }
    moved = [name for name, value in trained.items() if not torch.equal(value, begun[name])]
    assert trained.keys() == begun.keys() and len(moved) > len(begun) / 2


# a method of one's own


@pytest.fixture
def own_method(place, monkeypatch):
    text = (DOCS / "sweeps.md").read_text(encoding="utf-8")
    files = dict(re.findall(r"```\w+\n# (\S+)\n(.*?)```", text, re.DOTALL))
    assert set(files) == {"my_methods.py", "my_conf/method/lying.yaml"}
    for name, content in files.items():
        path = place.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
    monkeypatch.setenv("PNET_TRUSTED", "my_methods")
    return place


def test_an_untrained_method_works_like_any_other(own_method, run_process):
    folder, own = own_method.folder, ("--config-dir", "my_conf")
    words = (*own, "method=lying", *TINY, "evaluate=[test_l]", MAKE)
    trained = run_process(folder, "train", *words)
    assert trained.code == 0, trained
    name = "tn34_smoke_method-lying_protocol.drop_limit-2_protocol.points-256"
    found = scores(own_method.run(name))
    assert found["steps"] == 0 and found["evaluations"]["test_l"]["results"] > 0
    assert not (own_method.run(name) / "checkpoints").exists()
    evaluated = run_process(folder, "evaluate", f"run=outputs/train/{name}", "split=test_g")
    assert evaluated.code == 0, evaluated
    reported = run_process(folder, "report", f"run=outputs/train/{name}")
    assert reported.code == 0, reported
    assert (own_method.run(name) / "report" / "report.html").is_file()


def test_an_untrained_method_is_a_row_of_a_sweep(own_method, run_process):
    folder, own = own_method.folder, ("--config-dir", "my_conf")
    table = {
        "number": "IX",
        "title": "Own",
        "metric": "mAP",
        "split": "test_l",
        "columns": [{"name": "TN34", "set": ["part=tn34"]}],
        "rows": [
            {"name": f"{radius} mm", "set": ["method=lying", f"method.estimator.radius=0.00{radius}"]}
            for radius in (4, 6)
        ],
    }
    (folder / "mine.yaml").write_text(yaml.safe_dump(table))
    outcome = run_process(folder, "train", "--multirun", *own, "sweep=mine.yaml", *TINY, MAKE)
    assert outcome.code == 0 and "2 of 2 jobs done" in outcome.out, outcome
    assert len(runs_in(folder)) == 2 and all("method-lying" in name for name in runs_in(folder))
    printed = run_process(folder, "table", *own, "table=mine.yaml", *TINY)
    assert printed.code == 0 and "0 cells are missing" in printed.out, printed
    tables = (folder / "outputs" / "tables").glob("table_IX_smoke_*.csv")
    (path,) = (path for path in tables if not path.stem.endswith("_errors"))
    lines = path.read_text().splitlines()
    assert len(lines) == 3
    assert [line.split(",")[8] for line in lines[1:]] == ["1", "1"]  # one run a cell


def test_interrupting_a_sweep_ends_it_and_its_job(place, start):
    command = ("train", "--multirun", "sweep=table5", *TINY, "trainer.steps=200", "ablation=none", MAKE)
    process = start(place.folder, *command)
    pattern = "outputs/train/*/checkpoints/last.ckpt"
    wait_for(lambda: list(place.folder.glob(pattern)) or process.poll() is not None, 90)
    jobs = descendants(process.pid)
    for pid in [process.pid, *jobs]:  # as a terminal does
        if is_running(pid):
            os.kill(pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "interrupted: the same command goes on" in err
    wait_for(lambda: not any(map(is_running, jobs)), 10)
    assert not [path for path in place.folder.rglob("*") if path.name.endswith(".part")]
