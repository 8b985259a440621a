"""A data set made in parallel, interrupted, and gone on with."""

import errno
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from pnet.scenes.generation import Summary, cycle_path, generate, open_root
from pnet.scenes.manifest import MANIFEST, read_manifest, settings_fingerprint
from pnet.scenes.protocol import CycleTask, Protocol, SplitPlan
from pnet.scenes.store import CycleFile

ROOT = Path(__file__).parents[2]
SETTINGS = {"seed": 0, "part": {"name": "tn34", "sections": 48}}

pytestmark = pytest.mark.usefixtures("bullet")


@pytest.fixture
def tasks(factory) -> list[CycleTask]:
    return factory.protocol.tasks({"L": range(16)})


@pytest.fixture
def root(tmp_path) -> Path:
    open_root(tmp_path / "data", SETTINGS)
    return tmp_path / "data"


@pytest.fixture(scope="module")
def reference(factory, tmp_path_factory) -> dict[str, bytes]:
    """What the tiny data set's files hold, made in this process, in order."""
    folder = tmp_path_factory.mktemp("reference")
    open_root(folder, SETTINGS)
    list(generate(factory, folder, factory.protocol.tasks({"L": range(16)}), workers=0))
    return contents(folder)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def disk_full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def wait_until(condition, seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that ended and was not yet collected does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def test_every_task_makes_its_file_and_reports(factory, root, tasks):
    summary = Summary()
    for report in generate(factory, root, tasks, workers=0):
        summary.add(report)
    assert (summary.made, summary.scenes, summary.kept) == (5, 15, 0)
    names = ["train/clutter_0000_part_00", "train/clutter_0000_part_05", "train/pile_0000_part_00"]
    names += ["train/pile_0000_part_05", "val/pile_0001_part_00"]
    assert sorted(contents(root)) == [MANIFEST, *(f"{name}.safetensors" for name in names)]
    assert min(summary.times.simulate, summary.times.render, summary.times.write) > 0


def test_workers_and_order_do_not_change_a_byte(factory, root, tasks, reference):
    reports = list(generate(factory, root, tasks[::-1], workers=2))
    assert {r.task for r in reports} == set(tasks) and all(r.scenes == 3 for r in reports)
    assert contents(root) == reference


def test_only_what_is_missing_or_damaged_is_made(factory, root, tasks, reference):
    list(generate(factory, root, tasks, workers=0))
    deleted, truncated = cycle_path(root, tasks[1]), cycle_path(root, tasks[3])
    deleted.unlink()
    truncated.write_bytes(truncated.read_bytes()[:-100])
    kept = {p: p.stat().st_mtime_ns for p in root.rglob("*.safetensors") if p != truncated}
    reports = list(generate(factory, root, tasks, workers=0))
    assert {r.task for r in reports if r is not None} == {tasks[1], tasks[3]}
    assert reports.count(None) == 3
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert contents(root) == reference


def test_a_file_of_other_settings_is_made_anew(factory, root, tasks):
    list(generate(replace(factory, fingerprint="other"), root, tasks[:1], workers=0))
    (report,) = generate(factory, root, tasks[:1], workers=0)
    assert report is not None
    assert CycleFile(cycle_path(root, tasks[0])).header.fingerprint == "tiny"


def test_nothing_is_done_where_everything_is_there(factory, root, tasks):
    list(generate(factory, root, tasks, workers=0))
    assert list(generate(factory, root, tasks, workers=2)) == [None] * 5


def test_a_left_over_of_a_dead_process_is_removed_and_one_of_a_living_is_kept(root):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (root / "train").mkdir()
    left_over = root / "train" / f".pile.safetensors.{dead.pid}.part"
    in_work = root / "train" / f".pile.safetensors.{os.getpid()}.part"
    odd = root / "train" / ".pile.part"
    for path in (left_over, in_work, odd):
        path.write_bytes(b"half")
    open_root(root, SETTINGS)
    assert not left_over.exists() and not odd.exists() and in_work.exists()


def test_other_settings_are_refused_with_their_key(root):
    other = {"seed": 0, "part": {"name": "tn34", "sections": 24}}
    with pytest.raises(
        ValueError, match=r"dataset.json: .*part.sections was 48, now 24.*Choose another data"
    ):
        open_root(root, other)
    with pytest.raises(ValueError, match=r"physics was None, now 1; seed was 0, now 3"):
        open_root(root, {**SETTINGS, "seed": 3, "physics": 1})
    open_root(root, SETTINGS)


def test_the_manifest_keeps_the_settings(root):
    assert read_manifest(root) == SETTINGS


def test_a_folder_without_a_manifest_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}/{MANIFEST}: no data set there"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[1]", "3"])
def test_a_damaged_manifest_is_named(root, text):
    (root / MANIFEST).write_text(text)
    with pytest.raises(ValueError, match=f"{MANIFEST}: not .*make the data set anew"):
        read_manifest(root)


