"""pnet: 6DoF pose estimation of parametric parts in bins."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pnet.cli.estimator import Estimator

__all__ = ["Estimator"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """`Estimator`, when it is asked for: what it needs takes seconds to import."""
    if name == "Estimator":
        from pnet.cli.estimator import Estimator

        return Estimator
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
