"""Which keypoints a part has, and their order: the selection loop (Section II.A of the paper)."""

from collections.abc import Sequence
from dataclasses import dataclass

from pnet.parts.declaration import check_names
from pnet.parts.primitives import Circle, Direction, Plane, Primitive

CENTROID = "centroid"


@dataclass(frozen=True)
class Keypoint:
    """One keypoint: where the rule of a primitive puts it, seen from its reference.

    Attributes:
        name: what it is, for pictures and logs. reference: another keypoint's name, or "centroid".
        primitive: where it lies. parameter: the parameter that its distance measures; None for a
            keypoint that only serves as a reference, on a `Plane(…, at=…)` or a `Corner`.
        factor: distance / parameter (0.5 where the parameter is a full width and the reference its middle).
    """

    name: str
    reference: str
    primitive: Primitive
    parameter: str | None = None
    factor: float = 1.0


def cone_keypoints(
    rim: str, apex: str, reference: str, axis: Direction, radius: str, height: str
) -> tuple[Keypoint, Keypoint]:
    """Kp-in-cone: the apex angle is broken into two distances from the base's centre.

    Args:
        rim, apex: names of the two keypoints: one on the base circle (In-Prim), one at the tip.
        reference: the base's centre. axis: from there to the tip. radius, height: parameters.
    """
    return (
        Keypoint(rim, reference, Circle(axis), radius),
        Keypoint(apex, reference, Plane(axis), height),
    )


def select_keypoints(declared: Sequence[Keypoint], parameters: Sequence[str]) -> tuple[Keypoint, ...]:
    """The paper's selection loop: the centroid is the first reference, a found keypoint the next one.

    Args:
        declared: in any order. parameters: the part's parameter names.
    Returns:
        The keypoints, each after its reference.
    Raises:
        ValueError: a reference that is never found, a parameter that nothing measures.
    """
    found, waiting = [CENTROID], list(declared)
    selected: list[Keypoint] = []
    while waiting:
        ready = [keypoint for keypoint in waiting if keypoint.reference in found]
        if not ready:
            lost = waiting[0]
            raise ValueError(
                f"keypoint {lost.name!r} refers to {lost.reference!r}, which is not one of {found}; "
                "name the centroid or another keypoint that hangs on it"
            )
        selected += ready
        found += [keypoint.name for keypoint in ready]
        waiting = [keypoint for keypoint in waiting if keypoint not in ready]
    check_names(selected, parameters)
    return tuple(selected)
