"""One process at a time; the others wait, or say that the folder is busy."""

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pnet.engine.locks import NO_WAIT, Busy, hold, lock_path

# takes the lock, says so, and keeps it until its input ends
HOLDER = """
import sys
from pathlib import Path
from pnet.engine.locks import hold
with hold(Path(sys.argv[1]), "another process works on it"):
    print("held", flush=True)
    sys.stdin.read()
print("released", flush=True)
"""
WAITING = "another process works on it"
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "one"


@pytest.fixture
def start(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Starts processes that want the folder's lock; all are gone afterwards."""
    monkeypatch.delenv(NO_WAIT, raising=False)
    processes: list[subprocess.Popen[str]] = []

    def begin(**environment: str) -> "subprocess.Popen[str]":
        command = [sys.executable, "-c", HOLDER, str(folder)]
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        source = str(Path(__file__).parents[2] / "src")
        env = {**os.environ, "PYTHONPATH": source, **environment}
        processes.append(subprocess.Popen(command, text=True, env=env, **pipes))
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.communicate()


def says(process: "subprocess.Popen[str]", word: str) -> None:
    assert process.stdout is not None and process.stdout.readline() == f"{word}\n"


def test_the_lock_lies_beside_the_folder_and_nothing_in_it(folder):
    with hold(folder, "busy"):
        assert lock_path(folder) == folder.parent / ".one.lock"
        assert [path.name for path in folder.parent.iterdir()] == [".one.lock"]
        assert not folder.exists()
    folder.mkdir()
    with hold(folder, "busy"):
        assert list(folder.iterdir()) == []


def test_two_paths_to_a_folder_have_one_lock(folder, tmp_path, monkeypatch):
    folder.mkdir(parents=True)
    (tmp_path / "link").symlink_to(folder)
    expected = tmp_path / "runs" / ".one.lock"
    assert lock_path(tmp_path / "link") == expected
    assert lock_path(folder / ".." / "one") == expected
    monkeypatch.chdir(folder)
    assert lock_path(Path(".")) == lock_path(Path("../one")) == expected


def test_it_is_free_again_afterwards_also_after_an_error(folder, monkeypatch):
    monkeypatch.setenv(NO_WAIT, "1")
    with pytest.raises(KeyError), hold(folder, "busy"):
        raise KeyError
    with hold(folder, "busy"), hold(folder.parent / "two", "busy"):  # of another folder
        pass
    with hold(folder, "busy"):
        pass


def test_another_process_waits_until_it_is_free(folder, start):
    with hold(folder, "busy"):
        process = start()
        assert process.stderr is not None
        told = process.stderr.readline()
        assert told == "another process works on it; waiting for it to end\n"
        assert select.select([process.stdout], [], [], 0.2)[0] == []
        assert process.poll() is None
    says(process, "held")
    out, _ = process.communicate("")
    assert (out, process.returncode) == ("released\n", 0)


def test_this_process_waits_for_another_and_says_so_once(folder, start, capsys):
    first = start()
    says(first, "held")
    begin = time.monotonic()
    release = subprocess.Popen(["sleep", "0.3"], stdout=first.stdin)  # holds the pipe open so long
    first.stdin.close()
    first.stdin = None
    with hold(folder, WAITING):
        assert time.monotonic() - begin > 0.25
    release.wait()
    assert capsys.readouterr().err == "another process works on it; waiting for it to end\n"


def test_nothing_is_said_where_nobody_holds_it(folder, capsys):
    with hold(folder, "busy"):
        pass
    assert capsys.readouterr() == ("", "")


def test_with_no_wait_it_is_busy_at_once(folder, start, monkeypatch, capsys):
    first = start()
    says(first, "held")
    monkeypatch.setenv(NO_WAIT, "1")
    begin = time.monotonic()
    with pytest.raises(Busy, match=f"^{WAITING}$"), hold(folder, WAITING):
        pytest.fail("the lock was had twice")
    assert time.monotonic() - begin < 2
    assert capsys.readouterr().err == ""
    assert issubclass(Busy, OSError)
    first.communicate("")
    with hold(folder, "busy"):
        pass


def test_another_process_that_may_not_wait_ends(folder, start):
    with hold(folder, "busy"):
        process = start(**{NO_WAIT: "1"})
        out, told = process.communicate("", timeout=60)
    assert process.returncode == 1 and out == ""
    assert told.endswith("Busy: another process works on it\n")


def test_a_killed_process_leaves_the_lock_free(folder, start, monkeypatch):
    process = start()
    says(process, "held")
    monkeypatch.setenv(NO_WAIT, "1")
    with pytest.raises(Busy), hold(folder, "busy"):
        pytest.fail("the lock was had twice")
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert process.returncode == -signal.SIGKILL and lock_path(folder).exists()
    with hold(folder, "busy"):
        pass
