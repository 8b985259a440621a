"""A part without Python: primitives stacked in a config, parameters and keypoints declared beside them.

See docs/parts.md for the tutorial, conf/part/knob.yaml for an example. Lengths in expressions are millimetres.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
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
from pnet.parts.expressions import Expression, check_expression, holds, length
from pnet.parts.keypoints import Keypoint
from pnet.parts.primitives import Circle, Corner, Cylinder, Plane, Polygon, Primitive, Sphere, unit
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
        keypoints: name → `{from: REFERENCE, PRIMITIVE: DIRECTION, measures: PARAMETER, factor: NUMBER, at: PLACE}`.
        symmetry: "none", "revolution", "revolution_equal_ends", "sphere", {cyclic: n}, {dihedral: n} or
            {rotations: [matrices]}. mirror: normal of a mirror plane through the centroid ("x", "y", …), or None.
        require: comparisons that valid parameters satisfy, such as "d > 2 * r".
        learning, generalization, sections: see `ParametricPart`.
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
    ) -> None:
        self.name, self.parameter_names = name, tuple(parameters)
        try:
            if not solid:
                raise ValueError("the solid has no step: begin with {add: cylinder, …}")
            self._steps = [_Step(i, fields) for i, fields in enumerate(solid)]
            self._require = list(require)
            for expression in [*(e for step in self._steps for e in step.expressions()), *self._require]:
                check_expression(expression, self.parameter_names)
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


class _Step:
    """One entry of `solid`: an operation, a shape's name, and its fields."""

    def __init__(self, index: int, fields: Fields) -> None:
        where = f"solid[{index}]"
        operations = [key for key in fields if key in list(Operation)]
        if len(operations) != 1:
            raise ValueError(f"{where} is {dict(fields)}, expected exactly one of add, cut, hole")
        self.operation, kind = Operation(operations[0]), fields[operations[0]]
        if index == 0 and self.operation is not Operation.ADD:
            raise ValueError(f"{where}: the first step must add something")
        if kind not in SHAPES:
            raise ValueError(f"{where}: no shape {kind!r}{_closest(str(kind), SHAPES)}; there are {', '.join(SHAPES)}")
        self._build, choices = SHAPES[kind]
        self._fields = {key: value for key, value in fields.items() if key != operations[0]}
        given = set(self._fields) - {"axis", "at"}
        if given not in [set(choice) for choice in choices]:
            wanted = " or ".join(", ".join(choice) for choice in choices)
            raise ValueError(f"{where}: a {kind} takes {wanted} (and axis, at), got {', '.join(sorted(given)) or 'none'}")
        if self._fields.get("axis", "z") not in ("x", "y", "z"):
            raise ValueError(f"{where}: axis is {self._fields['axis']!r}, choose x, y or z")

    def expressions(self) -> list[Expression]:
        """All lengths of the step, to be checked early."""
        found: list[Expression] = []
        self.shape(lambda expression: (found.append(expression), np.ones(()))[1])
        return found

    def shape(self, value: Length) -> Shape:
        """The placed shape for the parameters behind `value`."""
        sizes = {key: field for key, field in self._fields.items() if key not in ("axis", "at")}
        at = tuple(value(x) for x in self._fields.get("at", (0, 0, 0)))
        return moved(self._build(value, **sizes), self._fields.get("axis", "z"), at)


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


def _extrusion(value: Length, outline: Sequence[Sequence[Expression]], low: Expression, high: Expression) -> Shape:
    return Extrusion(_corners(value, outline), value(low), value(high))


def _revolution(value: Length, profile: Sequence[Sequence[Expression]]) -> Shape:
    return Revolution(_corners(value, profile))


def _sphere(value: Length, radius: Expression) -> Shape:
    return Ball(value(radius))


def _corners(value: Length, outline: Sequence[Sequence[Expression]]) -> Points:
    return np.stack([np.stack([value(x) for x in corner], -1) for corner in outline], -2)


