"""What can be wrong with a declaration of keypoints, said in one message each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry, Symmetry
from pnet.parts.expressions import check_expression
from pnet.parts.primitives import Corner, Freedom, Plane, Polygon

if TYPE_CHECKING:
    from pnet.parts.keypoints import KeypointChain
    from pnet.parts.selection import Keypoint


def check_names(keypoints: Sequence[Keypoint], parameters: Sequence[str]) -> None:
    """Names are one a keypoint, parameters are known, each is measured, and every place is known."""
    names = [keypoint.name for keypoint in keypoints]
    for name in names:
        if names.count(name) > 1 or name == "centroid":
            raise ValueError(f"keypoint {name!r}: the name is taken, choose another")
    for keypoint in keypoints:
        _check_measure(keypoint, parameters)
    for parameter in parameters:
        if not any(keypoint.parameter == parameter for keypoint in keypoints):
            raise ValueError(
                f"no keypoint determines the parameter {parameter!r}; "
                "let one measure it, or drop the parameter"
            )


def check_declaration(chain: KeypointChain, symmetry: Symmetry, template: Tensor) -> None:
    """The keypoints must fit the symmetry and determine the pose.

    Args:
        chain: with keypoints in order. symmetry: the part's. template: (m, 3) canonical keypoints, metres.
    """
    steps = chain.steps(template)
    for keypoint, step in zip(chain.keypoints, steps, strict=True):
        if float(torch.linalg.vector_norm(step)) < 1e-9:
            raise ValueError(f"keypoint {keypoint.name!r} lies on its reference {keypoint.reference!r}")
        _check_reference(chain, keypoint)
        if isinstance(symmetry, FiniteSymmetry) and isinstance(keypoint.primitive, Polygon):
            _check_polygon(keypoint, keypoint.primitive, chain.group)
    if isinstance(symmetry, RevolutionSymmetry):
        _check_revolution(chain, steps)
    elif isinstance(symmetry, FiniteSymmetry):
        _check_finite(chain, template)
    elif any(keypoint.primitive.freedom is not Freedom.SPHERE for keypoint in chain.keypoints):
        raise ValueError("a sphere's keypoints must lie on spheres about its centroid")


def check_circles(chain: KeypointChain) -> None:
    """A reflection that leaves the finite keypoints in place must leave the circles in place too.

    Else two label sets differ in a circle alone, which the fit takes from the observation.
    """
    if len(chain.chiralities) > 1:
        return
    for element in range(len(chain.group)):
        moved = [i for i in range(len(chain)) if chain.moves(element, i)]
        if moved and not any(chain.is_finite[i] for i in moved):
            raise ValueError(
                f"keypoint {chain.names[moved[0]]!r}: a symmetry of the part moves its circle, but no "
                "keypoint that is not free on a circle; add one that it moves"
            )


def _check_measure(keypoint: Keypoint, parameters: Sequence[str]) -> None:
    where = f"keypoint {keypoint.name!r}"
    if keypoint.parameter is not None:
        if keypoint.parameter not in parameters:
            raise ValueError(
                f"{where} measures {keypoint.parameter!r}, "
                f"which is not one of the parameters {list(parameters)}"
            )
        if isinstance(keypoint.primitive, Corner):
            raise ValueError(f"{where} is a corner, whose place is given: it cannot measure a parameter")
        if isinstance(keypoint.primitive, Plane) and keypoint.primitive.at is not None:
            raise ValueError(
                f"{where} measures {keypoint.parameter!r}, so its plane needs no at: leave one of them out"
            )
        if not 0 < keypoint.factor < math.inf:
            raise ValueError(f"{where}: factor is {keypoint.factor}, expected a positive number")
        return
    match keypoint.primitive:
        case Corner(at=at):
            expressions = list(at)
        case Plane(at=at) if at is not None:
            expressions = [at]
        case _:
            raise ValueError(
                f"{where} measures no parameter and has no place: name a parameter, or give a plane at=…"
            )
    for expression in expressions:
        try:
            check_expression(expression, parameters)
        except ValueError as fault:
            raise ValueError(f"{where}: {fault}") from fault


def _check_reference(chain: KeypointChain, keypoint: Keypoint) -> None:
    """What hangs on a free keypoint must not depend on where on its circle that is."""
    for other in chain.keypoints:
        if other.name != keypoint.reference or other.primitive.freedom is Freedom.NONE:
            continue
        axis, direction = other.primitive.axis, keypoint.primitive.direction
        if (
            other.primitive.freedom is Freedom.SPHERE
            or keypoint.primitive.freedom is not Freedom.NONE
            or float(torch.linalg.vector_norm(torch.linalg.cross(axis, direction))) > 1e-9
            or keypoint.parameter is None
        ):
            raise ValueError(
                f"keypoint {keypoint.name!r} hangs on {other.name!r}, which is free on a circle or sphere; "
                "only a "
                "distance along the circle's axis can start there: take another reference"
            )


def _check_polygon(keypoint: Keypoint, polygon: Polygon, group: Tensor) -> None:
    axis, vertex = polygon.axis, polygon.direction
    keeps = ((group @ axis) - axis).abs().amax(-1) < 1e-6
    images = group[keeps] @ vertex
    count = len(torch.unique((images * 1e6).round(), dim=0))
    if polygon.sides % count:
        raise ValueError(
            f"keypoint {keypoint.name!r}: the part's symmetry makes {count} equivalents of a vertex, which a "
            f"polygon of {polygon.sides} sides does not have; mend sides or the symmetry"
        )


def _check_revolution(chain: KeypointChain, steps: Tensor) -> None:
    for keypoint, step in zip(chain.keypoints, steps, strict=True):
        primitive = keypoint.primitive
        axial = primitive.axis if primitive.freedom is Freedom.TURN else step
        tilt = torch.linalg.vector_norm(axial[:2]) / torch.linalg.vector_norm(axial)
        if primitive.freedom is Freedom.SPHERE or float(tilt) > 1e-6:
            raise ValueError(
                f"keypoint {keypoint.name!r}: the part is a revolution about z, "
                "so its equivalents are a circle about "
                "z or a point on z; use Cylinder or Circle around z, or a Plane along z"
            )
    if not any(chain.is_finite):
        raise ValueError(
            "no keypoint lies on the axis: the keypoints don't determine the axis' sense; add an end face"
        )


def _check_finite(chain: KeypointChain, template: Tensor) -> None:
    finite = template[chain.is_finite]
    size = torch.linalg.svdvals(finite) if len(finite) else torch.zeros(3)
    rank = int((size > 1e-6 * template.abs().max()).sum())
    if rank < 2:
        raise ValueError(
            "the keypoints don't determine the pose: centroid and the keypoints that are not free on a "
            "circle lie on one line; add one beside it"
        )
    improper = chain.group[torch.linalg.det(chain.group) < 0]
    if rank == 2 and len(improper):
        fixed = (finite @ improper.mT - finite).abs().amax((-1, -2)) < 1e-6 * finite.abs().max()
        if not bool(fixed.any()):
            raise ValueError(
                "the keypoints lie in one plane with the centroid, so a part and its mirror image look the "
                "same in them; add one off that plane, or leave out the mirror"
            )
