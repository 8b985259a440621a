"""Make a data set: many cycles in parallel, resumable at any moment."""

import json
import os
import signal
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from dataclasses import astuple, dataclass, field
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from time import perf_counter
from typing import Any

from pnet.scenes.factory import SceneFactory, StageTimes
from pnet.scenes.manifest import MANIFEST, differences, read_manifest
from pnet.scenes.protocol import CycleTask
from pnet.scenes.store import SUFFIX, TEMPORARY, CycleFile, write_atomically, write_cycle


@dataclass(frozen=True)
class CycleReport:
    """What became of one task."""

    task: CycleTask
    scenes: int
    escaped: int
    unsettled: int
    empty: int
    times: StageTimes


@dataclass
class Summary:
    """Totals of a generation.

    Attributes:
        made, kept: cycles made now and found whole. scenes, escaped, unsettled, empty: of those made now.
        times: seconds by stage, summed over workers. seconds: wall time.
    """

    made: int = 0
    kept: int = 0
    scenes: int = 0
    escaped: int = 0
    unsettled: int = 0
    empty: int = 0
    times: StageTimes = field(default_factory=StageTimes)
    seconds: float = 0.0

    def add(self, report: CycleReport) -> None:
        """Count one finished cycle."""
        self.made += 1
        self.scenes += report.scenes
        self.escaped += report.escaped
        self.unsettled += report.unsettled
        self.empty += report.empty
        self.times = StageTimes(
            *(a + b for a, b in zip(astuple(self.times), astuple(report.times), strict=True))
        )


def cycle_path(root: Path, task: CycleTask) -> Path:
    """Where a task's file lies."""
    return root / task.split / (task.scene_id(0).file_stem + SUFFIX)


def open_root(root: Path, settings: Mapping[str, Any]) -> None:
    """Create the data folder and its manifest, or check that the one there was made with these settings.

    Raises:
        ValueError: where other settings made it; names the first few that differ.
    """
    manifest = root / MANIFEST
    if manifest.exists():
        found = read_manifest(root)
        differing = sorted(differences(found, settings))
        if differing:
            raise ValueError(
                f"{manifest}: this data was made with other settings: {'; '.join(differing[:4])}. "
                "Choose another data.root, or delete this folder to make it anew"
            )
    else:
        root.mkdir(parents=True, exist_ok=True)
        write_atomically(manifest, (json.dumps(settings, indent=1, sort_keys=True) + "\n").encode())
    for left_over in root.rglob(f".*{TEMPORARY}"):
        if not _is_running(left_over):
            left_over.unlink(missing_ok=True)


def generate(
    factory: SceneFactory, root: Path, tasks: Iterable[CycleTask], workers: int
) -> Iterator[CycleReport | None]:
    """Make what is missing.

    Args:
        factory: what scenes are made from. root: an opened data folder. tasks: the files wanted.
        workers: processes; 0 works in this one.
    Yields:
        For every task, in the order of completion, its report, or None where its file was whole already.
    """
    missing = []
    for task in tasks:
        if _is_whole(cycle_path(root, task), factory.fingerprint):
            yield None
        else:
            missing.append(task)
    for split in sorted({task.split for task in missing}):
        (root / split).mkdir(exist_ok=True)
    if workers == 0 or not missing:
        for task in missing:
            yield _make(factory, root, task)
        return
    yield from _in_parallel(factory, root, missing, workers)


def _in_parallel(
    factory: SceneFactory, root: Path, tasks: list[CycleTask], workers: int
) -> Iterator[CycleReport]:
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (factory, root))
    waiting = iter(tasks)
    running: set[Future[CycleReport]] = set()
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
            for left_over in root.rglob(f".*.{process.pid}{TEMPORARY}"):
                left_over.unlink(missing_ok=True)


def _start_worker(factory: SceneFactory, root: Path) -> None:
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    signal.signal(signal.SIGTERM, lambda *_: os._exit(1))
    torch.set_num_threads(1)
    Thread(target=_end_with_parent, daemon=True).start()
    _worker["factory"], _worker["root"] = factory, root


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for its next task for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


_worker: dict[str, Any] = {}  # what a worker process was started with


def _make_in_worker(task: CycleTask) -> CycleReport:
    return _make(_worker["factory"], _worker["root"], task)


def _make(factory: SceneFactory, root: Path, task: CycleTask) -> CycleReport:
    cycle = factory.make_cycle(task)
    start = perf_counter()
    write_cycle(cycle_path(root, task), cycle.header, cycle.scenes)
    cycle.times.write += perf_counter() - start
    header = cycle.header
    counts = (len(cycle.scenes), header.escaped, header.unsettled, header.empty)
    return CycleReport(task, *counts, cycle.times)


def _is_whole(path: Path, fingerprint: str) -> bool:
    if not path.exists():
        return False
    try:
        return CycleFile(path).header.fingerprint == fingerprint
    except ValueError:
        return False  # damaged: made anew


def _is_running(temporary: Path) -> bool:
    try:
        os.kill(int(temporary.name.split(".")[-2]), 0)
    except (ValueError, IndexError, ProcessLookupError):
        return False
    except PermissionError:
        return True
    return True