# shape → how it is built, and which fields it takes
SHAPES: dict[str, tuple[Callable[..., Shape], list[tuple[str, ...]]]] = {
    "cylinder": (_cylinder, [("radius", "low", "high")]),
    "cone": (_cone, [("low_radius", "high_radius", "low", "high")]),
    "box": (_box, [("x", "y", "z")]),
    "polygon": (_polygon, [("sides", "circumradius", "low", "high")]),
    "extrusion": (_extrusion, [("outline", "low", "high")]),
    "revolution": (_revolution, [("profile",)]),
    "sphere": (_sphere, [("radius",)]),
}
PRIMITIVES = ("plane", "cylinder", "circle", "sphere", "polygon", "corner")


def keypoint_from(name: str, fields: Fields) -> Keypoint:
    """A keypoint out of its fields; see `DeclaredPart`."""
    where = f"keypoints.{name}"
    kinds = [key for key in fields if key in PRIMITIVES]
    unknown = set(fields) - {*PRIMITIVES, "from", "measures", "factor", "at", "sides", "towards"}
    if unknown:
        known = [*PRIMITIVES, "from", "measures", "factor", "at", "sides", "towards"]
        word = sorted(unknown)[0]
        raise ValueError(f"{where}: unknown field {word!r}{_closest(word, known)}")
    if len(kinds) != 1:
        raise ValueError(f"{where}: expected exactly one of {', '.join(PRIMITIVES)}, got {', '.join(kinds) or 'none'}")
    if "from" not in fields:
        raise ValueError(f"{where}: say with from: where its distance starts (centroid or another keypoint)")
    primitive = _primitive(where, kinds[0], fields)
    return Keypoint(name, fields["from"], primitive, fields.get("measures"), float(fields.get("factor", 1.0)))


def _primitive(where: str, kind: str, fields: Fields) -> Primitive:
    direction = fields[kind] if isinstance(fields[kind], str) else tuple(fields[kind] or ())
    towards = fields.get("towards")
    towards = tuple(towards) if isinstance(towards, Sequence) and not isinstance(towards, str) else towards
    try:
        match kind:
            case "plane":
                primitive: Primitive = Plane(direction, fields.get("at"))  # type: ignore[arg-type]
            case "cylinder":
                primitive = Cylinder(direction, towards)  # type: ignore[arg-type]
            case "circle":
                primitive = Circle(direction, towards)  # type: ignore[arg-type]
            case "polygon":
                primitive = Polygon(int(fields.get("sides", 0)), direction, towards)  # type: ignore[arg-type]
            case "corner":
                return Corner(direction)  # type: ignore[arg-type]
            case _:
                return Sphere()
        unit(primitive.direction.tolist() and direction)  # type: ignore[arg-type]
    except ValueError as fault:
        raise ValueError(f"{where}: {fault}") from fault
    return primitive


def symmetry_from(value: str | Fields) -> Symmetry:
    """A symmetry group out of its name; see `DeclaredPart`."""
    named: dict[str, Symmetry] = {
        "none": cyclic(1),
        "revolution": RevolutionSymmetry(),
        "revolution_equal_ends": RevolutionSymmetry(rotoreflection=True),
        "sphere": SphericalSymmetry(),
    }
    choices = [*named, "{cyclic: n}", "{dihedral: n}", "{rotations: [matrices]}"]
    if isinstance(value, str) and value in named:
        return named[value]
    match value:
        case {"cyclic": int(n), **others} if n >= 1 and not others:
            return cyclic(n)
        case {"dihedral": int(n), **others} if n >= 1 and not others:
            return dihedral(n)
        case {"rotations": rotations, **others} if not others:
            return FiniteSymmetry(torch.tensor(rotations, dtype=torch.float64))
    raise ValueError(f"symmetry is {value!r}, choose {', '.join(choices)}")


def mirror_from(normal: str | None) -> torch.Tensor | None:
    """The reflection in the plane with this normal."""
    return None if normal is None else reflection(tuple(unit(normal).tolist()))


def _closest(word: str, known: Sequence[str] | Mapping[str, Any]) -> str:
    found = difflib.get_close_matches(word, list(known), n=1)
    return f", did you mean {found[0]}?" if found else ""
