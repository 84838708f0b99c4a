"""Panels: rows equal to the store's, n-step returns, pinned, checked, all or nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import TASK, recording_transitions, write_store
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.errors import MixtureError, PanelError, StoreError
from restock.ingest.task import Task
from restock.replay import build
from restock.replay.build import build_panel
from restock.replay.mixture import Mixture, load_mixture, parse_mixture
from restock.replay.n_step import n_step_horizon, n_step_return
from restock.replay.panel import ROWS, Panel
from restock.replay.store import Store


def uniform(**changes: object) -> Mixture:
    text = f"[each_condition]\nshare = 'natural'\n[held_out]\nby = '{changes.pop('by', 'none')}'\n"
    top = "".join(f"{name} = {json.dumps(value)}\n" for name, value in changes.items())
    return parse_mixture(top + text)


def by_episode(table: pa.Table) -> dict[str, list[dict[str, object]]]:
    rows: dict[str, list[dict[str, object]]] = {}
    for row in table.sort_by(
        [("episode_id", "ascending"), ("step_index", "ascending")]
    ).to_pylist():
        rows.setdefault(str(row["episode_id"]), []).append(row)
    return rows


@pytest.mark.parametrize("n_step", [1, 3, 7])
def test_packed_rows_are_those_of_a_naive_reading_of_the_table(
    transitions: pa.Table, tmp_path: Path, n_step: int
) -> None:
    # Shuffled, because a store's files come in any order; and with a step missing.
    order = np.random.default_rng(0).permutation(len(transitions))
    shuffled = transitions.take(pa.array(order)).filter(
        pa.array(transitions["transition_id"].to_numpy()[order] != (2 << 25) + 40)
    )
    panel = build_panel(shuffled, uniform(n_step=n_step, discount=0.9), tmp_path / "p", task=TASK)
    assert len(panel) == len(transitions) - 1
    episodes = by_episode(shuffled)
    part = panel.columns
    for packed, meta in zip(panel.rows, panel.meta.to_pylist(), strict=True):
        episode = episodes[meta["episode_id"]]
        at = next(i for i, r in enumerate(episode) if r["step_index"] == meta["step_index"])
        span = episode[at : at + n_step]
        for index in range(1, len(span)):
            if span[index]["step_index"] != span[0]["step_index"] + index:
                span = span[:index]
                break
        assert meta["transition_id"] == span[0]["transition_id"]
        assert meta["horizon"] == len(span)
        expected = sum(0.9**k * row["reward"] for k, row in enumerate(span))
        np.testing.assert_allclose(packed[part["reward"]], expected, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(packed[part["observation"]], span[0]["observation"])
        np.testing.assert_array_equal(
            packed[part["next_observation"]], span[-1]["next_observation"]
        )
        assert packed[part["action"]] == span[0]["action"]
        np.testing.assert_allclose(
            packed[part["discount"]], 0.9 ** len(span) * (not span[-1]["terminated"]), rtol=1e-6
        )


def test_returns_stop_at_a_handover(tmp_path: Path) -> None:
    table = recording_transitions(1, episodes=1)
    policy = np.where(np.arange(len(table)) < 5, "planner", "operator")
    place = table.schema.get_field_index("behaviour_policy")
    table = table.set_column(place, table.schema.field(place), pa.array(policy))
    panel = build_panel(table, uniform(n_step=4), tmp_path / "p")
    assert panel.meta["horizon"].to_pylist()[:6] == [4, 4, 3, 2, 1, 4]


@settings(max_examples=100, deadline=None)
@given(
    continues=st.lists(st.booleans(), min_size=1, max_size=40),
    n_step=st.integers(1, 45),
    discount=st.floats(0, 1),
)
def test_horizons_and_returns_follow_their_definition(
    continues: list[bool], n_step: int, discount: float
) -> None:
    going_on = np.array([*continues[:-1], False])
    reward = np.random.default_rng(0).normal(size=len(going_on)).astype(np.float32)
    horizon = n_step_horizon(going_on, n_step)
    returns = n_step_return(reward, horizon, discount)
    for row in range(len(going_on)):
        steps = 1
        while steps < n_step and going_on[row + steps - 1]:
            steps += 1
        assert horizon[row] == steps
        expected = sum(discount**k * float(reward[row + k]) for k in range(steps))
        assert returns[row] == pytest.approx(expected, abs=1e-6)


def test_a_store_and_the_same_table_pack_the_same_rows(
    transitions: pa.Table, store_path: Path, tmp_path: Path
) -> None:
    mixture = load_mixture("coverage")
    from_table = build_panel(transitions, mixture, tmp_path / "a", task=TASK)
    with Store(store_path) as store:
        from_store = build_panel(store, mixture, tmp_path / "b")
    np.testing.assert_array_equal(from_table.rows, from_store.rows)
    assert from_table.meta.equals(from_store.meta)
    assert from_store.task == TASK
    assert from_store.task_hash == TASK.hash
    assert from_store.store_version == 2


def test_the_id_names_the_content(transitions: pa.Table, tmp_path: Path) -> None:
    def made(name: str, **changes: object) -> str:
        return build_panel(transitions, uniform(**changes), tmp_path / name).id

    assert made("a") == made("b")
    assert (
        len(
            {
                made("c"),
                made("d", n_step=2),
                made("e", seed=1, by="episode"),
                made("f", seed=2, by="episode"),
            }
        )
        == 4
    )


def test_strata_are_those_of_the_labels_by_priority(transitions: pa.Table, tmp_path: Path) -> None:
    panel = build_panel(transitions, uniform(), tmp_path / "p")
    assert panel.meta["stratum"].to_pylist() == panel.meta["condition"].to_pylist()
    for stratum, rows in zip(panel.strata, panel.stratum_rows(), strict=True):
        assert stratum.rows == len(rows)
    assert sum(stratum.share for stratum in panel.strata) == pytest.approx(1)


def test_the_sampler_draws_by_the_panels_quotas(transitions: pa.Table, tmp_path: Path) -> None:
    mixture = parse_mixture(
        "[planned]\nupdates = 100\n[each_condition]\nshare = 'equal'\n[held_out]\nby = 'none'"
    )
    panel = build_panel(transitions, mixture, tmp_path / "p")
    sampler = panel.sampler(50, np.random.default_rng(0))
    rows, strata = sampler.draw()
    assert np.bincount(strata).tolist() == [10] * 5
    np.testing.assert_array_equal(panel.stratum_code[rows], strata)
    # Full correction: the mean weight of what is drawn is 1.
    weights = np.mean([sampler.weights[sampler.draw()[0]].mean() for _ in range(400)])
    assert weights == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("by", ["episode", "recording", "time"])
def test_held_out_data_shares_no_episode_with_the_panel(
    transitions: pa.Table, tmp_path: Path, by: str
) -> None:
    panel = build_panel(transitions, uniform(by=by), tmp_path / "p")
    held = pq.read_table(panel.path / "held_out.parquet")
    assert 0 < len(held) < 0.5 * len(transitions)
    assert len(held) + len(panel) == len(transitions)
    column = "recording_id" if by == "recording" else "episode_id"
    assert not set(held[column].to_pylist()) & set(panel.meta[column].to_pylist())
    if by == "time":
        newest = max(panel.meta["stamp_ns"].to_pylist())
        stamps = dict(
            zip(
                transitions["transition_id"].to_pylist(),
                transitions["stamp_ns"].to_pylist(),
                strict=True,
            )
        )
        assert min(stamps[i] for i in held["transition_id"].to_pylist()) > newest


def test_one_recording_cannot_be_held_out_by_recording(tmp_path: Path) -> None:
    with pytest.raises(MixtureError, match="cannot be split"):
        build_panel(recording_transitions(1), uniform(by="recording"), tmp_path / "p")


def test_rows_of_two_tasks_are_refused_unless_one_is_chosen(tmp_path: Path) -> None:
    other = Task(body=TASK.body, actions=TASK.actions, sectors=6)
    path = write_store(tmp_path / "store", [recording_transitions(1)])
    write_store(path, [recording_transitions(2, task=other)], task=other)
    with Store(path) as store:
        with pytest.raises(StoreError, match="2 tasks"):
            build_panel(store, uniform(), tmp_path / "p")
        mixture = uniform(where=f"task_hash = '{other.hash}'")
        panel = build_panel(store, mixture, tmp_path / "p")
    assert panel.task == other
    assert panel.observation_size == other.observation_size


def test_a_panel_that_is_there_is_kept_unless_forced(transitions: pa.Table, tmp_path: Path) -> None:
    first = build_panel(transitions, uniform(), tmp_path / "p")
    with pytest.raises(PanelError, match="already there"):
        build_panel(transitions, uniform(n_step=3), tmp_path / "p")
    assert Panel.open(tmp_path / "p").id == first.id
    assert build_panel(transitions, uniform(n_step=3), tmp_path / "p", force=True).id != first.id
    (tmp_path / "mine").mkdir()
    with pytest.raises(PanelError, match="already there"):
        build_panel(transitions, uniform(), tmp_path / "mine", force=True)


def test_an_interruption_leaves_nothing(
    transitions: pa.Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "_header", interrupt)
    with pytest.raises(KeyboardInterrupt):
        build_panel(transitions, uniform(), tmp_path / "p")
    assert list(tmp_path.iterdir()) == []


def test_damage_is_found(transitions: pa.Table, tmp_path: Path) -> None:
    panel = build_panel(transitions, uniform(), tmp_path / "p")
    rows = panel.path / ROWS
    Panel.open(panel.path, verify=True)
    assert not rows.stat().st_mode & 0o222
    rows.chmod(0o644)
    content = bytearray(rows.read_bytes())
    content[6000] ^= 1  # between two of the blocks that every opening looks at
    rows.write_bytes(content)
    Panel.open(panel.path)
    with pytest.raises(PanelError, match="checksum"):
        Panel.open(panel.path, verify=True)
    content[-1] ^= 1
    rows.write_bytes(content)
    with pytest.raises(PanelError, match="checksum"):
        Panel.open(panel.path)
    rows.write_bytes(content[:-4])
    with pytest.raises(PanelError, match="bytes, not the"):
        Panel.open(panel.path)
    rows.unlink()
    with pytest.raises(PanelError, match="missing"):
        Panel.open(panel.path)


def test_what_is_no_panel_is_said_to_be_none(tmp_path: Path) -> None:
    with pytest.raises(PanelError, match="no such panel"):
        Panel.open(tmp_path / "nowhere")
    with pytest.raises(PanelError, match="not a panel"):
        Panel.open(tmp_path)
    (tmp_path / "panel.json").write_text('{"id": 3}')
    with pytest.raises(PanelError, match="header cannot be read"):
        Panel.open(tmp_path)


def test_the_tensor_is_the_rows(transitions: pa.Table, tmp_path: Path) -> None:
    panel = build_panel(transitions, uniform(), tmp_path / "p")
    np.testing.assert_array_equal(panel.tensor().numpy(), panel.rows)
    with pytest.raises(ValueError, match="read-only"):
        panel.rows[0, 0] = 1.0
