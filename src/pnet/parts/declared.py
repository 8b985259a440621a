"""A part without Python: primitives stacked in a config, parameters and keypoints declared beside them.

See docs/parts.md for the tutorial, conf/part/knob.yaml for an example. Lengths in expressions are
millimetres.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    Symmetry,
    cyclic,
    dihedral,
    reflection,
)
from pnet.parts.base import Grid, ParametricPart
from pnet.parts.expressions import Expression, check_condition, check_expression, holds, length
from pnet.parts.keypoints import Keypoint
from pnet.parts.primitives import Circle, Corner, Cylinder, Direction, Plane, Polygon, Primitive, Sphere, unit
from pnet.parts.solids import (
    Ball,
    Extrusion,
    Operation,
    Revolution,
    Shape,
    Solid,
    box,
    cone,
    cylinder,
    moved,
    outline,
    polygon,
)

Points = NDArray[np.float64]
Fields = Mapping[str, Any]
Length = Callable[[Expression], Points]  # an expression's value for the parameters at hand, metres


class DeclaredPart(ParametricPart):
    """A template out of a config file.

    Args:
        name: the template's name. parameters: their names in order.
        solid: steps one after another, each `{add|cut|hole: SHAPE, …sizes…}`; see `SHAPES`.
        keypoints: name → `{from: REFERENCE, PRIMITIVE: DIRECTION, measures: PARAMETER, factor: NUMBER, at:
            PLACE}`.
        symmetry: "none", "revolution", "revolution_equal_ends", "sphere", {cyclic: n}, {dihedral: n} or
            {rotations: [matrices]}. mirror: normal of a mirror plane through the centroid ("x", "y", …), or
            None.
        require: comparisons that valid parameters satisfy, such as "d > 2 * r".
        learning, generalization, sections, closed_form_centroid: see `ParametricPart`.
    """

    def __init__(
        self,
        name: str,
        parameters: Sequence[str],
        solid: Sequence[Fields],
        keypoints: Mapping[str, Fields],
        learning: Grid,
        generalization: Grid | None = None,
        symmetry: str | Fields = "none",
        mirror: str | None = None,
        require: Sequence[str] = (),
        sections: int = 48,
        closed_form_centroid: bool | None = None,
    ) -> None:
        self.closed_form_centroid = closed_form_centroid
        self.name = name
        try:
            check_kind(Sequence, "a list", parameters=parameters, solid=solid)
            check_kind(Mapping, "a mapping", keypoints=keypoints)
            self.parameter_names = tuple(parameters)
            if not solid:
                raise ValueError("the solid has no step: begin with {add: cylinder, …}")
            self._steps = [_Step(i, fields) for i, fields in enumerate(solid)]
            conditions = [require] if isinstance(require, str) else require
            check_kind(Sequence, "a list of comparisons", require=conditions)
            self._require = [str(condition) for condition in conditions]
            for i, step in enumerate(self._steps):
                for expression in step.expressions():
                    _named(f"solid[{i}]", check_expression, expression, self.parameter_names)
            for condition in self._require:
                _named("require", check_condition, condition, self.parameter_names)
            self.keypoints = tuple(keypoint_from(key, fields) for key, fields in keypoints.items())
            self.symmetry = symmetry_from(symmetry)
            self.mirror = mirror_from(mirror)
        except ValueError as fault:
            raise ValueError(f"{name}: {fault}") from fault
        super().__init__(learning, generalization, sections)

    def check(self, parameters: Points) -> None:
        """Every `require` must hold."""
        for condition in self._require:
            if not bool(holds(condition, self.parameter_names, parameters)):
                raise ValueError(f"{self.name}: {condition} does not hold for {self.text(parameters)}")

    def solid(self, parameters: Points) -> Solid:
        """The steps, evaluated."""

        def value(expression: Expression) -> Points:
            return length(expression, self.parameter_names, np.asarray(parameters, float))

        return Solid(tuple((step.operation, step.shape(value)) for step in self._steps))


def check_kind(kind: type, words: str, **fields: Any) -> None:
    """Raise ValueError that names the first field of another kind; a text counts as no list."""
    for key, value in fields.items():
        if isinstance(value, str) or not isinstance(value, kind):
            raise ValueError(f"{key} is {value!r}, expected {words}")


def _named(where: str, check: Callable[[Any, Sequence[str]], None], text: Any, names: Sequence[str]) -> None:
    """A check whose error names where the text stands."""
    try:
        check(text, names)
    except ValueError as fault:
        raise ValueError(f"{where}: {fault}") from fault


class _Step:
    """One entry of `solid`: an operation, a shape's name, and its fields."""

    def __init__(self, index: int, fields: Fields) -> None:
        where = f"solid[{index}]"
        operations = [key for key in fields if key in list(Operation)] if isinstance(fields, Mapping) else []
        if len(operations) != 1:
            raise ValueError(f"{where} is {fields}, expected exactly one of add, cut, hole")
        self.operation, kind = Operation(operations[0]), fields[operations[0]]
        if index == 0 and self.operation is not Operation.ADD:
            raise ValueError(f"{where}: the first step must add something")
        if kind not in SHAPES:
            raise ValueError(
                f"{where}: no shape {kind!r}{_closest(str(kind), SHAPES)}; there are {', '.join(SHAPES)}"
            )
        self._build, wanted = SHAPES[kind]
        given = {key: value for key, value in fields.items() if key != operations[0]}
        self._axis, self._at = given.pop("axis", "z"), given.pop("at", (0, 0, 0))
        if set(given) != set(wanted):
            raise ValueError(
                f"{where}: a {kind} takes {', '.join(wanted)} (and axis, at), "
                f"got {', '.join(sorted(given)) or 'none'}"
            )
        if self._axis not in ("x", "y", "z"):
            raise ValueError(f"{where}: axis is {self._axis!r}, choose x, y or z")
        _check_shape(f"{where}.at", (3,), self._at)
        for key, form in wanted.items():
            _check_shape(f"{where}.{key}", form, given[key])
        self._fields = given

    def expressions(self) -> list[Expression]:
        """All lengths of the step, to be checked early."""
        return list(_leaves([self._at, *(value for key, value in self._fields.items() if key != "sides")]))

    def shape(self, value: Length) -> Shape:
        """The placed shape for the parameters behind `value`."""
        return moved(self._build(value, **self._fields), self._axis, tuple(value(x) for x in self._at))


