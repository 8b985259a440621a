"""A data set's manifest: the settings that made it. Light, so that commands can look at many."""

import json
from collections.abc import Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

MANIFEST = "dataset.json"
REMEDY = "run pnet-generate with the same part and protocol first"


def settings_fingerprint(settings: Mapping[str, Any]) -> str:
    """Digest of plain settings; equal settings give equal digests."""
    return sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def read_manifest(root: Path, remedy: str = REMEDY) -> dict[str, Any]:
    """The settings that made a data set. remedy: what to do where there is none."""
    manifest = root / MANIFEST
    try:
        settings = json.loads(manifest.read_text())
    except FileNotFoundError:
        raise FileNotFoundError(f"{manifest}: no data set there; {remedy}") from None
    except json.JSONDecodeError as fault:
        raise ValueError(f"{manifest}: not readable ({fault}); make the data set anew") from fault
    if not isinstance(settings, dict):
        raise ValueError(f"{manifest}: not a data set's manifest; make the data set anew")
    return settings


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """Where two nested settings differ, as "key was 1, now 2"."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in {*old, *new}:
            yield from differences(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
    elif old != new:
        yield f"{path} was {old!r}, now {new!r}"
