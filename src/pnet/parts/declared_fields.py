"""Fields of a declared part that need no solid: keypoints and their lookalikes, symmetry and mirror, and
checks that name what is wrong."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    Symmetry,
    cyclic,
    dihedral,
    reflection,
)
from pnet.parts.keypoints import Exchange
from pnet.parts.primitives import Circle, Corner, Cylinder, Direction, Plane, Polygon, Primitive, Sphere, unit
from pnet.parts.selection import Keypoint

Fields = Mapping[str, Any]
MOST_TURNS = 48  # beyond it a part is a revolution for any camera
# primitive → fields that it takes beside from, measures, factor
PRIMITIVES = {
    "plane": {"at"},
    "cylinder": {"towards"},
    "circle": {"towards"},
    "sphere": set[str](),
    "polygon": {"towards", "sides"},
    "corner": set[str](),
}


def keypoint_from(name: str, fields: Fields) -> Keypoint:
    """A keypoint out of its fields; see `DeclaredPart`."""
    where = f"keypoints.{name}"
    words = list(fields) if isinstance(fields, Mapping) else []
    kinds = [word for word in words if word in PRIMITIVES]
    if len(kinds) != 1:
        hints = (
            closest(str(word), PRIMITIVES) for word in words if word not in ("from", "measures", "factor")
        )
        raise ValueError(
            f"{where} is {fields}, expected exactly one of {', '.join(PRIMITIVES)}"
            f"{next(filter(None, hints), '')}"
        )
    kind = kinds[0]
    known = {kind, "from", "measures", "factor", *PRIMITIVES[kind]}
    for word in set(fields) - known:
        raise ValueError(f"{where}: a {kind} takes no field {word!r}{closest(word, sorted(known))}")
    if not isinstance(fields.get("from"), str):
        raise ValueError(f"{where}: say with from: where its distance starts (centroid or another keypoint)")
    factor = fields.get("factor", 1.0)
    if isinstance(factor, bool) or not isinstance(factor, int | float):
        raise ValueError(f"{where}: factor is {factor!r}, expected a number")
    primitive = _primitive(where, kind, fields)
    return Keypoint(name, fields["from"], primitive, fields.get("measures"), float(factor))


def _primitive(where: str, kind: str, fields: Fields) -> Primitive:
    if kind == "corner":
        check_shape(f"{where}.corner", (3,), fields[kind])
        x, y, z = fields[kind]
        return Corner((x, y, z))
    if kind == "sphere":
        return Sphere()
    direction = _direction(f"{where}.{kind}", fields[kind])
    towards = None if fields.get("towards") is None else _direction(f"{where}.towards", fields["towards"])
    try:
        match kind:
            case "plane":
                if fields.get("at") is not None:
                    check_shape(f"{where}.at", (), fields["at"])
                primitive: Primitive = Plane(direction, fields.get("at"))
            case "cylinder":
                primitive = Cylinder(direction, towards)
            case "circle":
                primitive = Circle(direction, towards)
            case _:
                check_shape(f"{where}.sides", "sides", fields.get("sides"))
                primitive = Polygon(fields["sides"], direction, towards)
        primitive.direction  # noqa: B018  refuses what is no direction
    except ValueError as fault:
        raise ValueError(f"{where}: {str(fault).removeprefix(f'{where}: ')}") from fault
    return primitive


def _direction(where: str, value: Any) -> Direction:
    if isinstance(value, str):
        return value
    if isinstance(value, Sequence) and len(value) == 3 and all(isinstance(x, int | float) for x in value):
        x, y, z = (float(x) for x in value)
        return x, y, z
    raise ValueError(f"{where} is {value!r}, expected x, y, z, -x, -y, -z or three numbers")


def symmetry_from(value: str | Fields) -> Symmetry:
    """A symmetry group out of its name; see `DeclaredPart`."""
    named: dict[str, Symmetry] = {
        "none": cyclic(1),
        "revolution": RevolutionSymmetry(),
        "revolution_equal_ends": RevolutionSymmetry(rotoreflection=True),
        "sphere": SphericalSymmetry(),
    }
    choices = [*named, "{cyclic: n}", "{dihedral: n}" + f" (n up to {MOST_TURNS})", "{rotations: [matrices]}"]
    if isinstance(value, str) and value in named:
        return named[value]
    match value:
        case {"cyclic": int(n), **others} if 1 <= n <= MOST_TURNS and not others:
            return cyclic(n)
        case {"dihedral": int(n), **others} if 1 <= n <= MOST_TURNS and not others:
            return dihedral(n)
        case {"rotations": rotations, **others} if not others:
            try:
                matrices = torch.tensor(rotations, dtype=torch.float64)
            except (TypeError, ValueError) as fault:
                raise ValueError(f"symmetry.rotations is no list of 3 × 3 matrices ({fault})") from fault
            return FiniteSymmetry(matrices)
    raise ValueError(f"symmetry is {value!r}, choose {', '.join(choices)}")


def mirror_from(normal: str | None) -> torch.Tensor | None:
    """The reflection in the plane with this normal."""
    return None if normal is None else reflection(tuple(unit(_direction("mirror", normal)).tolist()))


def lookalikes_from(value: Sequence[Sequence[Sequence[str]]]) -> tuple[Exchange, ...]:
    """Exchanges of keypoints out of lists of pairs of names; see `DeclaredPart`."""
    check_kind(Sequence, "a list of exchanges, each a list of pairs of keypoints", lookalikes=value)
    return tuple(_exchange(f"lookalikes[{i}]", pairs) for i, pairs in enumerate(value))


def _exchange(where: str, pairs: Sequence[Sequence[str]]) -> Exchange:
    check_kind(Sequence, "a list of pairs of keypoints such as [[foot, toe], [head, tip]]", **{where: pairs})
    found = []
    for i, pair in enumerate(pairs):
        check_kind(Sequence, "a pair of keypoints such as [foot, toe]", **{f"{where}[{i}]": pair})
        if len(pair) != 2 or not all(isinstance(name, str) for name in pair):
            raise ValueError(f"{where}[{i}] is {pair!r}, expected the names of two keypoints")
        found.append((pair[0], pair[1]))
    return tuple(found)


def check_kind(kind: type, words: str, **fields: Any) -> None:
    """Raise ValueError that names the first field of another kind; a text counts as no list."""
    for key, value in fields.items():
        if isinstance(value, str) or not isinstance(value, kind):
            raise ValueError(f"{key} is {value!r}, expected {words}")


def check_shape(where: str, form: tuple[int, ...] | str, value: Any) -> None:
    """A field holds one expression (), several (n,), points (−1, 2) or a whole number "sides"."""
    if form == "sides":
        if not isinstance(value, int) or isinstance(value, bool) or value < 3:
            raise ValueError(f"{where} is {value!r}, expected a whole number of at least 3")
        return
    assert not isinstance(form, str)
    if not form:
        if isinstance(value, bool) or not isinstance(value, (str, int, float)):
            raise ValueError(f"{where} is {value!r}, expected a number or an expression in mm")
        return
    count, least = form[0], 3
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    if not is_list or (len(value) < least if count == -1 else len(value) != count):
        raise ValueError(
            f"{where} is {value!r}, expected a list of {count if count > 0 else f'at least {least}'}"
        )
    for i, item in enumerate(value):
        check_shape(f"{where}[{i}]", form[1:], item)


def closest(word: str, known: Sequence[str] | Mapping[str, Any]) -> str:
    """A hint at the known word that resembles most; empty where none does."""
    found = difflib.get_close_matches(word, list(known), n=1)
    return f", did you mean {found[0]}?" if found else ""