def _check_shape(where: str, form: tuple[int, ...] | str, value: Any) -> None:
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
        _check_shape(f"{where}[{i}]", form[1:], item)


def _leaves(value: Any) -> Iterator[Expression]:
    if isinstance(value, Sequence) and not isinstance(value, str):
        for item in value:
            yield from _leaves(item)
    else:
        yield value


def _cylinder(value: Length, radius: Expression, low: Expression, high: Expression) -> Shape:
    return cylinder(value(radius), value(low), value(high))


def _cone(
    value: Length, low_radius: Expression, high_radius: Expression, low: Expression, high: Expression
) -> Shape:
    return cone(value(low_radius), value(high_radius), value(low), value(high))


def _box(value: Length, **ranges: Sequence[Expression]) -> Shape:
    x, y, z = ((value(ranges[axis][0]), value(ranges[axis][1])) for axis in "xyz")
    return box(x, y, z)


def _polygon(value: Length, sides: int, circumradius: Expression, low: Expression, high: Expression) -> Shape:
    return Extrusion(polygon(sides, value(circumradius)), value(low), value(high))


def _extrusion(
    value: Length, outline: Sequence[Sequence[Expression]], low: Expression, high: Expression
) -> Shape:
    return Extrusion(_corners(value, outline), value(low), value(high))


def _revolution(value: Length, profile: Sequence[Sequence[Expression]]) -> Shape:
    return Revolution(_corners(value, profile))


def _sphere(value: Length, radius: Expression) -> Shape:
    return Ball(value(radius))


def _corners(value: Length, corners: Sequence[Sequence[Expression]]) -> Points:
    return outline([(value(x), value(y)) for x, y in corners])


MOST_TURNS = 48  # beyond it a part is a revolution for any camera
# shape → how it is built, and its fields: () one length, (2,) from and to, (−1, 2) corners
SHAPES: dict[str, tuple[Callable[..., Shape], dict[str, tuple[int, ...] | str]]] = {
    "cylinder": (_cylinder, {"radius": (), "low": (), "high": ()}),
    "cone": (_cone, {"low_radius": (), "high_radius": (), "low": (), "high": ()}),
    "box": (_box, {"x": (2,), "y": (2,), "z": (2,)}),
    "polygon": (_polygon, {"sides": "sides", "circumradius": (), "low": (), "high": ()}),
    "extrusion": (_extrusion, {"outline": (-1, 2), "low": (), "high": ()}),
    "revolution": (_revolution, {"profile": (-1, 2)}),
    "sphere": (_sphere, {"radius": ()}),
}
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
    kinds = [key for key in fields if key in PRIMITIVES] if isinstance(fields, Mapping) else []
    if len(kinds) != 1:
        hints = (_closest(str(word), PRIMITIVES) for word in set(fields) - {"from", "measures", "factor"})
        raise ValueError(
            f"{where} is {fields}, expected exactly one of {', '.join(PRIMITIVES)}"
            f"{next(filter(None, hints), '')}"
        )
    kind = kinds[0]
    known = {kind, "from", "measures", "factor", *PRIMITIVES[kind]}
    for word in set(fields) - known:
        raise ValueError(f"{where}: a {kind} takes no field {word!r}{_closest(word, sorted(known))}")
    if not isinstance(fields.get("from"), str):
        raise ValueError(f"{where}: say with from: where its distance starts (centroid or another keypoint)")
    factor = fields.get("factor", 1.0)
    if isinstance(factor, bool) or not isinstance(factor, int | float):
        raise ValueError(f"{where}: factor is {factor!r}, expected a number")
    primitive = _primitive(where, kind, fields)
    return Keypoint(name, fields["from"], primitive, fields.get("measures"), float(factor))


def _primitive(where: str, kind: str, fields: Fields) -> Primitive:
    if kind == "corner":
        _check_shape(f"{where}.corner", (3,), fields[kind])
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
                    _check_shape(f"{where}.at", (), fields["at"])
                primitive: Primitive = Plane(direction, fields.get("at"))
            case "cylinder":
                primitive = Cylinder(direction, towards)
            case "circle":
                primitive = Circle(direction, towards)
            case _:
                _check_shape(f"{where}.sides", "sides", fields.get("sides"))
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


def _closest(word: str, known: Sequence[str] | Mapping[str, Any]) -> str:
    found = difflib.get_close_matches(word, list(known), n=1)
    return f", did you mean {found[0]}?" if found else ""
