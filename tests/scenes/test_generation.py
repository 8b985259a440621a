"""A data set made in two stages and in parallel, interrupted, and gone on with."""

import errno
import multiprocessing
import os
import random
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from pnet.cli.generate import take_share
from pnet.geometry.camera import Camera
from pnet.scenes.factory import SceneFactory
from pnet.scenes.generation import Plan, Summary, cycle_path, generate, open_root
from pnet.scenes.manifest import MANIFEST, read_manifest, settings_fingerprint
from pnet.scenes.pile_store import PileFile
from pnet.scenes.protocol import CycleTask, Protocol, SplitPlan
from pnet.scenes.store import CycleFile

ROOT = Path(__file__).parents[2]
SETTINGS = {"seed": 0, "part": {"name": "tn34", "sections": 48}}
KILLS = int(os.environ.get("PNET_KILLS", "6"))  # random moments at which a generation is killed

pytestmark = pytest.mark.usefixtures("bullet")


def open_plan(factory: SceneFactory, root: Path, stage: str = "all", piles: Path | None = None) -> Plan:
    """A plan with the folders of its stages open."""
    plan = Plan(factory, piles or root / "piles", root, stage)
    open_root(plan.piles, SETTINGS, "data.piles")
    if stage != "simulate":
        open_root(root, SETTINGS)
    return plan


@pytest.fixture
def tasks(factory) -> list[CycleTask]:
    return factory.piles.protocol.tasks({"L": range(16)})


