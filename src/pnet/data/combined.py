"""Training on one data set, tests on another: the protocol of Table II."""

from dataclasses import dataclass
from typing import Any

from pnet.data.source import DataSource, Keep, SceneSet
from pnet.parts.base import ParametricPart


@dataclass(frozen=True)
class CombinedData:
    """Two data sets of one part.

    Attributes:
        training: of the splits train and val. tests: of test_l and test_g.
    """

    training: DataSource
    tests: DataSource

    def manifest(self) -> dict[str, Any]:
        """See `DataSource`."""
        return {"source": "combined", "training": self.training.manifest(), "tests": self.tests.manifest()}

    def scenes(self, split: str, part: ParametricPart, every: int = 1, keep: Keep | None = None) -> SceneSet:
        """See `DataSource`."""
        return self.of(split).scenes(split, part, every, keep)

    def of(self, split: str) -> DataSource:
        """The data set that a split comes from."""
        return self.training if split in ("train", "val") else self.tests
