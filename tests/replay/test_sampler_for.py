"""Every way of drawing from a panel keeps the mixture's rules, or is refused with a remedy."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import pyarrow as pa
import pytest
import torch
from support.stores import CONDITIONS, recording_transitions

from restock.errors import MixtureError
from restock.ingest.profile.profile import load_profile
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.replay.panel.logged_sampler import LoggedSampler, sampler_for
from restock.replay.panel.panel import Panel
from restock.replay.sampling.ring import FreshRing
from restock.train.feed.batches import Batches
from restock.train.feed.logs import Logs
from restock.train.libraries.mixed_feed import FeedOptions, MixedFeed

TASK = load_profile("warehouse_amr").task
BATCH = 40
EVERY = (
    "planned_draws = 128\n[evaluation_split]\nby = 'none'\n[each_condition]\nshare = 'equal'\n"
    "[correction]\npost = 'full'\nbelow_natural = 'allow'\n"
)
MIXTURES = {
    "without replacement": "within = 'without_replacement'\n" + EVERY,
    "uniform": "within = 'uniform'\n" + EVERY,
    "limited": "max_replays_per_row = 3\n" + EVERY,
    "limited, uniform": "max_replays_per_row = 3\nwithin = 'uniform'\n" + EVERY,
    "once": "max_replays_per_row = 1\nwithin = 'uniform'\n" + EVERY,
    "per": "within = 'per'\n" + EVERY,
    "limited per": "max_replays_per_row = 3\nwithin = 'per'\n" + EVERY,
    "quota": EVERY + "[[strata]]\nname = 'wheel_slip'\nshare = 0.25\n",
}
FOLLOW_TD = {"per", "limited per"}


@dataclass(frozen=True)
class Drawn:
    rows: np.ndarray
    strata: np.ndarray


Way = Callable[[Panel], Iterator[Drawn]]
LARGE_TD = 3.0  # other rows have 0.1


def td_errors(rows: np.ndarray, strata: np.ndarray) -> np.ndarray:
    """Return |TD| (B,), large in stratum 0 and in even rows."""
    return np.where((strata == 0) | (rows % 2 == 0), LARGE_TD, 0.1).astype(np.float32)


def by_sampler(panel: Panel) -> Iterator[Drawn]:
    sampler = sampler_for(panel, BATCH, seed=0)
    for number in range(10**9):
        sampler.move_to(number * 10)
        batch = sampler.draw()
        if len(batch.rows) < BATCH:
            raise MixtureError("no more", remedy="mix with more")
        packed = np.empty((BATCH, panel.rows.shape[1]), np.float32)
        sampler.gather(batch.rows, packed)
        np.testing.assert_array_equal(packed, panel.rows[batch.rows])
        yield Drawn(batch.rows, batch.strata)
        sampler.update(batch.rows, td_errors(batch.rows, batch.strata))


def by_batches(panel: Panel) -> Iterator[Drawn]:
    ring = FreshRing(64, 4, panel.observation_size, discount=panel.discount)
    logs = Logs.of_panel(panel)
    batches = Batches(logs, ring, batch_size=BATCH, logs_share=1.0, seed=0)
    for number in range(10**9):
        batch = batches.draw_online(number * 10)
        np.testing.assert_array_equal(batch.rows.numpy(), panel.rows[batch.log_rows])
        yield Drawn(batch.log_rows, batch.log_stratum)
        td = td_errors(batch.log_rows, batch.log_stratum)
        batches.note_errors(batch, torch.from_numpy(td))


def by_library(panel: Panel, reports_td: bool = True) -> Iterator[Drawn]:
    options = FeedOptions(profile="warehouse_amr", audit_share=0.0, log_every=10)
    feed = MixedFeed(64, 2, panel.observation_size, panel, options)
    for _ in range(10**9):
        batch = feed.draw_logs(BATCH)
        yield Drawn(batch.rows, batch.strata)
        td = td_errors(batch.rows, batch.strata) if reports_td else None
        feed.drawn(panel.rows[batch.rows], batch, np.empty(0, np.int64), td=td)


WAYS: dict[str, Way] = {
    "sampler_for": by_sampler,
    "training": by_batches,
    "a library's buffer": by_library,
    "a library's buffer without TD errors": partial(by_library, reports_td=False),
}


@pytest.fixture(scope="module")
def panels(tmp_path_factory) -> Callable[[str], Panel]:
    table = pa.concat_tables(
        [recording_transitions(index, episodes=6, task=TASK) for index in (1, 2)]
    )
    made: dict[str, Panel] = {}

    def panel(name: str) -> Panel:
        if name not in made:
            mixture = parse_mixture(MIXTURES[name])
            out = tmp_path_factory.mktemp("panels") / "panel"
            made[name] = build_panel(table, mixture, out, task=TASK, conditions=CONDITIONS)
        return made[name]

    return panel


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", MIXTURES)
def test_mixture_rules_hold_or_draw_is_refused(panels, name, way):
    panel = panels(name)
    limit = panel.header.mixture.max_replays_per_row
    batches: list[Drawn] = []
    counted = np.zeros(len(panel), np.int64)
    refusal = ""
    try:
        for batch in WAYS[way](panel):
            batches.append(batch)
            np.add.at(counted, batch.rows, 1)
            np.testing.assert_array_equal(panel.stratum_code[batch.rows], batch.strata)
            if len(batches) == 200:
                break
    except MixtureError as error:
        refusal = str(error) if error.remedy else ""
    if name in FOLLOW_TD and way == "a library's buffer without TD errors":
        assert "depend on TD errors" in refusal
        assert len(batches) <= 1
        return
    # Draws end if there is a limit, and only then.
    if limit is not None:
        assert counted.max() <= limit
        assert refusal
        assert len(batches) == int(limit) * len(panel) // BATCH
        return
    assert not refusal
    _check_within(panel, name, batches, counted)
    _check_shares(panel, batches)


def _check_within(panel: Panel, name: str, batches: list[Drawn], counted: np.ndarray) -> None:
    """Check that a stratum's rows are drawn by its rule."""
    for stratum, members in zip(panel.strata, panel.stratum_rows(), strict=True):
        spread = np.ptp(counted[members])
        if stratum.within == "without_replacement":
            assert spread <= 1, stratum.name
        elif counted[members].mean() > 3:
            assert spread > 1, stratum.name
        if stratum.within == "per" and len(members) > 20:
            even = members % 2 == 0
            of_even, of_odd = counted[members[even]].mean(), counted[members[~even]].mean()
            all_large = stratum.name == panel.strata[0].name
            assert all_large or of_even > 1.5 * of_odd, stratum.name


def _check_shares(panel: Panel, batches: list[Drawn]) -> None:
    """Check that batches meet the quota of every stratum, with rounding carried over."""
    size = len(panel.strata)
    quotas = np.array([np.bincount(batch.strata, minlength=size) for batch in batches])
    shares = np.array([stratum.share for stratum in panel.strata])
    owed = np.cumsum(quotas - shares * BATCH, axis=0)
    assert np.abs(owed).max() < 2


def test_restored_draws_of_panel_continue_exactly(panels):
    panel = panels("limited per")
    one, other = sampler_for(panel, BATCH, seed=1), sampler_for(panel, BATCH, seed=2)

    def some(sampler: LoggedSampler, batches: int) -> list[list[int]]:
        found = []
        for _ in range(batches):
            batch = sampler.draw()
            sampler.update(batch.rows, td_errors(batch.rows, batch.strata))
            found.append(batch.rows.tolist())
        return found

    some(one, 7)
    other.load_state_dict(one.state_dict())
    assert some(one, 20) == some(other, 20)
