"""Check the buffer in a library's training loop: quotas of logs, fresh rows and the record."""

import hashlib
import json

import numpy as np
import pytest
import torch
from support.library_buffers import TrainedBuffer, trained_sb3

from restock.replay.store.store import Store
from restock.train.feed.batch_record import STOPPED, NotFinite

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedBuffer:
    return trained_sb3(tmp_path_factory.mktemp("library"))


def test_dqn_trains_offline_then_on_half_logs(trained: TrainedBuffer) -> None:
    feed, tables, size = trained.feed, trained.tables, trained.batch_size
    assert feed.env_steps == trained.env_steps == 520
    assert feed.batches == trained.updates > 2 * trained.offline_updates
    offline = [row for row in tables["strata"] if row["phase"] == "offline"]
    assert {row["source"] for row in offline} == {"logs"}
    assert sum(row["drawn_rows"] for row in offline) == trained.offline_updates * size
    logs, fresh = (
        sum(row["drawn_rows"] for row in tables["strata"] if row["source"] == source)
        for source in ("logs", "fresh")
    )
    online = feed.batches - trained.offline_updates
    assert fresh == online * size // 2
    assert logs == trained.offline_updates * size + online * size // 2
    assert logs + fresh == size * feed.batches
    assert sum(row["updates"] for row in tables["progress"]) == feed.batches
    assert all(row["td_abs_mean"] > 0 for row in tables["strata"] if row["drawn_rows"])


def test_nonfinite_loss_stops_and_names_rows(tmp_path):
    """Report TD errors to the buffer; earlier records stay complete."""
    trained = trained_sb3(tmp_path, 80)
    updates = trained.feed.batches
    with torch.no_grad():
        next(iter(trained.algorithm.q_net.parameters()))[0, 0] = float("nan")
    with pytest.raises(NotFinite, match=rf"loss is not finite at update {updates}; 64 of the 64"):
        trained.algorithm.train(1, batch_size=64)
    document = json.loads((trained.run / STOPPED).read_text())
    assert {row["source"] for row in document["rows"]} == {"logs", "fresh"}
    assert all(row["named"] for row in document["rows"])
    assert sum(row["updates"] for row in trained.tables["progress"]) == updates


def test_nonfinite_logged_row_stops_and_is_named(trained: TrainedBuffer) -> None:
    feed = trained.feed
    drawing = feed.draw_logs(4)
    packed = np.zeros((len(drawing.rows), 3), np.float32)
    packed[1, 2] = np.inf
    with pytest.raises(NotFinite, match=rf"1 of the .* panel row {drawing.rows[1]} "):
        feed.drawn(packed, drawing, np.empty(0, np.int64))


def test_quotas_are_met_exactly(trained: TrainedBuffer) -> None:
    drawn: dict[str, int] = {}
    for row in trained.tables["strata"]:
        if row["source"] == "logs":
            drawn[row["stratum"]] = drawn.get(row["stratum"], 0) + row["drawn_rows"]
    total = sum(drawn.values())
    for stratum in trained.panel.strata:
        assert abs(drawn[stratum.name] - stratum.share * total) < 2  # rounding, in both phases
    assert drawn["wheel_slip"] == pytest.approx(0.25 * total, abs=2)


def test_audit_rows_identify_their_transitions(trained: TrainedBuffer) -> None:
    audit, panel = trained.tables["audit"], trained.panel
    assert {row["source"] for row in audit} == {"logs", "fresh"}
    assert all(np.isfinite(row["td"]) and np.isfinite(row["q"]) for row in audit)
    place = {int(t): i for i, t in enumerate(panel.meta["transition_id"].to_pylist())}
    with Store(trained.store) as opened:
        conditions = dict(
            opened.sql("SELECT transition_id, primary_condition FROM transitions").fetchall()
        )
    for row in audit:
        assert row["last_target_sync"] is None  # the buffer does not know the library's syncs
        assert 0 < row["age_gradient_steps"] <= row["gradient_step"]
        if row["source"] == "logs":
            at = place[row["transition_id"]]
            packed = np.array(panel.rows[at])
            assert row["row_hash"] == hashlib.blake2b(packed.tobytes(), digest_size=8).hexdigest()
            assert row["condition"] == conditions[row["transition_id"]]
            assert row["condition"] == panel.meta["condition"][at].as_py()
            assert row["weight"] == pytest.approx(float(panel.weights[at]), rel=1e-5)
            assert row["age_days"] >= 0
        else:
            assert 0 <= row["age_env_steps"] < trained.env_steps
            assert row["behaviour_policy"] == "stable-baselines3"
            assert row["weight"] == 1


def test_ended_episodes_are_labelled(trained: TrainedBuffer) -> None:
    ended, ring = trained.tables["episodes"], trained.feed.ring
    assert len(ended) >= 2  # two environments, 250 steps each, 240 at most an episode
    for row in ended:
        slots = trained.slots_of(row["episode"])
        assert len(slots) == row["steps"]
        codes = ring.condition(slots)
        assert (codes >= 0).all()
        conditions = {ring.conditions[code] for code in codes} - {"nominal"}
        assert conditions <= set(row["conditions"])
