"""The data set of a training, made where it is missing; and the settings of a run that is repeated."""

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pnet.cli.app import config_flags, hydra_value, key_of
from pnet.cli.settings import METRICS, RESOLVED, read_run
from pnet.engine.locks import NO_WAIT


def repeated(cfg: DictConfig) -> DictConfig:
    """The settings of the run `repeat`, into another folder, with as many threads as it had."""
    from pnet.engine.provenance import git_state, read_json

    old = Path(cfg.repeat)
    again = read_run(old).copy()
    if "views" not in again:
        raise ValueError(f"{old / RESOLVED}: written by an older pnet, train again")
    state = read_json(old / "provenance.json")
    commit = git_state(Path(__file__).parent)["commit"]
    if state["git"]["commit"] != commit:
        print(
            f"{old} was trained with commit {state['git']['commit'][:7]}, this is {commit[:7]}",
            file=sys.stderr,
        )
    given = [key_of(word) for word in HydraConfig.get().overrides.task]
    for key in given:
        if key not in ("repeat", "run_dir", "ckpt"):
            raise ValueError(f"{key} has no say beside repeat={old}, which takes all settings from that run")
    again.run_dir = cfg.run_dir if "run_dir" in given else f"{str(old).rstrip('/')}_again"
    again.ckpt, again.repeat = cfg.ckpt, cfg.repeat
    again.trainer.threads = state["threads"]
    done = read_json(old / METRICS).get("evaluations", {}).values()
    again.evaluate = [{key: one[key] for key in ("split", "postprocess")} for one in done]
    return again


def make_data_again(cfg: DictConfig) -> None:
    """Have the data of the run `repeat` made where it is gone; other data in its place is an error."""
    from pnet.cli.build import open_source
    from pnet.scenes.manifest import MANIFEST, read_manifest
    from pnet.scenes.record_file import SUFFIX

    root, wanted = Path(cfg.data.root), read_manifest(Path(cfg.repeat))
    if cfg.data.get("source") is not None:
        if open_source(cfg.data).manifest() != wanted:
            raise ValueError(f"{root}: is not as it was when {cfg.repeat} was trained on it")
        return
    if (root / MANIFEST).exists() and read_manifest(root) != wanted:
        raise ValueError(
            f"{root}: holds other data than {cfg.repeat} was trained on; move it away and try again"
        )
    files = wanted.get("files", {})
    if any(len(list((root / split).glob(f"[!.]*{SUFFIX}"))) < count for split, count in files.items()):
        like = hydra_value(str(Path(cfg.repeat) / MANIFEST))
        run_generate([f"like={like}", f"data.root={hydra_value(str(root))}"], root)


def make_data(cfg: DictConfig) -> None:
    """Have pnet-generate make what is missing of the data set, in a process of its own."""
    from pnet.cli.generate import is_complete

    if cfg.data.source is not None:
        raise ValueError("data.generate makes scenes of pnet's own: it needs data=stored")
    overrides = data_overrides(HydraConfig.get().overrides.task, cfg.data.root, cfg.data.generate)
    if not is_complete(compose("generate", overrides=overrides)):
        run_generate(overrides, cfg.data.root)


def data_overrides(words: Iterable[str], root: str, generate: Iterable[str]) -> list[str]:
    """Of pnet-train's overrides those that pnet-generate takes as well, and its own."""
    groups = ("part", "protocol")
    kept = [word for word in words if key_of(word).split(".")[0].split("@")[0] in groups]
    return [*kept, f"data.root={hydra_value(root)}", *generate]


def run_generate(overrides: list[str], root: Path) -> None:
    """pnet-generate in a process of its own; its output stays where this one's goes."""
    # a run may be put off while another process works on it, its data has to be waited for
    environment = {key: value for key, value in os.environ.items() if key != NO_WAIT}
    command = [sys.executable, "-m", "pnet.cli.generate", *config_flags(sys.argv[1:]), *overrides]
    done = subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True)
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise ValueError(f"{root}: the scenes could not be made: {reason.removeprefix('error: ')}")
    print(done.stderr, end="", file=sys.stderr)
