"""Panels built from a plain table of transitions, here of CartPole: no robot, no store."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.panels import NO_SPLIT, panel_of
from support.shell import Shell

from restock.errors import RestockError
from restock.replay import Panel, sampler_for

Rows = list[dict[str, Any]]
UNCORRECTED = 'correction = {pre = "none", post = "none"}\n'
QUOTAS = f"{UNCORRECTED}{NO_SPLIT}[[strata]]\nname = 'rare'\nshare = 0.3\n[each_condition]\n"


def cartpole_rows(episodes: int = 40, limit: int = 30) -> Rows:
    """Return CartPole rows under random actions; episodes that begin tilted are labelled rare."""
    env, rng, rows = gym.make("CartPole-v1", max_episode_steps=limit), np.random.default_rng(0), []
    for episode in range(episodes):
        before, _ = env.reset(seed=episode)
        done, condition = False, "nominal" if abs(before[2]) < 0.04 else "rare"
        while not done:
            action = int(rng.integers(2))
            after, reward, terminated, truncated, _ = env.step(action)
            row = {"observation": before, "action": action, "reward": reward, "episode": episode}
            row |= {"terminated": terminated, "truncated": truncated, "condition": condition}
            rows.append(row | {"after": after, "speed": float(before[1])})
            before, done = after, terminated or truncated
    return rows


ROWS = cartpole_rows()


def table(rows: Rows = ROWS, *without: str, after: str = "after") -> pa.Table:
    plain = pa.Table.from_pylist(rows).drop_columns(list(without))
    return plain.rename_columns([after if name == "after" else name for name in plain.column_names])


def test_panel_holds_table_rows(tmp_path: Path) -> None:
    panel = panel_of(table(after="next_observation"), f"n_step = 1\n{QUOTAS}", tmp_path / "p")
    part, order = panel.columns, panel.meta["transition_id"].to_numpy()
    for name, of in (("observation", "observation"), ("next_observation", "after")):
        expected = np.stack([ROWS[row][of] for row in order])
        np.testing.assert_array_equal(panel.rows[:, part[name]], expected)
    ended = np.array([ROWS[row]["terminated"] for row in order])
    np.testing.assert_array_equal(panel.rows[:, part["discount"]][:, 0] == 0, ended)
    assert panel.meta["condition"].to_pylist() == [ROWS[row]["condition"] for row in order]
    assert len(panel) == len(ROWS)


def test_missing_next_observation_is_read_from_next_row(tmp_path: Path) -> None:
    """The last row of a truncated episode has no next row: it is left out and counted."""
    panel = panel_of(table(ROWS, "after"), QUOTAS, tmp_path / "p")
    given = panel_of(table(after="next_observation"), QUOTAS, tmp_path / "given")
    lost = sum(row["truncated"] and not row["terminated"] for row in ROWS)
    assert lost > 0
    assert panel.header.left_out == {"last of an episode, without a next observation": lost}
    kept = np.isin(given.meta["transition_id"].to_numpy(), panel.meta["transition_id"].to_numpy())
    bootstraps = panel.rows[:, panel.columns["discount"]][:, 0] > 0
    np.testing.assert_array_equal(panel.rows[bootstraps], given.rows[kept][bootstraps])


def test_row_order_does_not_change_panel(tmp_path: Path) -> None:
    places: dict[int, int] = {}
    steps = []
    for number, row in enumerate(ROWS):
        first = places.setdefault(row["episode"], number)
        steps.append({**row, "step_index": number - first, "transition_id": number})
    mixed = [steps[row] for row in np.random.default_rng(0).permutation(len(steps))]
    for n_step in (1, 3):
        text = f"n_step = {n_step}\n{QUOTAS}"
        in_order = panel_of(table(steps, "after"), text, tmp_path / f"a{n_step}")
        shuffled = panel_of(table(mixed, "after"), text, tmp_path / f"b{n_step}")
        np.testing.assert_array_equal(in_order.rows, shuffled.rows)


def test_parquet_file_is_mixed_like_table(tmp_path: Path, shell: Shell) -> None:
    pq.write_table(table(ROWS, "after"), tmp_path / "log.parquet")
    (tmp_path / "mixture.toml").write_text(QUOTAS)
    options = ["--mixture", str(tmp_path / "mixture.toml"), "--out", str(tmp_path / "cli")]
    assert "rows of the table" in shell.out("mix", tmp_path / "log.parquet", *options)
    panel = panel_of(table(ROWS, "after"), QUOTAS, tmp_path / "p")
    assert Panel.open(tmp_path / "cli").id == panel.id
    other = [{**row, "reward": 2.0} for row in ROWS]  # the id depends on the content
    assert panel_of(table(other, "after"), QUOTAS, tmp_path / "o").id != panel.id


def test_batches_meet_quotas(tmp_path: Path) -> None:
    """Strata are chosen by condition, or by SQL over any column of the table."""
    fast = QUOTAS.replace("name = 'rare'", "name = 'fast'\nwhere = \"speed > 0.5\"")
    for name, text in (("rare", QUOTAS), ("fast", fast)):
        panel = panel_of(table(ROWS, "after"), text, tmp_path / name)
        code = [stratum.name for stratum in panel.strata].index(name)
        sampler = sampler_for(panel, 20, seed=0)
        for _ in range(50):
            draw = sampler.draw()
            assert (panel.stratum_code[draw.rows] == draw.strata).all()
            assert (draw.strata == code).sum() == 6
        drawn = panel.rows[panel.stratum_code == code][:, panel.columns["observation"]]
        assert name == "rare" or (drawn[:, 1] > 0.5).all()


def edit(number: int, **values: Any) -> Callable[[], pa.Table]:
    rows = [*ROWS]
    rows[number] = {**rows[number], **values}
    return lambda: table(rows, "after")


OPEN = [{**row, "terminated": False, "truncated": False} for row in ROWS]
HALVES = [{**row, "action": row["action"] / 2} for row in ROWS]


@pytest.mark.parametrize(
    ("make_table", "message"),
    [
        (lambda: table(ROWS, "terminated", "truncated"), "it has no terminated, truncated"),
        (lambda: table(ROWS, "condition"), "it has no condition"),
        (lambda: table(OPEN, "after"), "no row ends an episode"),
        (edit(7, observation=[1.0, 2.0]), "row 7 has 2 entries, that of row 0 4"),
        (edit(0, next_observation=[1.0]), "next observation of row 0 does not have 4 entries"),
        (edit(3, reward=None), "row 3 lacks its observation, reward, end or episode"),
        (lambda: table(HALVES, "after"), "is not a whole number from 0 to 32,767"),
        (edit(5, action=-1), "the action of row 5 is not a whole number"),
        (edit(4, truncated=True), "row 5 follows the end of its episode"),
        (edit(6, condition=None), "1 rows have no coverage label"),
        (lambda: table([{**row, "condition": 1} for row in ROWS]), "condition must be text"),
        (
            lambda: table([{**row, "condition": "nominal"} for row in ROWS]),
            "stratum 'rare' is not a condition or exposure of these rows",
        ),
    ],
)
def test_invalid_tables_are_refused(
    tmp_path: Path, make_table: Callable[[], pa.Table], message: str
) -> None:
    with pytest.raises(RestockError, match=message):
        panel_of(make_table(), QUOTAS, tmp_path / "panel")
    assert not list(tmp_path.iterdir())
