"""What a model card says of the scenes that a network learnt from, out of its bundle's notes.

`about` is what a bundle tells of its training; keys that it lacks make no text.
"""

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

from pnet.geometry.camera import Camera
from pnet.reporting.data_tables import settings_sheet
from pnet.reporting.prediction_page import camera_text

Settings = Mapping[str, Any]


def data_rows(about: Settings, part: str) -> list[tuple[str, str | None]]:
    """Facts on the training's scenes, None where nobody knows one. part: the template's name."""
    data, plan = about.get("data", {}), plan_of(about, part)
    told, camera = _told(data), camera_of(about)
    counts = scene_counts(about, part)
    return [
        ("made by", "pnet-generate" if is_synthetic(about) else data.get("source")),
        ("converted from", told.get("converted")),
        ("protocol", plan.get("name")),
        ("scenes", ", ".join(f"{split} {count:,}" for split, count in counts.items())),
        ("clutter", _clutter_text(about, plan)),
        ("bodies in a scene", f"up to {plan['drop_limit']}" if "drop_limit" in plan else None),
        ("bin", bin_text(data["bin"]) if data.get("bin") else None),
        ("physics", told.get("physics")),
        ("camera", camera_text(camera) if camera else None),
        ("camera's place", view_text(about)),
        ("field of view", field_text(about)),
        ("sensor noise", noise_text(about)),
        ("seed", told.get("seed")),
    ]


def data_limits(about: Settings, part: str) -> Iterator[str]:
    """What the training's scenes did not show."""
    data, plan = about.get("data", {}), plan_of(about, part)
    if is_synthetic(about):
        yield "The training's scenes are synthetic; no real image was among them."
        yield "They show the parts alone, without bin and floor: take the background away (`background=`)."
    if noise_text(about) == "none":
        yield "They have no sensor noise and no missing pixels."
    if (view := view_text(about)) is not None and camera_of(about) is not None:
        where = f"{view}, {field_text(about)}"
        yield f"Their view: {where}. Other distances, angles and resolutions were not seen."
    if data.get("bin") and "drop_limit" in plan:
        count, tray = plan["drop_limit"], bin_text(data["bin"])
        yield f"Their piles: up to {count} bodies of one size in a bin of {tray}."


def learnt_sizes(about: Settings, part: str, grid: int) -> str:
    """How many part objects of the grid L were in the training. grid: how many it has."""
    plan, share = plan_of(about, part), about.get("training", {}).get("data.learn", 1)
    if "splits" not in plan or grid == 1:
        return ""
    train = plan["splits"]["train"]
    chosen = range(grid) if train.get("objects") is None else train["objects"]
    count = len({int(place * grid) if isinstance(place, float) else place for place in chosen})
    if train.get("count") is not None:
        count = min(train["count"], grid)
    if Fraction(str(share)) < 1:
        count = max(1, round(float(Fraction(str(share))) * count))
    return f"Of the {grid} part objects in grid L {count} were in the training."


def plan_of(about: Settings, part: str) -> dict[str, Any]:
    """The protocol's settings, for the template."""
    plan = dict(about.get("data", {}).get("protocol") or {})
    own = plan.pop("by_part", None) or {}
    return {**plan, **own.get(part, {})}


def scene_counts(about: Settings, part: str) -> dict[str, int]:
    """Scenes of each split, training first."""
    data, plan = about.get("data", {}), plan_of(about, part)
    counts = dict(data.get("scenes") or {})
    if "files" in data and "drop_limit" in plan:
        each = len(range(plan["drop_limit"], 0, -plan.get("drop_step", 1)))
        counts = {split: each * files for split, files in data["files"].items()}
    order = ("train", "val", "test_l", "test_g")
    return {split: counts[split] for split in order if split in counts}


def is_synthetic(about: Settings) -> bool:
    """Whether pnet made the scenes, by physics."""
    return bool(about.get("data", {}).get("physics"))


def camera_of(about: Settings) -> Camera | None:
    """The camera of the training's scenes."""
    camera = about.get("data", {}).get("camera")
    return Camera(**{key: value for key, value in camera.items() if key != "_target_"}) if camera else None


def class_name(settings: Any) -> str | None:
    """The class that settings name."""
    return str(settings["_target_"]).rpartition(".")[2] if settings else None


def bin_text(tray: Settings) -> str:
    """Inner size of a bin."""
    width, depth, height = (f"{1000 * tray[key]:g}" for key in ("width", "depth", "height"))
    return f"{width} × {depth} mm, {height} mm high"


def view_text(about: Settings) -> str | None:
    """From where the training's scenes are seen."""
    place, anew = _place(about)
    if not place:
        return None
    words = [f"{_span(place['distance'])} m from the middle of the bin's floor"]
    oblique = max(place["tilt"]) > 0
    words.append(f"{_span(place['tilt'])}° from the vertical" if oblique else "straight above it")
    words += ["turned at random"] if place.get("turn") else []
    return ", ".join([*words, *(["drawn anew for every pile and epoch"] if anew else [])])


def field_text(about: Settings) -> str | None:
    """What the camera sees of the floor from the nearest of its places, and how fine."""
    place, camera = _place(about)[0], camera_of(about)
    if not place or camera is None:
        return None
    near = min(place["distance"])
    width, height = near * camera.width / camera.fx, near * camera.height / camera.fy
    field, pixel = f"{1000 * width:.0f} × {1000 * height:.0f} mm", 1000 * near / camera.fx
    return f"{field} at {near:g} m, {pixel:.2g} mm a pixel"


def _place(about: Settings) -> tuple[Settings | None, bool]:
    """Where the camera stands, and whether that is drawn anew when a scene is read."""
    views = about.get("training", {}).get("views") or {}
    return (views, True) if "distance" in views else (about.get("data", {}).get("view"), False)


def noise_text(about: Settings) -> str | None:
    """The sensor noise of the training's scenes: stored in them, and added when they were read."""
    data, added = about.get("data", {}), about.get("training", {}).get("noise")
    if not data.get("noise"):
        return None
    stored = data["noise"] if "train" in data.get("noise_in", ["train"]) else None
    words = [
        f"{_told({'noise': noise})['noise']} {when}"
        for noise, when in ((stored, "in the scenes"), (added, "added when a scene is read"))
        if noise and class_name(noise) != "NoNoise"
    ]
    return "; ".join(words) or "none"


def _clutter_text(about: Settings, plan: Settings) -> str | None:
    """The share of clutter among the training's scenes."""
    drawn = about.get("training", {}).get("data.clutter")
    share = drawn if drawn is not None else plan.get("splits", {}).get("train", {}).get("clutter")
    if share is None:
        return None
    percent = 100 * float(Fraction(str(share)))
    return f"{percent:.3g} % of the training's scenes: bodies at random orientations, without physics"


def _told(settings: Settings) -> dict[str, str]:
    """Settings of a manifest as text, by key."""
    return {name: text for name, text in settings_sheet(settings).rows}


def _span(values: Any) -> str:
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