@pytest.fixture
def root(tmp_path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def plan(factory, root) -> Plan:
    return open_plan(factory, root)


@pytest.fixture(scope="module")
def reference(factory, tmp_path_factory) -> dict[str, str]:
    """What the tiny data set's files hold, made in this process, in order."""
    folder = tmp_path_factory.mktemp("reference")
    list(generate(open_plan(factory, folder), factory.piles.protocol.tasks({"L": range(16)}), workers=0))
    return contents(folder)


def contents(folder: Path) -> dict[str, str]:
    """Size and checksum of every file below a folder, hidden ones too: short where two differ."""
    return {str(p.relative_to(folder)): brief(p.read_bytes()) for p in folder.rglob("*") if p.is_file()}


def brief(data: bytes) -> str:
    return f"{len(data)} bytes, sha256 {sha256(data).hexdigest()[:16]}"


def part_of(files: dict[str, str], stage: str) -> dict[str, str]:
    """A stage's files among all."""
    return {name: data for name, data in files.items() if name.startswith("piles/") == (stage == "simulate")}


def disk_full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def no_engine(*_):
    raise AssertionError("the physics engine was started")


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
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


def test_every_task_makes_its_files_and_reports(plan, root, tasks):
    summary = Summary()
    for report in generate(plan, tasks, workers=0):
        summary.add(report)
    assert (summary.made, summary.scenes, summary.kept, summary.simulated) == (5, 15, 0, 5)
    names = ["train/clutter_0000_part_00", "train/clutter_0000_part_05", "train/pile_0000_part_00"]
    names += ["train/pile_0000_part_05", "val/pile_0001_part_00"]
    made = [MANIFEST, *(f"{name}.safetensors" for name in names)]
    assert sorted(contents(root)) == sorted([*made, *(f"piles/{name}" for name in made)])
    assert min(summary.times.simulate, summary.times.render, summary.times.write) > 0


def test_workers_and_order_do_not_change_a_byte(plan, root, tasks, reference):
    reports = list(generate(plan, tasks[::-1], workers=2))
    assert {r.task for r in reports} == set(tasks) and all(r.scenes == 3 for r in reports)
    assert contents(root) == reference


def test_only_what_is_missing_or_damaged_is_made(plan, root, tasks, reference):
    list(generate(plan, tasks, workers=0))
    deleted, truncated = cycle_path(root, tasks[1]), cycle_path(root, tasks[3])
    deleted.unlink()
    truncated.write_bytes(truncated.read_bytes()[:-100])
    cycle_path(plan.piles, tasks[3]).unlink()
    made = {deleted, truncated, cycle_path(plan.piles, tasks[3])}
    kept = {p: p.stat().st_mtime_ns for p in root.rglob("*.safetensors") if p not in made}
    reports = list(generate(plan, tasks, workers=0))
    assert {r.task: r.simulated for r in reports if r is not None} == {tasks[1]: False, tasks[3]: True}
    assert reports.count(None) == 3
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert contents(root) == reference


def test_a_file_of_other_settings_is_made_anew(factory, plan, root, tasks, reference):
    piles = replace(factory.piles, seed=1, fingerprint="other")
    other = replace(factory, piles=piles, fingerprint="other")
    list(generate(replace(plan, factory=other), tasks[:1], workers=0))
    (report,) = generate(plan, tasks[:1], workers=0)
    assert report is not None and report.simulated
    assert CycleFile(cycle_path(root, tasks[0])).header.fingerprint == "tiny"
    assert PileFile(cycle_path(plan.piles, tasks[0])).header.fingerprint == "tiny"
    assert contents(root).items() <= reference.items()


def test_nothing_is_done_where_everything_is_there(plan, tasks):
    list(generate(plan, tasks, workers=0))
    assert list(generate(plan, tasks, workers=2)) == [None] * 5


# two stages


def test_simulating_first_and_rendering_then_gives_the_bytes_of_both_at_once(factory, root, tasks, reference):
    list(generate(open_plan(factory, root, "simulate"), tasks, workers=0))
    assert contents(root) == part_of(reference, "simulate")
    list(generate(open_plan(factory, root, "render"), tasks, workers=0))
    assert contents(root) == reference


def test_each_stage_reports_what_it_made(factory, root, tasks):
    simulated = list(generate(open_plan(factory, root, "simulate"), tasks, workers=0))
    assert all(r.simulated and r.scenes == 3 and r.times.simulate > 0 for r in simulated)
    assert all(r.times.render == r.times.sample == 0 for r in simulated)
    rendered = list(generate(open_plan(factory, root, "render"), tasks, workers=0))
    assert all(not r.simulated and r.scenes == 3 and r.times.render > 0 for r in rendered)
    assert all(r.times.simulate == 0 for r in rendered)
    for stage in ("simulate", "render"):
        assert list(generate(open_plan(factory, root, stage), tasks, workers=0)) == [None] * 5


def test_rendering_with_another_camera_needs_no_physics_engine(
    factory, plan, tasks, tmp_path, reference, monkeypatch
):
    list(generate(plan, tasks, workers=0))
    monkeypatch.setattr("pnet.scenes.bullet.connect", no_engine)
    near = replace(factory.views.camera, width=80, cx=39.5)
    other = replace(factory, views=replace(factory.views, camera=near), fingerprint="near")
    again = open_plan(other, tmp_path / "again", "render", plan.piles)
    assert all(r is not None and not r.simulated for r in generate(again, tasks, workers=0))
    assert contents(plan.piles) == {
        name.removeprefix("piles/"): data for name, data in part_of(reference, "simulate").items()
    }
    for task in tasks:
        file, first = (CycleFile(cycle_path(root, task)) for root in (again.scenes, plan.scenes))
        assert file.header.camera.width == 80 and file.header.fingerprint == "near"
        for i in range(len(file)):
            np.testing.assert_array_equal(file.scene(i).R, first.scene(i).R)
            np.testing.assert_array_equal(file.scene(i).t, first.scene(i).t)
    with pytest.raises(AssertionError, match="engine was started"):  # the guard guards
        list(generate(open_plan(factory, tmp_path / "new"), tasks[:1], workers=0))


def test_rendering_without_piles_names_the_file_and_the_stage(factory, root, tasks):
    plan = open_plan(factory, root, "render")
    missing = cycle_path(plan.piles, tasks[0])
    message = f"{missing}: no such pile file, and 4 more are missing; run pnet-generate stage=simulate"
    with pytest.raises(FileNotFoundError, match=message):
        list(generate(plan, tasks, workers=0))
    assert set(part_of(contents(root), "render")) == {MANIFEST}


def test_rendering_damaged_piles_names_the_file_and_the_stage(factory, plan, root, tasks):
    list(generate(plan, tasks[:1], workers=0))
    damaged = cycle_path(plan.piles, tasks[0])
    damaged.write_bytes(damaged.read_bytes()[:-1])
    cycle_path(root, tasks[0]).unlink()
    message = rf"{damaged}: not a whole pile file .*delete it and run pnet-generate stage=simulate"
    with pytest.raises(ValueError, match=message):
        list(generate(open_plan(factory, root, "render"), tasks[:1], workers=0))


def test_scenes_stand_without_their_piles(plan, tasks):
    """Piles may be deleted once they are rendered."""
    list(generate(plan, tasks, workers=0))
    shutil.rmtree(plan.piles / "train")
    assert list(generate(plan, tasks, workers=0)) == [None] * 5


def test_an_unknown_stage_is_refused(factory, root):
    with pytest.raises(ValueError, match="stage=both: choose simulate, render, all"):
        Plan(factory, root / "piles", root, "both")


# shares of several machines


def test_three_shards_together_make_the_files_of_one_run(factory, root, tasks, reference):
    found: dict[str, str] = {}
    for shard in ("2/3", "1/3", "3/3"):
        mine = take_share(tasks, shard)
        plan = open_plan(factory, root)
        assert None not in list(generate(plan, mine, workers=0))
        now = contents(root)
        assert found.items() <= now.items() and len(now) > len(found)
        found = now
    assert found == reference


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_shards_part_the_tasks(tasks, count):
    shares = [take_share(tasks, f"{k}/{count}") for k in range(1, count + 1)]
    assert sorted(str(task) for share in shares for task in share) == sorted(map(str, tasks))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert take_share(tasks, None) == tasks


@pytest.mark.parametrize("shard", ["0/3", "4/3", "1", "1/", "/2", "a/b", "-1/2", "1/0", "1/2/3", ""])
def test_a_share_that_makes_no_sense_is_refused(tasks, shard):
    with pytest.raises(ValueError, match=f"shard={shard}: expected a number and a count, from 1/8 to 8/8"):
        take_share(tasks, shard)


def test_an_unfinished_file_of_another_machine_survives(plan, root, tasks, reference):
    """On a shared disk that machine may be writing it; its process id says nothing here."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (root / "train").mkdir()
    foreign = {f".pile.safetensors.elsewhere.{pid}.part": b"half" for pid in (dead.pid, os.getpid())}
    for name, data in foreign.items():
        (root / "train" / name).write_bytes(data)
    list(generate(plan, tasks, workers=0))
    open_root(root, SETTINGS)
    assert contents(root) == {**reference, **{f"train/{name}": brief(data) for name, data in foreign.items()}}


def test_a_left_over_of_a_dead_process_is_removed_and_one_of_a_living_is_kept(plan, root):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = socket.gethostname().split(".")[0]
    for folder in (root / "train", root / "piles" / "train"):
        folder.mkdir()
        for pid in (dead.pid, os.getpid()):
            (folder / f".pile.safetensors.{host}.{pid}.part").write_bytes(b"half")
    open_root(root, SETTINGS)
    left = [name for name in contents(root) if name.endswith(".part")]
    assert sorted(left) == [
        f"{folder}/.pile.safetensors.{host}.{os.getpid()}.part" for folder in ("piles/train", "train")
    ]


# folders and their manifests


def test_other_settings_are_refused_with_their_key(plan, root):
    other = {"seed": 0, "part": {"name": "tn34", "sections": 24}}
    with pytest.raises(
        ValueError, match=r"dataset.json: .*part.sections was 48, now 24.*Choose another data.root"
    ):
        open_root(root, other)
    with pytest.raises(ValueError, match=r"physics was None, now 1; seed was 0, now 3"):
        open_root(root, {**SETTINGS, "seed": 3, "physics": 1})
    open_root(root, SETTINGS)


def test_piles_of_other_settings_are_refused_with_their_folders_key(plan):
    with pytest.raises(
        ValueError, match=r"piles/dataset.json: .*seed was 0, now 3.*Choose another data.piles"
    ):
        open_root(plan.piles, {**SETTINGS, "seed": 3}, "data.piles")


def test_the_manifest_keeps_the_settings(plan, root):
    assert read_manifest(root) == read_manifest(plan.piles) == SETTINGS


def test_a_folder_without_a_manifest_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}/{MANIFEST}: no data set there"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[1]", "3"])
def test_a_damaged_manifest_is_named(plan, root, text):
    (root / MANIFEST).write_text(text)
    with pytest.raises(ValueError, match=f"{MANIFEST}: not .*make the data set anew"):
        read_manifest(root)


def test_the_fingerprint_is_of_the_values_not_of_their_order():
    assert settings_fingerprint({"a": 1, "b": {"c": 2, "d": 3}}) == settings_fingerprint(
        {"b": {"d": 3, "c": 2}, "a": 1}
    )
    assert settings_fingerprint({"a": 1}) != settings_fingerprint({"a": 2})


# disks, errors, interruptions


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only folders")
@pytest.mark.parametrize("stage", ["simulate", "render"])
def test_a_read_only_folder_is_an_error(factory, plan, root, tasks, stage):
    locked = (plan.piles if stage == "simulate" else root) / "train"
    locked.mkdir()
    locked.chmod(0o500)
    with pytest.raises(PermissionError, match=str(locked)):
        list(generate(plan, tasks[-1:], workers=0))


@pytest.mark.parametrize("writes", range(4))
def test_a_full_disk_is_an_error_and_loses_nothing(plan, root, tasks, monkeypatch, reference, writes):
    """It is full after so many files."""
    real, done = os.fsync, []

    def fill(descriptor):
        done.append(descriptor)
        if len(done) > writes:
            disk_full()
        real(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fill)
        with pytest.raises(OSError, match="No space left"):
            list(generate(plan, tasks, workers=0))
    found = contents(root)
    assert len(found) == 2 + writes and found.items() <= reference.items()
    list(generate(plan, tasks, workers=0))
    assert contents(root) == reference


def test_a_file_larger_than_allowed_is_an_error_and_loses_nothing(factory, root, tasks, reference):
    """The system's own limit cuts a file in two."""
    list(generate(open_plan(factory, root, "simulate"), tasks, workers=0))
    plan = open_plan(factory, root, "render")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            list(generate(plan, tasks, workers=0))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert contents(root) == {**part_of(reference, "simulate"), MANIFEST: reference[MANIFEST]}
    list(generate(plan, tasks, workers=0))
    assert contents(root) == reference


def test_an_error_in_a_worker_reaches_the_caller(plan):
    """The part object of the second task does not exist."""
    tasks = [CycleTask("train", "clutter", "L", 0, index) for index in (0, 99)]
    with pytest.raises(ValueError, match="tn34 has no part object 99"):
        list(generate(plan, tasks, workers=1))
    assert wait_until(lambda: not multiprocessing.active_children())


def test_an_interruption_stops_the_workers_and_leaves_whole_files_only(plan, root):
    tasks = [CycleTask("train", "pile", "L", cycle, 5) for cycle in range(200)]
    with pytest.raises(KeyboardInterrupt):
        for count, _ in enumerate(generate(plan, tasks, workers=2)):
            if count == 1:
                raise KeyboardInterrupt
    assert wait_until(lambda: not multiprocessing.active_children())
    files = sorted((root / "train").iterdir())
    assert 2 <= len(files) < 200
    for path in files:
        file = CycleFile(path)
        assert [file.scene(i).id.drop for i in range(len(file))] == [1, 2, 3]
    for path in (plan.piles / "train").iterdir():
        assert len(PileFile(path)) == 3


# processes that are killed


SCRIPT = """
import importlib.util, os, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("test_generation", {here!r})
module = importlib.util.module_from_spec(spec)
sys.modules["test_generation"] = module
spec.loader.exec_module(module)
if __name__ == "__main__":
    module.{call}
"""
LONG = [CycleTask("train", "pile", "L", cycle, 5) for cycle in (0, 1)]
LONG += [CycleTask("train", "clutter", "L", 0, 5)]


def long_plan(root: Path) -> Plan:
    """Cycles of some 0.2 s."""
    from omegaconf import OmegaConf

    from pnet.cli.instantiate import instantiate
    from pnet.scenes.bullet import BulletPhysics
    from pnet.scenes.clutter import Clutter
    from pnet.scenes.noise import NoNoise
    from pnet.scenes.pile import Bin
    from pnet.scenes.pile_factory import PileFactory
    from pnet.scenes.view_factory import ViewFactory
    from pnet.scenes.viewpoints import Viewpoints

    part = instantiate(OmegaConf.load(ROOT / "conf" / "part" / "tn34.yaml"))
    protocol = Protocol("long", 8, 256, {"train": SplitPlan("L", 6)})
    camera = Camera(160, 128, 375.0, 375.0, 79.5, 63.5, near=0.3, far=1.0)
    piles = PileFactory(part, protocol, Bin(0.15, 0.15, 0.15), BulletPhysics(), Clutter(0.6), 0, "long")
    views = ViewFactory(part, camera, Viewpoints(), NoNoise(), protocol.points)
    return open_plan(SceneFactory(piles, views, "long"), root)


def make_long_cycles(root: Path, workers: int = 0, shard: str | None = None) -> None:
    """What the killed process runs."""
    for report in generate(long_plan(root), take_share(LONG, shard), workers):
        print(report is not None, flush=True)


def serve() -> None:
    """Start a generation in a fork of this process for every line: no imports to wait for.

    A line is a folder and how the generation ends: after how many calls of which step of writing it kills
    itself, or -1, and then writing is slow so that a random moment often meets it.
    """
    for line in sys.stdin:
        folder, step, calls = line.split()
        pid = os.fork()
        if pid == 0:
            disturb(step, int(calls))
            make_long_cycles(Path(folder))
            os._exit(0)
        print(f"started {pid}", flush=True)
        os.waitpid(pid, 0)
        print("ended", flush=True)


def disturb(step: str, calls: int) -> None:
    """Let a step of writing kill this process at a call, or be slow."""
    real, left = getattr(os, step), [calls]

    def die(*arguments):
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left[0] -= 1
        if calls < 0:
            time.sleep(0.05)
        return real(*arguments)

    setattr(os, step, die)


def start_python(call: str) -> subprocess.Popen[str]:
    """One of this file's functions in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT.format(here=__file__, call=call)],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        text=True,
    )


Victim = Callable[..., None]


@pytest.fixture(scope="module")
def generate_and_die() -> Iterator[Victim]:
    """Starts a generation that is killed after some seconds, or by itself at a step of writing."""
    server = start_python("serve()")

    def go(folder: Path, seconds: float | None = None, step: str = "fsync", calls: int = -1) -> None:
        server.stdin.write(f"{folder} {step} {calls}\n")
        server.stdin.flush()
        pid = int(next(line for line in server.stdout if line.startswith("started")).split()[1])
        if seconds is not None:
            time.sleep(seconds)
            os.kill(pid, signal.SIGKILL)  # one that ended is not yet collected, or was this moment
        assert any(line == "ended\n" for line in server.stdout)

    yield go
    server.stdin.close()
    server.wait(10)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, str]:
    """The undisturbed set."""
    folder = tmp_path_factory.mktemp("whole")
    make_long_cycles(folder)
    files = contents(folder)
    assert len(files) == 8
    return files


def finished(folder: Path) -> dict[str, str]:
    """The files under their final names."""
    return {name: data for name, data in contents(folder).items() if not name.endswith(".part")}


def test_a_generation_killed_at_any_moment_goes_on_to_the_same_bytes(tmp_path, generate_and_die, whole):
    """In a new folder where one is finished before its next moment comes."""
    chance, start = random.Random(0), time.monotonic()
    generate_and_die(tmp_path / "undisturbed")
    seconds = time.monotonic() - start
    assert contents(tmp_path / "undisturbed") == whole
    folders = [tmp_path / "killed_0"]
    for _ in range(KILLS):
        generate_and_die(folders[-1], chance.uniform(0, seconds / 2))
        assert finished(folders[-1]).items() <= whole.items()
        if finished(folders[-1]) == whole:
            folders.append(tmp_path / f"killed_{len(folders)}")
    for folder in folders:
        make_long_cycles(folder)
        assert contents(folder) == whole


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_generation_killed_while_it_writes_goes_on_to_the_same_bytes(
    tmp_path, generate_and_die, whole, step
):
    """Each time one file later: two manifests, then piles and scenes in turn."""
    generate_and_die(tmp_path, step=step, calls=0)
    for done in range(4):
        half = [name for name in contents(tmp_path) if name.endswith(".part")]
        assert len(half) == 1 and finished(tmp_path).items() <= whole.items()
        assert len(finished(tmp_path)) == done
        generate_and_die(tmp_path, step=step, calls=1)
    make_long_cycles(tmp_path)
    assert contents(tmp_path) == whole


def test_two_shards_in_processes_at_once_make_the_files_of_one_run(tmp_path, whole):
    processes = [start_python(f"make_long_cycles(Path({str(tmp_path)!r}), 0, '{k}/2')") for k in (1, 2)]
    assert [process.communicate(timeout=60)[0] for process in processes] == ["True\n" * 2, "True\n"]
    assert contents(tmp_path) == whole


@pytest.mark.skipif(not list(Path("/proc/self/task").glob("*/children")), reason="reads Linux's /proc")
def test_workers_end_when_their_parent_is_killed_and_another_goes_on(tmp_path, whole):
    process = start_python(f"make_long_cycles(Path({str(tmp_path)!r}), 2)")
    assert process.stdout.readline() == "True\n"
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    workers = [int(pid) for pid in children.read_text().split()]
    assert len(workers) >= 2
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert wait_until(lambda: not any(is_alive(pid) for pid in workers))
    make_long_cycles(tmp_path)
    assert contents(tmp_path) == whole
