"""A job's process: how its end is told, whatever ended it. The jobs here are modules of a few lines."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock
from hydra.core.utils import JobStatus

import pnet
from pnet.cli.launch import Outcome, config_flags, job_return, run_one_by_one
from pnet.engine.locks import lock_path

# stands in for pnet.cli.train: the first word says what it does
JOB = """
import os, signal, sys
from pathlib import Path
from pnet.cli.app import fail
from pnet.engine.locks import hold

def main():
    kind, *rest = sys.argv[1:]
    print("started", sys.argv, flush=True)
    match kind:
        case "works":
            Path(rest[0]).touch()
        case "expected":
            fail(ValueError("data.points is 7,\\n  too few"))
        case "unexpected":
            raise ZeroDivisionError("by\\n nothing")
        case "wordless":
            raise RuntimeError
        case "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "leaves":
            sys.exit(3)
        case "ends":
            os._exit(5)
        case "interrupted":
            sys.exit(130)
        case "locked":
            try:
                with hold(Path(rest[0]), f"another process works on {rest[0]}"):
                    Path(rest[1]).touch()
            except OSError as fault:
                fail(fault)
"""
# every process of the sweep finds the stand-in among pnet's commands
SITE = """
import os, pnet.cli
pnet.cli.__path__.append(os.path.dirname(__file__))
"""
SWEEP = """
import json, sys
from pnet.cli import launch
launch.PRELOAD = "pnet.cli.app"  # nothing heavy
jobs = json.loads(sys.argv.pop(1))
found = launch.run_one_by_one("standin", ["hydra.verbose=true"], jobs)
print("FOUND " + json.dumps([[job.status.name, str(job._return_value)] for job in found]))
"""


def test_flags_of_configs_are_found_however_they_are_written():
    words = ["--multirun", "--config-dir", "mine", "seed=1", "-cd=other", "--config-name=train", "-cn", "a"]
    assert config_flags(words) == [
        *("--config-dir", "mine"),
        *("-cd", "other"),
        *("--config-name", "train"),
        *("-cn", "a"),
    ]
    assert config_flags(["--multirun", "seed=1", "data.root=--config-dir"]) == []


def test_a_good_end_and_a_bad_one_are_told_as_hydra_tells_them():
    good, bad = job_return(Outcome(None), ["a=1"]), job_return(Outcome("why"), ["a=2"])
    assert (good.status, good.overrides, good.return_value) == (JobStatus.COMPLETED, ["a=1"], None)
    assert (bad.status, bad.overrides) == (JobStatus.FAILED, ["a=2"])
    with pytest.raises(RuntimeError, match=r"^why$"):
        _ = bad.return_value


@pytest.fixture
def recorded(monkeypatch):
    """Stands in for the processes: what each is told to run, and what becomes of it."""
    calls, ends = [], {}

    def run(command, overrides, wait=True):
        calls.append((command, overrides, wait))
        outcomes = ends.get(overrides[0], [Outcome(None)])
        return outcomes.pop(0) if len(outcomes) > 1 else outcomes[0]

    monkeypatch.setattr("pnet.cli.launch.run_in_process", run)
    monkeypatch.setattr(sys, "argv", ["pnet-train", "--multirun", "--config-dir", "mine", "sweep=x"])
    return calls, ends


def test_jobs_get_the_users_configs_and_hydras_settings_but_not_those_of_the_multirun(recorded):
    calls, _ = recorded
    hydra = ["hydra.verbose=true", "hydra/launcher=process", "hydra.sweep.dir=x", "hydra.mode=MULTIRUN"]
    hydra += ["+hydra.launcher.timeout_min=3", "hydra/sweeper=resuming", "hydra.sweeper.a=1"]
    run_one_by_one("train", hydra, [["a=1"], ["a=2"]])
    own = ["--config-dir", "mine", "hydra.verbose=true"]
    assert calls == [("train", ["a=1", *own], False), ("train", ["a=2", *own], False)]


def test_a_busy_job_is_put_off_to_the_end_and_then_waited_for(recorded, capsys):
    calls, ends = recorded
    ends["a=1"] = [Outcome("another process works on it", busy=True), Outcome(None)]
    found = run_one_by_one("train", [], [["a=1"], ["a=2"]])
    assert [(words[0], wait) for _, words, wait in calls] == [("a=1", False), ("a=2", False), ("a=1", True)]
    assert [job.status for job in found] == [JobStatus.COMPLETED] * 2
    out = capsys.readouterr().out
    assert out.count("put off") == 1 and "FAILED" not in out


def test_a_failed_job_is_told_at_once_and_not_tried_again(recorded, capsys):
    calls, ends = recorded
    ends["a=1"] = [Outcome("no space")]
    found = run_one_by_one("train", [], [["a=1"], ["a=2"]])
    assert [words[0] for _, words, _ in calls] == ["a=1", "a=2"]
    assert [job.status for job in found] == [JobStatus.FAILED, JobStatus.COMPLETED]
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    assert lines[0] == "job 1 of 2: pnet-train a=1"
    assert lines[1] == "FAILED, the other jobs go on: no space"
    assert lines[2] == "job 2 of 2: pnet-train a=2"


# real processes


@pytest.fixture
def begin(tmp_path):
    """Starts a sweep of the stand-in's jobs as a process of its own."""
    site = tmp_path / "site"
    site.mkdir()
    (site / "standin.py").write_text(JOB)
    (site / "sitecustomize.py").write_text(SITE)
    paths = os.pathsep.join([str(site), str(Path(pnet.__file__).parents[1])])

    def go(*jobs):
        arguments = [json.dumps(jobs), "--multirun", "--config-dir", "mine"]
        return subprocess.Popen(
            [sys.executable, "-c", SWEEP, *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": paths},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return go


def ended(process):
    """What was found out about the jobs, and all that was printed."""
    out, err = process.communicate(timeout=60)
    lines = [line for line in out.splitlines() if line.startswith("FOUND ")]
    assert process.returncode == 0 and len(lines) == 1, (out, err)
    return json.loads(lines[0].removeprefix("FOUND ")), out, err


def test_every_kind_of_end_has_its_reason_and_the_next_job_runs(begin, tmp_path):
    kinds = ("expected", "unexpected", "wordless", "killed", "leaves", "ends", "interrupted")
    found, out, err = ended(begin(*([kind] for kind in kinds), ["works", "done"]))
    reasons = dict(zip(kinds, (reason for _, reason in found), strict=False))
    assert reasons == {
        "expected": "data.points is 7, too few",
        "unexpected": "ZeroDivisionError: by nothing",
        "wordless": "RuntimeError",
        "killed": "killed by SIGKILL (out of memory?)",
        "leaves": "exit code 3",
        "ends": "exit code 5",
        "interrupted": "interrupted",
    }
    assert [status for status, _ in found] == ["FAILED"] * 7 + ["COMPLETED"]
    assert (tmp_path / "done").exists()
    assert out.count("FAILED, the other jobs go on: ") == 7
    assert "ZeroDivisionError: by\n nothing" in err  # what is our own fault keeps its traceback
    assert err.count("error: data.points is 7, too few") == 1


def test_jobs_are_told_of_the_users_configs(begin):
    _, out, _ = ended(begin(["works", "done"]))
    own = ["--config-dir", "mine", "hydra.verbose=true"]
    assert f"started {['pnet-standin', 'works', 'done', *own]}" in out


def test_a_run_that_another_process_works_on_comes_last(begin, tmp_path):
    lock = FileLock(lock_path(tmp_path / "run"))
    lock.acquire()
    process = begin(["locked", "run", "first"], ["works", "second"])
    wait_for((tmp_path / "second").exists, process)
    assert not (tmp_path / "first").exists()
    lock.release()
    found, out, _ = ended(process)
    assert (tmp_path / "first").exists()
    assert found == [["COMPLETED", "None"]] * 2
    assert out.count("another process works on this run: put off") == 1 and "FAILED" not in out
    assert out.count("job 1 of 2") == 2 and out.count("job 2 of 2") == 1


def wait_for(condition, process):
    end = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def test_a_real_command_in_a_process_of_its_own(tmp_path):
    """Exit code and reason of pnet-info and of a mistake in its arguments."""
    code = """
from pnet.cli import launch
launch.PRELOAD = "pnet.cli.app"
print(launch.run_in_process("info", []), launch.run_in_process("info", ["nonsense=1"]))
"""
    paths = {"PYTHONPATH": str(Path(pnet.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, **paths},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done
    last = done.stdout.splitlines()[-1]
    assert last.startswith("Outcome(reason=None, busy=False) Outcome(reason='nonsense: unknown key")
    assert done.stderr.count("error: nonsense: unknown key") == 1
