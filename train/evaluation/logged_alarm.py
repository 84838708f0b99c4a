"""An alarm from the logged episodes of a panel: those that failed, and those that did not."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pyarrow as pa

from restock.arrays import F32
from restock.ingest.live.alarm import WINDOW_S, Alarm, fit_alarm
from restock.ingest.live.pilot import OPERATORS
from restock.replay.panel.panel import Panel
from restock.replay.store.parquet_views import passed_in
from restock.train.evaluation.evaluate import STUCK_RADIUS_M, STUCK_WINDOW_S
from restock.train.evaluation.ope_dataset import panel_store

SAFE_ROWS = 50_000  # at most, of episodes chosen by hash: bounds memory and time


def logged_alarm(panel: Panel, miss_rate: float) -> Alarm:
    """Fit an alarm to the panel's episodes, as its first store has them at the panel's version.

    Raises:
        ConfigError: no such miss rate, or too few episodes that failed or did not.
        StoreError: the store is no longer there.
    """
    episodes = logged_episodes(panel)
    failed = [(failure, observation) for failure, observation in episodes if failure is not None]
    return fit_alarm(
        [observation for _, observation in failed],
        [failure for failure, _ in failed],
        [observation for failure, observation in episodes if failure is None],
        miss_rate=miss_rate,
        period_s=panel.task.control_period_s,
    )


def logged_episodes(panel: Panel) -> list[tuple[str | None, F32]]:
    """Return how each episode failed and its observations (n, D) before; all, if it did not."""
    query = files(__package__).joinpath("onsets.sql").read_text(encoding="utf-8")
    settings = {
        "people": list(OPERATORS),
        "steps": round(WINDOW_S / panel.task.control_period_s),
        "stuck_m": STUCK_RADIUS_M,
        "stuck_s": STUCK_WINDOW_S,
        "safe_rows": SAFE_ROWS,
    }
    wanted = pa.table({"episode_id": panel.meta["episode_id"].unique().cast(pa.string())})
    with panel_store(panel) as store, passed_in(store.connection, wanted=wanted):
        rows = store.connection.execute(query, settings).fetchall()
    return [(failure, np.array(observations, np.float32)) for failure, observations in rows]
