"""What a run stood on: enough to repeat it."""

import json
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from pnet.scenes.record_file import write_atomically

PACKAGES = (
    "pnet",
    "torch",
    "lightning",
    "hydra-core",
    "omegaconf",
    "numpy",
    "scipy",
    "scikit-learn",
    "small_gicp",
    "trimesh",
    "manifold3d",
    "embreex",
    "pybullet",
    "numba",
    "roma",
    "safetensors",
)


def provenance(seed: int) -> dict[str, Any]:
    """Seed, git commit, versions and machine, as plain values."""
    return {
        "seed": seed,
        "git": git_state(Path(__file__).parent),
        "python": platform.python_version(),
        "packages": package_versions(),
        "machine": f"{platform.system()} {platform.machine()}",
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
        "threads": torch.get_num_threads(),
    }


def commit_text(git: dict[str, Any]) -> str:
    """A commit for people: its beginning, and whether files were changed since."""
    return str(git.get("commit", "unknown"))[:7] + ("+changes" if git.get("changed") else "")


def package_versions(names: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Installed versions, of what a result depends on; "absent" where one is missing."""
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def git_state(folder: Path) -> dict[str, Any]:
    """Commit and whether files were changed since; "unknown" outside a checkout."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=10)
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        commit = git("rev-parse", "HEAD")
        changed = bool(git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.TimeoutExpired):
        commit, changed = "", False
    return {"commit": commit or "unknown", "changed": changed}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write plain values; the file appears when it is whole. NaN becomes null."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_plain(content), indent=1, sort_keys=True, allow_nan=False)
    write_atomically(path, (text + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Read what `write_json` wrote.

    Raises:
        FileNotFoundError, ValueError: names the file.
    """
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as fault:
        raise ValueError(f"{path}: not readable as JSON ({fault})") from fault
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object")
    return content


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and value != value:
        return None
    return value
