"""Commands in this process, and one small run that several files look at."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

import pnet
from pnet.cli.app import config_dir


class Outcome(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line of an error; everything else on stderr is a fault."""
        lines = self.err.strip().splitlines()
        assert len(lines) == 1 and self.code == 1, self
        assert lines[0].startswith("error: "), self
        return lines[0].removeprefix("error: ")


def environment() -> dict[str, str]:
    """This process's, with the package that is tested here in front."""
    paths = [str(Path(pnet.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def python_code(command: str) -> str:
    return f"import sys; sys.argv[0] = 'pnet-{command}'; from pnet.cli.{command} import main; main()"


@pytest.fixture(scope="session")
def start() -> Callable[..., "subprocess.Popen[str]"]:
    """Starts a command as a process of its own; Ctrl-C reaches it also where tests run in the background."""

    def go(folder: Path, command: str, *arguments: str) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [sys.executable, "-c", python_code(command), *arguments],
            cwd=folder,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )

    return go


@pytest.fixture(scope="session")
def run_process(start) -> Callable[..., Outcome]:
    """Runs a command as a process of its own."""

    def go(folder: Path, command: str, *arguments: str) -> Outcome:
        process = start(folder, command, *arguments)
        out, err = process.communicate(timeout=240)
        return Outcome(process.returncode, out, err)

    return go


@pytest.fixture
def run_here(monkeypatch, capfd) -> Callable[..., Outcome]:
    """Runs a command in this process: no start-up to wait for."""
    from importlib import import_module

    def go(folder: Path, command: str, *arguments: str) -> Outcome:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", [f"pnet-{command}", *arguments])
        capfd.readouterr()
        code: object = 0
        try:
            import_module(f"pnet.cli.{command}").main()
        except SystemExit as end:
            code = end.code or 0
        out, err = capfd.readouterr()
        assert isinstance(code, int)
        return Outcome(code, out, err)

    return go


class SmokeRun(NamedTuple):
    """Outputs of the whole job at protocol=smoke."""

    folder: Path
    outcomes: dict[str, Outcome]

    @property
    def data(self) -> Path:
        return self.folder / "outputs" / "data" / "tn34_smoke"

    @property
    def run(self) -> Path:
        return self.folder / "outputs" / "run"


SMOKE = ("protocol=smoke", "camera.width=160", "camera.height=128", "camera.fx=375", "camera.fy=375",
         "camera.cx=79.5", "camera.cy=63.5")  # fmt: skip
JOB: Sequence[tuple[str, ...]] = (
    ("generate", *SMOKE, "workers=0"),
    ("train", "protocol=smoke", "trainer.threads=1", "run_dir=outputs/run"),
    ("evaluate", "run=outputs/run", "threads=1"),
    ("report", "run=outputs/run"),
)


@pytest.fixture(scope="session")
def smoke(bullet, tmp_path_factory, run_process) -> SmokeRun:
    """The four commands, one after the other."""
    folder = tmp_path_factory.mktemp("job")
    outcomes = {}
    for command, *arguments in JOB:
        outcomes[command] = run_process(folder, command, *arguments)
        assert outcomes[command].code == 0, outcomes[command]
    return SmokeRun(folder, outcomes)


@pytest.fixture
def smoke_copy(smoke, tmp_path) -> SmokeRun:
    """A copy to spoil."""
    import shutil

    shutil.copytree(smoke.folder, tmp_path / "job")
    return SmokeRun(tmp_path / "job", smoke.outcomes)


@pytest.fixture
def hydra_app(tmp_path, monkeypatch):
    """As inside a command: composing works, and the working directory is empty."""
    monkeypatch.chdir(tmp_path)
    GlobalHydra.instance().clear()
    outer = HydraConfig.instance().cfg
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        yield
    HydraConfig.instance().cfg = outer