def test_the_fingerprint_is_of_the_values_not_of_their_order():
    assert settings_fingerprint({"a": 1, "b": {"c": 2, "d": 3}}) == settings_fingerprint(
        {"b": {"d": 3, "c": 2}, "a": 1}
    )
    assert settings_fingerprint({"a": 1}) != settings_fingerprint({"a": 2})


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only folders")
def test_a_read_only_folder_is_an_error(factory, root, tasks):
    (root / "train").mkdir()
    (root / "train").chmod(0o500)
    with pytest.raises(PermissionError):
        list(generate(factory, root, tasks[-1:], workers=0))


def test_a_full_disk_is_an_error_and_leaves_no_file(factory, root, tasks, monkeypatch, reference):
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", disk_full)
        with pytest.raises(OSError, match="No space left"):
            list(generate(factory, root, tasks, workers=0))
    assert set(contents(root)) == {MANIFEST}
    list(generate(factory, root, tasks, workers=0))
    assert contents(root) == reference


def test_an_error_in_a_worker_reaches_the_caller(factory, root):
    """The part object of the second task does not exist."""
    tasks = [CycleTask("train", "clutter", "L", 0, index) for index in (0, 99)]
    with pytest.raises(ValueError, match="tn34 has no part object 99"):
        list(generate(factory, root, tasks, workers=1))
    assert wait_until(lambda: not multiprocessing.active_children())


def test_an_interruption_stops_the_workers_and_leaves_whole_files_only(factory, root):
    tasks = [CycleTask("train", "pile", "L", cycle, 5) for cycle in range(200)]
    with pytest.raises(KeyboardInterrupt):
        for count, _ in enumerate(generate(factory, root, tasks, workers=2)):
            if count == 1:
                raise KeyboardInterrupt
    assert wait_until(lambda: not multiprocessing.active_children())
    files = sorted((root / "train").glob("[!.]*"))
    assert 2 <= len(files) < 200
    for path in files:
        file = CycleFile(path)
        assert [file.scene(i).id.drop for i in range(len(file))] == [1, 2, 3]


SCRIPT = """
import importlib.util, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("test_generation", {here!r})
module = importlib.util.module_from_spec(spec)
sys.modules["test_generation"] = module
spec.loader.exec_module(module)
if __name__ == "__main__":
    module.make_long_cycles(Path({root!r}), {workers})
"""


def long_tasks() -> list[CycleTask]:
    return [CycleTask("train", "pile", "L", cycle, 5) for cycle in range(6)]


def make_long_cycles(root: Path, workers: int) -> None:
    """Six cycles of some 0.2 s; also what the killed process runs."""
    from omegaconf import OmegaConf

    from pnet.cli.instantiate import instantiate
    from pnet.geometry.camera import Camera
    from pnet.scenes.factory import SceneFactory
    from pnet.scenes.pile import Bin
    from pnet.scenes.piling import Physics

    part = instantiate(OmegaConf.load(ROOT / "conf" / "part" / "tn34.yaml"))
    protocol = Protocol("long", 8, 256, {"train": SplitPlan("L", 6)})
    camera = Camera(160, 128, 375.0, 375.0, 79.5, 63.5, near=0.3, far=1.0)
    box = Bin(0.15, 0.15, 0.15)
    factory = SceneFactory(part, protocol, camera, box, Physics(), 0.65, 0.6, 0, "long")
    open_root(root, SETTINGS)
    for report in generate(factory, root, long_tasks(), workers):
        print(report is not None, flush=True)


def start_process(root: Path, workers: int = 0) -> subprocess.Popen:
    """A generation in a process of its own, at the moment of its first file."""
    script = SCRIPT.format(here=__file__, root=str(root), workers=workers)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert process.stdout is not None and process.stdout.readline() in (b"True\n", b"False\n")
    return process


def test_a_generation_killed_at_any_moment_goes_on_to_the_same_bytes(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    make_long_cycles(whole, workers=0)
    chance = random.Random(0)
    for _ in range(3):
        process = start_process(killed)
        time.sleep(chance.uniform(0, 0.4))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        for path in killed.glob("train/[!.]*"):
            assert path.read_bytes() == (whole / "train" / path.name).read_bytes()
    (killed / "train" / f".half.safetensors.{process.pid}.part").write_bytes(b"half")
    make_long_cycles(killed, workers=0)
    assert contents(killed) == contents(whole)


@pytest.mark.skipif(not list(Path("/proc/self/task").glob("*/children")), reason="reads Linux's /proc")
def test_workers_end_when_their_parent_is_killed(tmp_path):
    process = start_process(tmp_path / "data", workers=2)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    workers = [int(pid) for pid in children.read_text().split()]
    assert len(workers) >= 2
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert wait_until(lambda: not any(is_alive(pid) for pid in workers))
