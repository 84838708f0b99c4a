"""A store of one episode: every shipped mixture packs it and reports the evaluation split."""

import re

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.stores import TASK, recording_transitions, write_store

from restock.replay.mixture.mixture import parse_mixture, shipped_mixtures
from restock.replay.panel.panel import Panel
from restock.replay.plan.exclusions import GAP_S, split_for_evaluation


def drive(steps: int) -> pa.Table:
    """Return the first steps of one episode."""
    table = recording_transitions(1, episodes=1, seed=3)  # 58 steps
    assert len(table) >= steps
    return table.slice(0, steps)


@pytest.mark.parametrize("name", shipped_mixtures())
def test_every_shipped_mixture_packs_one_episode(name, tmp_path, shell):
    store = write_store(tmp_path / "store", [drive(50)], task=TASK)
    options = ["--mixture", name, "--out", str(tmp_path / "panel")]
    text = shell.out("mix", store, *options)
    assert "held out: the last 10% of the one episode there is, after a gap of 2 s" in text
    panel = Panel.open(tmp_path / "panel", verify=True)
    assert panel.header.split_by == "within_episode"
    # 2 s of 0.2 s steps, less jitter.
    assert panel.header.left_out["gap before the evaluation split"] >= 9
    learnt = np.asarray(panel.meta_column("step_index"))
    assert learnt.max() < 50 - 5 - 9
    found = {
        one["audit"]: one
        for one in shell.json("audit", store, tmp_path / "panel", code={0, 1})["audits"]
    }
    assert found["leakage"]["status"] == "pass"


def test_mix_table_states_what_shares_refer_to(tmp_path, shell):
    """A stratum can be short of rows, and yet a larger part of the logged rows than wanted."""
    store = write_store(tmp_path / "store", [drive(50)], task=TASK)
    text = shell.out("mix", store, "--dry-run")
    fill = r"logged rows fill \d\.\d% of a batch, not 50\.0% \(\[sources\]\): there are not enough"
    assert re.search(fill, text)
    (header,) = (line for line in text.splitlines() if "wanted: %" in line)
    assert re.search(r"natural: % +wanted: % +drawn: % of +% of their", header)
    assert re.search(r"stratum .* of rows +of a batch +logged rows +gradient", text)
    (nominal,) = (line.split() for line in text.splitlines() if line.startswith(" nominal "))
    assert nominal[4] == "40"
    short = [line for line in text.splitlines() if ": short of rows" in line]
    assert len(short) >= 4
    assert not any("%" in line for line in short)


def test_episode_too_short_to_split_is_used_whole(tmp_path, shell):
    store = write_store(tmp_path / "store", [drive(20)], task=TASK)
    options = ["--mixture", "uniform", "--out", tmp_path / "panel"]
    document = shell.json("mix", store, *options)
    note = "nothing, as the one episode lasts 3.8 s: too short to split"
    assert document["evaluation_split"] == {"by": "none", "rows": 0, "note": note}
    assert document["rows"] == 20
    assert not Panel.open(tmp_path / "panel").splits


@settings(max_examples=40)
@given(
    lengths=st.lists(st.integers(1, 120), min_size=1, max_size=4),
    share=st.floats(0.05, 0.5),
    n_step=st.integers(1, 8),
)
def test_training_returns_end_before_held_out_rows(lengths, share, n_step):
    table = table_of(*lengths)
    step, names = table["step_index"].to_numpy(), table["episode_id"].to_pylist()
    split = f'by = "within_episode", share = {share}'
    text = (
        f"n_step = {n_step}\nevaluation_split = {{ {split} }}\n[each_condition]\nshare = 'natural'"
    )
    rows = split_for_evaluation(table, parse_mixture(text, where="test"))
    assert not (rows.held & rows.gap).any()
    learnt = ~rows.held & ~rows.gap
    for name in set(names):
        of = np.array(names) == name
        if (rows.held & of).any():
            first = step[rows.held & of].min()
            assert rows.held[of & (step >= first)].all()
            assert (step[learnt & of] + n_step < first).all()
            assert (first - step[learnt & of]).min(initial=10**6) * 0.2 >= GAP_S - 0.2
            assert learnt[of].mean() > 0.2


def table_of(*lengths: int) -> pa.Table:
    """Return steps of episodes of these lengths."""
    step = np.concatenate([np.arange(length) for length in lengths])
    names = [f"e{number}" for number, length in enumerate(lengths) for _ in range(length)]
    columns = {"step_index": step, "stamp_ns": step * 200_000_000, "admitted": step >= 0}
    return pa.table({"episode_id": pa.array(names).dictionary_encode(), **columns})


def test_few_episodes_hold_out_end_of_longest():
    """One of two whole episodes would be half of the rows, and all rows of its conditions."""
    mixture = parse_mixture("[each_condition]\nshare = 'natural'", where="test")
    table = table_of(180, 205)
    rows = split_for_evaluation(table, mixture)
    assert rows.by == "within_episode"
    assert rows.note == "the last 19% of the longest of 2 episodes, after a gap of 2 s"
    assert 0.08 < rows.held.mean() < 0.12
    assert not (rows.held | rows.gap)[:180].any()
    assert rows.held[-1]
    assert rows.gap.sum() in (10, 11)
    for lengths in ((40,) * 12, (9, 10)):  # enough episodes; episodes too short for a gap
        rows = split_for_evaluation(table_of(*lengths), mixture)
        assert rows.by == "episode"
        assert not rows.gap.any()
        assert rows.held.any()
