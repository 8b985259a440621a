"""Tables of all levels: what they are made of, and that a loader's are the network's."""

import pytest
import torch
from torch.utils.data import DataLoader, Dataset, default_collate

from pnet.data.dataset import Collate, LabelledScenes
from pnet.data.scene_folder import SceneFolder
from pnet.ops.neighbours import ball_query, octants, three_nearest
from pnet.ops.operators import plain_operators
from pnet.ops.pyramid import Ball, Pyramid
from pnet.ops.sampling import farthest_points
from pnet.parts.choice import KeypointChoice

PYRAMID = Pyramid([40, 12], [[Ball(0.2, 8)], [Ball(0.3, 4), Ball(0.6, 6)]], [0.2, None, 0.5])


def clouds(batch: int = 2, n: int = 120, seed: int = 0) -> torch.Tensor:
    """Random clouds in sampling order."""
    points = torch.rand(batch, n, 3, generator=torch.Generator().manual_seed(seed))
    return torch.stack([cloud[farthest_points(cloud[None], n)[0]] for cloud in points])


def test_tables_are_searches_in_prefixes_of_the_cloud():
    points = clouds()
    middle, top = points[:, :40], points[:, :12]
    near_1, weight_1 = three_nearest(points, middle)
    near_2, weight_2 = three_nearest(middle, top)
    expected = {
        "octants_0": octants(points, 0.2),
        "ball_1_0": ball_query(points, middle, 0.2, 8),
        "near_1": near_1,
        "weight_1": weight_1,
        "ball_2_0": ball_query(middle, top, 0.3, 4),
        "ball_2_1": ball_query(middle, top, 0.6, 6),
        "near_2": near_2,
        "weight_2": weight_2,
        "octants_2": octants(top, 0.5),
    }
    tables = PYRAMID(points)
    assert tables.keys() == expected.keys()
    assert all(torch.equal(tables[name], table) for name, table in expected.items())


def test_shapes_and_types_of_the_tables():
    tables = PYRAMID(clouds(3))
    assert {name: tuple(table.shape) for name, table in tables.items()} == {
        "octants_0": (3, 120, 8),
        "ball_1_0": (3, 40, 8),
        "near_1": (3, 120, 3),
        "weight_1": (3, 120, 3),
        "ball_2_0": (3, 12, 4),
        "ball_2_1": (3, 12, 6),
        "near_2": (3, 40, 3),
        "weight_2": (3, 40, 3),
        "octants_2": (3, 12, 8),
    }
    for name, table in tables.items():
        assert table.dtype == (torch.float32 if name.startswith("weight") else torch.int64)
    assert PYRAMID(clouds().double())["weight_1"].dtype == torch.float64


@pytest.mark.parametrize("n", [1, 2, 11, 39])
def test_a_smaller_cloud_has_smaller_levels(n):
    tables = PYRAMID(clouds(n=n))
    assert tables["ball_1_0"].shape == (2, n, 8) and tables["ball_2_0"].shape == (2, min(n, 12), 4)
    assert tables["near_2"].shape == (2, n, min(n, 3)) and tables["octants_2"].shape == (2, min(n, 12), 8)
    for name, table in tables.items():
        assert name.startswith("weight") or int(table.max()) < n


def test_octants_are_searched_at_the_levels_that_ask_for_them():
    points = clouds()
    assert set(Pyramid([], [], [0.3])(points)) == {"octants_0"}
    assert Pyramid([], [], [])(points) == {}
    assert set(Pyramid([5], [[Ball(0.1, 2)]], [])(points)) == {"ball_1_0", "near_1", "weight_1"}


def test_tables_know_nothing_of_autograd():
    points = clouds().requires_grad_()
    assert not any(table.requires_grad for table in PYRAMID(points).values())


def test_references_find_the_same_tables():
    points = clouds()
    with plain_operators():
        expected = PYRAMID(points)
    assert all(torch.equal(table, expected[name]) for name, table in PYRAMID(points).items())


def test_a_scene_s_tables_are_the_batch_s():
    points = clouds(4)
    each = [{name: table[0] for name, table in PYRAMID(cloud[None]).items()} for cloud in points]
    together, expected = default_collate(each), PYRAMID(points)
    assert together.keys() == expected.keys()
    assert all(torch.equal(together[name], table) for name, table in expected.items())


class WithTables(Dataset):
    """Clouds with their tables, as a loader's worker finds them."""

    def __init__(self, points: torch.Tensor) -> None:
        self._points = points

    def __len__(self) -> int:
        return len(self._points)

    def __getitem__(self, index: int):
        tables = {name: table[0] for name, table in PYRAMID(self._points[index : index + 1]).items()}
        return {"points": self._points[index], "tables": tables}


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("workers", [0, 2])
def test_a_loader_s_tables_are_the_network_s(workers):
    points = clouds(6, n=300)
    torch.set_num_threads(2)
    expected = PYRAMID(points)  # has the parent's threads run before the workers are forked
    loader = DataLoader(
        WithTables(points),
        batch_size=3,
        num_workers=workers,
        multiprocessing_context="fork" if workers else None,
    )
    batches = list(loader)
    assert torch.equal(torch.cat([batch["points"] for batch in batches]), points)
    for name, table in expected.items():
        assert torch.equal(torch.cat([batch["tables"][name] for batch in batches]), table), name


def test_a_batch_carries_tables_where_a_pyramid_is_given(tmp_path, tn34, write_split):
    write_split(tmp_path, tn34, "train", cycles=1)
    scenes = SceneFolder(tmp_path, "train", "tn34")
    labelled = [*LabelledScenes(scenes, tn34.chain, KeypointChoice(), 64)]
    assert Collate()(labelled).tables is None
    batch = Collate(PYRAMID)(labelled)
    assert batch.points.shape == (3, 64, 3) and batch.tables is not None
    assert all(torch.equal(batch.tables[name], table) for name, table in PYRAMID(batch.points).items())
