"""Processes that make files side by side and can be interrupted at any moment."""

import os
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any, Protocol, TypeVar

from pnet.scenes.record_file import remove_left_overs

Task = TypeVar("Task", contravariant=True)
Report = TypeVar("Report", covariant=True)


class Work(Protocol[Task, Report]):
    """What a worker does; it travels to the workers once."""

    def make(self, task: Task) -> Report:
        """Make the files of one task."""


def cores() -> int:
    """How many this process may use: under a job scheduler fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_parallel(
    work: Work[Task, Report], tasks: Iterable[Task], workers: int, roots: Sequence[Path]
) -> Iterator[Report]:
    """Reports of the tasks in the order of completion.

    Args:
        work: what is done. workers: processes. roots: folders that are written to; what an interrupted worker
            leaves there is removed.
    """
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (work,))
    waiting = iter(tasks)
    running: set[Future[Report]] = set()
    try:
        while True:
            # a short queue, so that an interruption has little to wait for
            for task in waiting:
                running.add(pool.submit(_make_in_worker, task))
                if len(running) >= 2 * workers:
                    break
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenExecutor as fault:
        raise OSError(
            "a worker process was killed (out of memory?); the same command goes on, workers=1 needs less"
        ) from fault
    finally:
        processes = list((pool._processes or {}).values())
        pool.shutdown(wait=not running, cancel_futures=True)
        for process in processes if running else []:
            process.terminate()
            process.join()
            for root in roots:
                remove_left_overs(root, process.pid)


def _start_worker(work: Work[Any, Any]) -> None:
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    signal.signal(signal.SIGTERM, lambda *_: os._exit(1))
    torch.set_num_threads(1)
    Thread(target=_end_with_parent, daemon=True).start()
    _worker["work"] = work


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for its next task for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


_worker: dict[str, Work[Any, Any]] = {}  # what a worker process was started with


def _make_in_worker(task: Any) -> Any:
    return _worker["work"].make(task)
