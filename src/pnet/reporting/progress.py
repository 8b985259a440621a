"""Progress bars of long work."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


@contextmanager
def scene_progress(cycles: int, scenes_per_cycle: int) -> Iterator[Callable[[bool], None]]:
    """A bar over cycles with scenes per second.

    Args:
        cycles: how many there are. scenes_per_cycle: for the rate.
    Yields:
        A function to call after each cycle; its argument says whether the cycle was made now.
    """
    with _bar() as progress:
        task = progress.add_task("cycles", total=cycles, rate="")
        made = 0

        def advance(new: bool) -> None:
            nonlocal made
            made += new
            elapsed = progress.tasks[0].elapsed or 0
            rate = f"{made * scenes_per_cycle / elapsed:.1f} scenes/s" if made and elapsed else ""
            progress.update(task, advance=1, rate=rate)

        yield advance


@contextmanager
def count_progress(what: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """A bar over countable work with its rate.

    Args:
        what: description. total: how many. unit: of the rate.
    Yields:
        A function to call with how many more are done.
    """
    with _bar() as progress:
        task = progress.add_task(what, total=total, rate="")

        def advance(more: int) -> None:
            now = progress.tasks[0]
            rate = f"{(now.completed + more) / now.elapsed:.1f} {unit}/s" if now.elapsed else ""
            progress.update(task, advance=more, rate=rate)

        yield advance


def _bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
