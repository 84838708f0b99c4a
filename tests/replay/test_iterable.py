"""A panel through torch's DataLoader: the same batches whatever the workers, quotas exact."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch
from support.panels import panel_of
from torch.utils.data import DataLoader

from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.iterable import PanelDataset
from restock.replay.panel.panel import Panel

MIXTURE = parse_mixture(
    '[[strata]]\nname = "wheel_slip"\nshare = 0.25\n[[strata]]\nname = "near_collision"\n'
    'share = 0.10\n[each_condition]\nshare = "natural"\n'
)


@pytest.fixture(scope="module")
def panel(store_path, tmp_path_factory) -> Panel:
    return panel_of(store_path, MIXTURE, tmp_path_factory.mktemp("iterable") / "panel")


@pytest.fixture(scope="module")
def limited_panel(store_path, tmp_path_factory) -> Panel:
    mixture = parse_mixture('max_replays_per_row = 3\n[each_condition]\nshare = "natural"\n')
    return panel_of(store_path, mixture, tmp_path_factory.mktemp("iterable") / "limited")


def batches(dataset: PanelDataset, workers: int) -> list[dict[str, torch.Tensor]]:
    loader = DataLoader(
        dataset,
        batch_size=None,
        num_workers=workers,
        multiprocessing_context="fork" if workers else None,
    )
    return list(loader)


def test_a_batch_is_the_panels_rows(panel):
    (batch,) = batches(PanelDataset(panel.path, 32, batches=1, seed=0), 0)
    packed = panel.rows[batch["row"].numpy()]
    for name in ("observation", "next_observation"):
        np.testing.assert_array_equal(batch[name], packed[:, panel.columns[name]])
    for name in ("action", "reward", "discount"):
        np.testing.assert_array_equal(batch[name], packed[:, panel.columns[name]][:, 0])
    np.testing.assert_array_equal(batch["weight"], panel.weights[batch["row"].numpy()])
    np.testing.assert_array_equal(batch["stratum"], panel.stratum_code[batch["row"].numpy()])
    assert batch["action"].dtype == torch.int64


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_change_nothing(panel, workers):
    dataset = PanelDataset(panel, 40, batches=17, seed=5)
    alone, shared = batches(dataset, 0), batches(dataset, workers)
    assert len(alone) == len(shared) == 17
    for one, other in zip(alone, shared, strict=True):
        for name, values in one.items():
            assert torch.equal(values, other[name])


def test_passes_are_repeated_or_renewed_by_epoch_and_seed(panel):
    dataset = PanelDataset(panel, 40, batches=3, seed=1)
    first = [batch["row"].tolist() for batch in batches(dataset, 0)]
    assert [batch["row"].tolist() for batch in batches(dataset, 0)] == first
    dataset.set_epoch(1)
    assert [batch["row"].tolist() for batch in batches(dataset, 2)] != first
    other = PanelDataset(panel, 40, batches=3, seed=2)
    assert [batch["row"].tolist() for batch in batches(other, 0)] != first


def passes(dataset: PanelDataset, count: int, **options: Any) -> list[list[list[int]]]:
    """Return the row numbers of every batch of so many passes of one loader."""
    loader = DataLoader(dataset, batch_size=None, **options)
    found = []
    for epoch in range(count):
        dataset.set_epoch(epoch)
        found.append([batch["row"].tolist() for batch in loader])
    return found


@pytest.mark.parametrize(
    ("method", "limited"), [("fork", False), pytest.param("spawn", True, marks=pytest.mark.long)]
)
def test_persistent_workers_are_told_of_the_epoch(panel, limited_panel, method, limited):
    used = limited_panel if limited else panel
    alone = passes(PanelDataset(used, 20, batches=3, seed=1), 3)
    assert alone[0] != alone[1] != alone[2]
    persistent = passes(
        PanelDataset(used, 20, batches=3, seed=1),
        3,
        num_workers=2,
        persistent_workers=True,
        multiprocessing_context=method,
    )
    assert persistent == alone


@pytest.mark.parametrize("method", [None, pytest.param("spawn", marks=pytest.mark.long)])
def test_ranks_share_one_sequence(panel, limited_panel, method):
    from torch.testing._internal.distributed.fake_pg import FakeStore

    options = {} if method is None else {"num_workers": 2, "multiprocessing_context": method}
    for used in (panel, limited_panel):
        (whole,) = passes(PanelDataset(used, 20, batches=6, seed=1), 1)
        of_rank = []
        for rank in range(2):
            dataset = PanelDataset(used, 20, batches=3, seed=1)  # before there are ranks
            torch.distributed.init_process_group("fake", rank=rank, world_size=2, store=FakeStore())
            try:
                of_rank.append(passes(dataset, 1, **options)[0])
            finally:
                torch.distributed.destroy_process_group()
        assert of_rank == [whole[0::2], whole[1::2]]


def test_an_endless_pass_goes_on(panel):
    loader = DataLoader(PanelDataset(panel, 8, seed=0), batch_size=None)
    seen = [batch for _, batch in zip(range(200), loader, strict=False)]
    assert len(seen) == 200


def test_a_worker_is_sent_the_path_not_the_rows(panel):
    dataset = PanelDataset(panel, 8, batches=2, seed=0)
    sent = pickle.dumps(dataset)
    assert len(sent) < 2000
    again = batches(pickle.loads(sent), 0)
    assert torch.equal(again[1]["row"], batches(dataset, 0)[1]["row"])
