"""The runs that are there: their settings and metrics, read from their folders."""

import json
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from pnet.cli.settings import METRICS, RESOLVED, training_settings

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # in C where it was built so: a sweep reads many


class RunIndex:
    """The runs below a folder, by their settings; those of another version, or damaged, are left out.

    Attributes:
        settings: what the training of each run depended on. postprocess: of each run.
    """

    def __init__(self, folder: Path) -> None:
        self.postprocess: dict[Path, dict[str, Any]] = {}
        self.settings: dict[Path, dict[str, Any]] = {}
        for path in sorted(folder.glob(f"*/{RESOLVED}")):
            found = read_resolved(path.parent)
            if found is not None:
                self.settings[path.parent], self.postprocess[path.parent] = found

    def find(self, settings: dict[str, Any]) -> Path | None:
        """The run with these settings."""
        return next(iter(self.matching(settings, any_seed=False)), None)

    def matching(self, settings: dict[str, Any], any_seed: bool) -> list[Path]:
        """The runs with these settings, whatever their seed or with this one; of equal ones the first that
        has ended, else the first."""
        free = {"seed": None} if any_seed else {}
        equal = [run for run, own in self.settings.items() if {**own, **free} == {**settings, **free}]
        found: dict[int, Path] = {}
        for run in sorted(equal, key=lambda run: read_metrics(run) is None):
            found.setdefault(self.settings[run]["seed"], run)
        return list(found.values())


def read_resolved(run: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """What a run's training depended on, and its post-processing; None where there is no whole one of this
    version."""
    try:
        content = yaml.load((run / RESOLVED).read_text(), LOADER)
        return training_settings(content), content["postprocess"]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return None


def read_json_object(path: Path) -> dict[str, Any] | None:
    """A JSON file's object; None where it is not there or damaged."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def read_metrics(run: Path) -> dict[str, Any] | None:
    """A run's metrics.json with its `steps` and `evaluations`; None where it is not there or damaged."""
    content = read_json_object(run / METRICS) or {}
    try:
        return {**content, "steps": int(content["steps"]), "evaluations": {**content.get("evaluations", {})}}
    except (ValueError, KeyError, TypeError):
        return None
