"""`--multirun`: which jobs there are, which are done, and how the rest ended."""

import sys
from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from rich.console import Console

from pnet.cli.app import EXPECTED, fail, key_of
from pnet.cli.jobs import RUNS, Job, plain_jobs, sweep_jobs
from pnet.cli.runs import read_metrics
from pnet.cli.settings import recipe_text
from pnet.cli.sweep_file import read_sweep

SWEEP, DRY_RUN = "sweep", "dry_run"


def sweep(arguments: Sequence[str], launcher: Launcher) -> list[JobReturn]:
    """Run the jobs that are not done.

    Args:
        arguments: the command's overrides, among them `sweep=` and `dry_run=`.
        launcher: Hydra's, by hydra/launcher.
    Raises:
        SystemExit: with code 1 where a job failed; all are listed with their reasons.
    """
    try:
        jobs = planned_jobs(arguments)
        dry = any(asked(arguments, DRY_RUN))
    except EXPECTED as fault:  # Hydra would print a traceback
        fail(fault)
    states = [(job, job.missing()) for job in jobs]
    missing = [job for job, state in states if state]
    to_train = [job for job, state in states if "training" in state]
    out = Console(soft_wrap=True)
    if dry:
        out.print(f"runs in {RUNS}:", *job_lines(states), sep="\n", markup=False, highlight=False)
    left = estimate(to_train) if missing else "nothing to do"
    out.print(f"{len(jobs)} jobs: {len(jobs) - len(missing)} done, {len(missing)} missing; {left}")
    if dry or not missing:
        return []
    reasons, returns = launch(missing, launcher)
    failed = {job.run: reasons.get(i, "not done") for i, job in enumerate(missing) if job.missing()}
    out.print(f"\n{len(jobs) - len(failed)} of {len(jobs)} jobs done")
    for run, reason in failed.items():
        out.print(f"FAILED {run}: {reason}", style="red", markup=False)
    if failed:
        print("the same command runs again what failed", file=sys.stderr)
        sys.exit(1)
    return returns


def planned_jobs(arguments: Sequence[str]) -> list[Job]:
    """The jobs of a multirun's overrides."""
    named = [str(value) for value in asked(arguments, SWEEP)]
    further = [word for word in arguments if key_of(word) not in (SWEEP, DRY_RUN)]
    jobs = sweep_jobs(read_sweep(",".join(named)), further) if named else plain_jobs(further)
    for job in jobs:
        if job.settings["trainer"]["devices"] != 1:
            raise ValueError("trainer.devices: a job of a multirun has one; train on several outside of it")
    return jobs


def asked(arguments: Sequence[str], key: str) -> list[Any]:
    """The values that the arguments give a key, as Hydra reads them."""
    words = [word for word in arguments if key_of(word) == key]
    found: list[Any] = []
    for override in OverridesParser.create().parse_overrides(words):
        if override.is_sweep_override():
            found += list(override.sweep_iterator())
        else:
            found.append(override.value())
    return [getattr(value, "text", value) for value in found if value is not None]


def launch(jobs: Sequence[Job], launcher: Launcher) -> tuple[dict[int, str], list[JobReturn]]:
    """Run jobs; the reasons of those that failed, by number. A launcher's own failure is every job's."""
    try:
        returns = list(launcher.launch([job.command() for job in jobs], initial_job_idx=0))
    except Exception as fault:  # of a launcher that is not ours: which jobs are done is seen in their folders
        text = " ".join(str(fault).split()) or type(fault).__name__
        reason = f"not done when the launcher stopped: {text[-300:]}"
        return dict.fromkeys(range(len(jobs)), reason), []
    failed = [(i, found) for i, found in enumerate(returns) if found.status is JobStatus.FAILED]
    return {i: " ".join(str(found._return_value).split()) for i, found in failed}, returns


def job_lines(states: Sequence[tuple[Job, list[str]]]) -> Iterator[str]:
    """Every job with the tables that it serves and what is missing of it."""
    width = max(len(job.run.name) for job, _ in states)
    for job, missing in states:
        serves = ", ".join(dict.fromkeys(name.split(":")[0] for name in job.cells))
        state = ", ".join(missing) or "done"
        yield f"{job.run.name:<{width}}  {serves + ': ' if serves else ''}{state}"


def estimate(to_train: Sequence[Job]) -> str:
    """How long the missing trainings will take, by the runs of their kind that have ended."""
    from pnet.reporting.paper_table import duration_text

    known: dict[str, list[float]] = {}
    for path in RUNS.glob("*/metrics.json"):
        metrics = read_metrics(path.parent) or {}
        name, seconds, steps = (metrics.get(key) for key in ("recipe", "training_seconds", "steps"))
        if name and seconds and steps:
            known.setdefault(str(name), []).append(float(seconds) / int(steps))
    total = 0.0
    for job in to_train:
        pace = known.get(recipe_text(job.settings))
        if pace is None:
            return "no run of this kind has ended yet, so no estimate of the time"
        total += median(pace) * job.steps
    return f"about {duration_text(total)} of training"
