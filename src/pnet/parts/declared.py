"""A part without Python: primitives stacked in a config, parameters and keypoints declared beside them.

See docs/parts.md for the tutorial, conf/part/knob.yaml for an example. Lengths in expressions are
millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.parts.base import Grid, ParametricPart
from pnet.parts.declared_fields import (
    Fields,
    check_kind,
    check_shape,
    closest,
    keypoint_from,
    lookalikes_from,
    mirror_from,
    symmetry_from,
)
from pnet.parts.expressions import Expression, check_condition, check_expression, holds, length
from pnet.parts.shapes import Ball, Extrusion, Revolution, Shape, polygon
from pnet.parts.solids import Operation, Solid, box, cone, cylinder, moved, outline

Points = NDArray[np.float64]
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
        lookalikes: exchanges `[[KEYPOINT, KEYPOINT], …]` of a part that looks much the same in other poses;
            see `ParametricPart`.
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
        lookalikes: Sequence[Sequence[Sequence[str]]] = (),
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
            self.lookalikes = lookalikes_from(lookalikes)
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
        if not isinstance(kind, str) or kind not in SHAPES:
            raise ValueError(
                f"{where}: no shape {kind!r}{closest(str(kind), SHAPES)}; there are {', '.join(SHAPES)}"
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
        check_shape(f"{where}.at", (3,), self._at)
        for key, form in wanted.items():
            check_shape(f"{where}.{key}", form, given[key])
        self._fields = given

    def expressions(self) -> list[Expression]:
        """All lengths of the step, to be checked early."""
        return list(_leaves([self._at, *(value for key, value in self._fields.items() if key != "sides")]))

    def shape(self, value: Length) -> Shape:
        """The placed shape for the parameters behind `value`."""
        return moved(self._build(value, **self._fields), self._axis, tuple(value(x) for x in self._at))


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
