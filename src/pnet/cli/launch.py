"""Jobs one after another, each in a process of its own."""

import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from threading import Thread

from hydra.core.utils import JobReturn, JobStatus

from pnet.cli.app import CommandFailed, config_flags
from pnet.engine.locks import NO_WAIT, Busy

# of Hydra's own settings those that make a multirun; a job is a single run
MULTIRUN_ONLY = (
    "hydra/launcher",
    "hydra/sweeper",
    "hydra.mode",
    "hydra.launcher",
    "hydra.sweeper",
    "hydra.sweep",
)
PRELOAD = "pnet.cli.preload"


@dataclass(frozen=True)
class Outcome:
    """What became of a job: reason is None where it ended well; busy: another process works on its run."""

    reason: str | None
    busy: bool = False


def run_one_by_one(
    command: str, hydra_overrides: Sequence[str], jobs: Sequence[Sequence[str]]
) -> list[JobReturn]:
    """Run each job in a process that a server forks, which has imported what every job needs.

    A job whose run another process works on is put off to the end, and then waited for.

    Args:
        command: a module of pnet.cli with a `main`. hydra_overrides: Hydra's own, for every job.
        jobs: overrides of each.
    Returns:
        one for each job, in order; a failed one's value is an exception with the reason.
    """
    own = config_flags(sys.argv[1:])
    own += [word for word in hydra_overrides if not word.lstrip("+~").startswith(MULTIRUN_ONLY)]
    found: dict[int, Outcome] = {}
    for wait in (False, True):
        for number, overrides in enumerate(jobs):
            if number in found and not found[number].busy:
                continue
            print(f"\njob {number + 1} of {len(jobs)}: pnet-{command} {' '.join(overrides)}", flush=True)
            found[number] = outcome = run_in_process(command, [*overrides, *own], wait)
            if outcome.busy:
                print("another process works on this run: put off", flush=True)
            elif outcome.reason:
                print(f"FAILED, the other jobs go on: {outcome.reason}", flush=True)
    return [job_return(found[number], overrides) for number, overrides in enumerate(jobs)]


def run_in_process(command: str, overrides: Sequence[str], wait: bool = True) -> Outcome:
    """Run a command in a process of its own and wait for its end."""
    context = get_context("forkserver")
    context.set_forkserver_preload([PRELOAD])
    receiver, sender = context.Pipe(duplex=False)
    # not a daemon: a job starts loader workers and pnet-generate
    process = context.Process(target=_job, args=(command, list(overrides), wait, sender), daemon=False)
    process.start()
    sender.close()
    try:
        outcome = receiver.recv()
    except EOFError:  # it ended without a word
        outcome = None
    except KeyboardInterrupt:
        _end(process)
        raise
    process.join()
    return outcome or Outcome(_ending(process.exitcode))


def job_return(outcome: Outcome, overrides: Sequence[str]) -> JobReturn:
    """As Hydra's launchers tell it."""
    found = JobReturn(overrides=list(overrides), status=JobStatus.COMPLETED)
    if outcome.reason is not None:
        found.status = JobStatus.FAILED
        found.return_value = RuntimeError(outcome.reason)
    return found


def _job(command: str, overrides: list[str], wait: bool, sender: "Connection") -> None:
    """A job's process: says how it ended. Its own output goes where the sweep's goes."""
    # of a fork server's child the loader's workers would not see the end
    multiprocessing.set_start_method("fork", force=True)
    Thread(target=_end_with_parent, daemon=True).start()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # what is nobody's mistake but ours keeps its name and traceback
    os.environ.pop(NO_WAIT, None)
    if not wait:
        os.environ[NO_WAIT] = "1"
    sys.argv = [f"pnet-{command}", *overrides]
    try:
        importlib.import_module(f"pnet.cli.{command}").main()
    except Busy as fault:  # under PNET_TRACEBACK=1
        sender.send(Outcome(str(fault), busy=True))
        raise
    except CommandFailed as fault:
        sender.send(Outcome(fault.text, isinstance(fault.__cause__, Busy)))
        raise
    except SystemExit as fault:
        sender.send(Outcome("interrupted" if fault.code == 130 else f"exit code {fault.code}"))
        raise
    except BaseException as fault:
        text = " ".join(str(fault).split())
        sender.send(Outcome(f"{type(fault).__name__}: {text}" if text else type(fault).__name__))
        raise
    sender.send(Outcome(None))


def _end(process: BaseProcess) -> None:
    """End a job that an interruption may have reached already (Ctrl-C does) or not."""
    process.join(3)
    if process.is_alive() and process.pid is not None:
        os.kill(process.pid, signal.SIGINT)
        process.join(30)
    if process.is_alive():
        process.terminate()
        process.join()


def _end_with_parent() -> None:
    """A job whose sweep was killed would go on beside the next one's."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _ending(code: int | None) -> str:
    if code is not None and code < 0:
        return f"killed by {signal.Signals(-code).name} (out of memory?)"
    return f"exit code {code}"
