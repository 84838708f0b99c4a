"""Differences of two stores, or two versions of one: what was added, removed and changed.

Episodes are matched by recording and first stamp, whatever ingest wrote them; rows by id. Shares
and signals are compared as samples of episodes, with intervals.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from statistics import NormalDist
from typing import Any

import duckdb
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64
from restock.errors import StoreError
from restock.ingest.task.task import STORED_SIGNALS
from restock.process import interrupts_raised
from restock.replay.store.query import rows_of
from restock.replay.store.store import Store
from restock.stats import CONFIDENCE, NOT_KNOWN, TAILS, ConfidenceInterval

MIN_EPISODES = 5  # of each sample: fewer say nothing of its spread
_RESAMPLES_AT_ONCE = 50


@dataclass(frozen=True)
class Shift:
    """One figure of an episode in two samples."""

    episodes: tuple[int, int]
    mean: tuple[float, float]
    standardised: ConfidenceInterval  # difference of the means in units of their common spread
    ks: float  # the largest distance of the two distribution functions (Kolmogorov-Smirnov)
    p_value: float  # of that distance or a larger one, were both from one distribution


def shift(first: NDArray[Any], second: NDArray[Any]) -> Shift:
    """Compare a figure, one value per episode, in two samples (n,) and (m,); NaN is unknown.

    The interval of the standardised difference is the normal one of Hedges and Olkin (1985).
    From fewer than MIN_EPISODES episodes of either there is none, and no p-value.
    """
    samples = [np.asarray(values, np.float64) for values in (first, second)]
    a, b = (values[np.isfinite(values)] for values in samples)
    episodes = len(a), len(b)
    mean = tuple(float(values.mean()) if len(values) else float("nan") for values in (a, b))
    nan = float("nan")
    if min(episodes) < MIN_EPISODES:
        return Shift(episodes, (mean[0], mean[1]), NOT_KNOWN, nan, nan)
    from scipy.stats import ks_2samp

    test = ks_2samp(a, b)
    difference = standardised_difference(a, b)
    return Shift(
        episodes, (mean[0], mean[1]), difference, float(test.statistic), float(test.pvalue)
    )


def standardised_difference(first: F64, second: F64) -> ConfidenceInterval:
    """Return (mean(second) - mean(first)) / pooled spread, of two values each; 0 if all agree."""
    n, m = len(first), len(second)
    difference = float(second.mean() - first.mean())
    spread = np.sqrt(((n - 1) * first.var(ddof=1) + (m - 1) * second.var(ddof=1)) / (n + m - 2))
    if spread <= 1e-12 * max(abs(float(first.mean())), abs(float(second.mean())), 1e-12):
        value = 0.0 if abs(difference) <= 1e-12 else float(np.copysign(np.inf, difference))
        return ConfidenceInterval(value, value, value)
    value = difference / float(spread)
    error = np.sqrt((n + m) / (n * m) + value**2 / (2 * (n + m)))
    reach = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2) * float(error)
    return ConfidenceInterval(value, value - reach, value + reach)


def false_discovery_adjusted(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number (Benjamini and Hochberg 1995); NaN stays NaN.

    Of those that are below a level, at most that share is expected to be chance.
    """
    from scipy.stats import false_discovery_control

    adjusted = np.asarray(p_values, np.float64)
    known = np.isfinite(adjusted)
    if known.any():
        adjusted[known] = false_discovery_control(adjusted[known])
    return [float(value) for value in adjusted]


def share_differences(
    first: Any, second: Any, groups: Sequence[slice], *, rng: np.random.Generator,
    resamples: int = 1000,
) -> list[ConfidenceInterval]:  # fmt: skip
    """share in `second` less share in `first` of each value, with intervals over episodes.

    An episode that both have is one draw for both: what they share varies in neither. Resamples are
    Poisson's (each episode counts Poisson(1) times), which for shares equals drawing with
    replacement. A resample in which a sample has no rows is left out. With fewer than two episodes
    in a sample there is no interval: NaN. If a sample has no rows, there is no difference either.

    Args:
        first, second: scipy sparse (E, V) rows of each episode of either, by value.
        groups: the values of one question each, whose shares sum to 1.
    """
    episodes = first.shape[0]
    value = (
        _in_groups(first.sum(axis=0)[None], groups),
        _in_groups(second.sum(axis=0)[None], groups),
    )
    at = (value[1] - value[0])[0]
    if min(np.count_nonzero(sample.sum(axis=1)) for sample in (first, second)) < 2:
        return [ConfidenceInterval(float(one), float("nan"), float("nan")) for one in at]
    draws = []
    for start in range(0, resamples, _RESAMPLES_AT_ONCE):
        times = rng.poisson(1.0, (min(_RESAMPLES_AT_ONCE, resamples - start), episodes))
        weights = times.astype(np.float64)
        draws.append(_in_groups(weights @ second, groups) - _in_groups(weights @ first, groups))
    low, high = np.nanquantile(np.concatenate(draws), TAILS, axis=0)
    return [
        ConfidenceInterval(float(one), float(least), float(most))
        for one, least, most in zip(at, low, high, strict=True)
    ]


def _in_groups(rows: Any, groups: Sequence[slice]) -> F64:
    """Divide rows (R, V) by the totals of their groups; NaN for a sample without rows."""
    rows = np.asarray(rows, np.float64)
    shares: F64 = np.full(rows.shape, np.nan)
    for group in groups:
        total = rows[:, group].sum(axis=1, keepdims=True)
        np.divide(rows[:, group], total, out=shares[:, group], where=total > 0)
    return shares


# Columns of `transitions` whose values' shares are compared, as far as both stores have them.
SHARES_OF = ("primary_condition", "zone", "behaviour_policy", "robot", "site", "shift")
# Where and when, which shares of zones say.
_NOT_COMPARED = ("stamp_ns", "pose_stamp_ns", "pose_x_m", "pose_y_m", "pose_yaw_rad")
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class StoreDifference:
    """All of it; `document` has it as plain values."""

    sides: dict[
        str, dict[str, Any]
    ]  # a and b: path, version, task, recordings, episodes, rows, hours
    definitions: Rows  # of conditions, labels, profiles: those that differ
    recordings: Rows  # that are not the same in both
    episodes: Rows  # that are not the same in both
    same_episodes: int
    rows_paired: int  # of recordings that were written again, in both
    labels: Rows  # from, to, rows, episodes
    other_labels: int  # rows whose main condition stayed and whose other ones changed
    shares: Rows
    signals_of: dict[str, Any]  # which episodes the signals are compared over
    signals: Rows

    @property
    def different(self) -> bool:
        """Return whether anything but the version is."""
        return bool(self.definitions or self.recordings or self.labels or self.other_labels)

    def document(self) -> dict[str, Any]:
        """Return what `restock coverage diff --json` prints."""
        changed = {
            change: sum(row["change"] == change for row in self.episodes)
            for change in ("in", "out", "changed")
        }
        return {
            "kind": "store",
            "different": self.different,
            **self.sides,
            "definitions": self.definitions,
            "recordings": self.recordings,
            "episodes": {**changed, "same": self.same_episodes, "changes": self.episodes},
            "labels": {
                "rows_compared": self.rows_paired,
                "rows_changed": sum(row["rows"] for row in self.labels),
                "rows_with_other_changes": self.other_labels,
                "changes": self.labels,
            },
            "shares": self.shares,
            "signals": {**self.signals_of, "shifts": self.signals},
        }


@interrupts_raised
def diff_stores(first: Store, second: Store, *, seed: int = 0) -> StoreDifference:
    """Return what is different in `second`.

    Raises:
        StoreError: their rows are of different tasks, or cannot be read.
    """
    _same_task(first, second)
    with (
        tempfile.TemporaryDirectory(prefix="restock-") as spill,
        duckdb.connect(config={"temp_directory": spill}) as connection,
    ):
        try:
            first.attach(connection, "a")
            second.attach(connection, "b")
            script = files("restock.replay.fleet").joinpath("between.sql")
            connection.execute(script.read_text(encoding="utf-8"))
            return _difference(connection, first, second, np.random.default_rng(seed))
        except duckdb.OperationalError as error:
            raise StoreError(
                f"cannot be read: {str(error).splitlines()[0]}",
                where=f"{first.path} or {second.path}",
                remedy="`restock audit` shows which; restore its files, or ingest again",
            ) from error


def _same_task(first: Store, second: Store) -> None:
    tasks = [store.task_hashes() for store in (first, second)]
    if all(tasks) and tasks[0] != tasks[1]:
        names = [
            ", ".join(f"{task} (profile {store.profile_name(task)})" for task in sorted(hashes))
            for store, hashes in zip((first, second), tasks, strict=True)
        ]
        raise StoreError(
            f"its rows are of task {names[1]}, those of {first.path} version {first.version} of"
            f" {names[0]}: their observations, actions and rewards do not mean the same",
            where=f"{second.path} version {second.version}",
            remedy="ingest the recordings of one again with the other's profile"
            " (`restock ingest … --profile`), into a store of its own",
        )


def _difference(
    connection: duckdb.DuckDBPyConnection, first: Store, second: Store, rng: np.random.Generator
) -> StoreDifference:
    episodes = rows_of(connection, "FROM episode_changes")
    total = connection.sql("SELECT count(*) FROM episode_pairs").fetchall()[0][0]
    pairs, others = connection.sql(
        "SELECT count(*), count(*) FILTER (condition_a IS NOT DISTINCT FROM condition_b AND"
        " list_sort(conditions_a) IS DISTINCT FROM list_sort(conditions_b)) FROM row_pairs"
    ).fetchall()[0]
    compared, signals = _signals(connection)
    return StoreDifference(
        sides={
            "a": _side(connection, first, "a"),
            "b": _side(connection, second, "b"),
        },
        definitions=rows_of(connection, "FROM definition_changes"),
        recordings=rows_of(connection, "FROM recording_changes"),
        episodes=episodes,
        same_episodes=int(total) - len(episodes),
        rows_paired=int(pairs),
        labels=rows_of(connection, "FROM label_changes"),
        other_labels=int(others),
        shares=_shares(connection, rng),
        signals_of=compared,
        signals=signals,
    )  # fmt: skip


def _side(connection: duckdb.DuckDBPyConnection, store: Store, name: str) -> dict[str, Any]:
    counted = rows_of(
        connection,
        f"SELECT count(DISTINCT recording_id) AS recordings, count(*) AS episodes,"
        f" coalesce(sum(rows_{name}), 0)::BIGINT AS rows,"
        f" coalesce(sum(duration_{name}_s), 0) / 3600 AS hours"
        f" FROM episode_pairs WHERE episode_{name} IS NOT NULL",
    )[0]
    tasks = sorted(store.task_hashes())
    return {"path": str(store.path), "version": store.version, "tasks": tasks, **counted}


def _shares(connection: duckdb.DuckDBPyConnection, rng: np.random.Generator) -> Rows:
    """Return one row per value of each column: rows and share in both stores, and difference."""
    from scipy.sparse import csr_array

    dimensions = _in_both(connection, SHARES_OF)
    lines: Rows = []
    groups: list[slice] = []
    places: dict[str, list[Any]] = {side: [] for side in "ab"}  # (episode, value, rows)
    for dimension in dimensions:
        counted = {
            side: connection.sql(
                f"SELECT number, coalesce(CAST({dimension} AS VARCHAR), '(none)') AS value,"
                f" count(*) AS rows FROM {side}.transitions"
                f" JOIN episode_pairs ON episode_{side} = episode_id GROUP BY ALL"
            ).fetchnumpy()
            for side in "ab"
        }
        names = sorted({str(name) for found in counted.values() for name in found["value"]})
        if names == ["(none)"]:
            continue
        place = {name: len(lines) + index for index, name in enumerate(names)}
        groups.append(slice(len(lines), len(lines) + len(names)))
        lines += [{"of": dimension, "value": name} for name in names]
        for side, found in counted.items():
            at = np.array([place[str(name)] for name in found["value"]], np.int64)
            places[side].append((np.asarray(found["number"]), at, np.asarray(found["rows"])))
    if not lines:
        return []
    episodes = int(connection.sql("SELECT count(*) FROM episode_pairs").fetchall()[0][0])
    rows = {}
    for side, parts in places.items():
        number, column, count = (np.concatenate([part[i] for part in parts]) for i in range(3))
        shape = (episodes, len(lines))
        rows[side] = csr_array((count.astype(np.float64), (number.astype(np.int64), column)), shape)
    differences = share_differences(rows["a"], rows["b"], groups, rng=rng)
    totals = {side: np.asarray(matrix.sum(axis=0)).ravel() for side, matrix in rows.items()}
    for group in groups:
        for index in range(group.start, group.stop):
            line, difference = lines[index], differences[index]
            for side in "ab":
                line[f"rows_{side}"] = int(totals[side][index])
                whole = float(totals[side][group].sum())
                line[f"share_{side}"] = float(totals[side][index]) / whole if whole else None
            line |= {
                "difference": difference.value,
                "difference_low": difference.low,
                "difference_high": difference.high,
            }
    return lines


def _signals(connection: duckdb.DuckDBPyConnection) -> tuple[dict[str, Any], Rows]:
    """Compare episode means of each signal: those only in b against those of a.

    Where b has no episode of its own, those that are only in a against those of b.
    """
    counts = dict(
        connection.sql("SELECT change, count(*) FROM episode_pairs GROUP BY ALL").fetchall()
    )
    new = counts.get("in", 0) >= MIN_EPISODES
    if new and sum(counts.values()) > counts["in"]:
        of_a, of_b = "change <> 'in'", "change = 'in'"
        words = "the new episodes of b, compared with those of a"
    elif counts.get("out", 0) >= MIN_EPISODES and sum(counts.values()) > counts["out"]:
        of_a, of_b = "change = 'out'", "change <> 'out'"
        words = "the episodes of b, compared with those that were removed"
    else:
        return {"compared": None}, []
    columns = _in_both(
        connection, [signal.name for signal in STORED_SIGNALS if signal.name not in _NOT_COMPARED]
    )
    columns += _in_both(connection, ["reward", "action_residual"])
    columns += _custom(connection)
    means = ", ".join(f'avg(CAST("{name}" AS DOUBLE)) AS "{name}"' for name in columns)
    samples = [
        connection.sql(
            f"SELECT {means} FROM {side}.transitions JOIN episode_pairs"
            f" ON episode_{side} = episode_id WHERE {which} GROUP BY episode_id"
        ).fetchnumpy()
        for side, which in (("a", of_a), ("b", of_b))
    ]
    shifts = {name: shift(*(_known(sample[name]) for sample in samples)) for name in columns}
    adjusted = false_discovery_adjusted([one.p_value for one in shifts.values()])
    rows = [
        _signal(name, one, p_value)
        for (name, one), p_value in zip(shifts.items(), adjusted, strict=True)
        if min(one.episodes)
    ]
    rows.sort(key=lambda row: -abs(np.nan_to_num(row["standardised"], posinf=1e9, neginf=-1e9)))
    episodes = [len(next(iter(sample.values()))) for sample in samples]
    return {"compared": words, "episodes_a": episodes[0], "episodes_b": episodes[1]}, rows


def shifted(rows: Rows) -> Rows:
    """Return the signals whose mean shifted, at a false discovery rate of 5 %."""
    return [row for row in rows if row["p_adjusted"] is not None and row["p_adjusted"] < 0.05]


def _signal(name: str, one: Shift, adjusted: float) -> dict[str, Any]:
    return {
        "signal": name,
        "episodes_a": one.episodes[0],
        "episodes_b": one.episodes[1],
        "mean_a": one.mean[0],
        "mean_b": one.mean[1],
        "standardised": one.standardised.value,
        "standardised_low": one.standardised.low,
        "standardised_high": one.standardised.high,
        "ks": one.ks,
        "p_value": one.p_value,
        "p_adjusted": adjusted,
    }


def _known(values_: Any) -> Any:
    return np.ma.filled(np.ma.asarray(values_, np.float64), np.nan)


def _in_both(connection: duckdb.DuckDBPyConnection, names: Sequence[str]) -> list[str]:
    columns = [set(connection.sql(f"FROM {side}.transitions LIMIT 0").columns) for side in "ab"]
    return [name for name in names if all(name in found for found in columns)]


def _custom(connection: duckdb.DuckDBPyConnection) -> list[str]:
    """Return a profile's own signals that are numbers, of both stores."""
    names = [
        str(name)
        for side in "ab"
        for (name,) in connection.sql(
            "SELECT DISTINCT signal.name FROM (SELECT unnest(signals) AS signal"
            f" FROM {side}.recordings) ORDER BY ALL"
        ).fetchall()
    ]
    numeric = {"FLOAT", "DOUBLE", "BIGINT", "INTEGER", "SMALLINT", "BOOLEAN"}
    relation = connection.sql("FROM b.transitions LIMIT 0")
    kinds = dict(zip(relation.columns, map(str, relation.types), strict=True))
    return [
        name for name in _in_both(connection, list(dict.fromkeys(names))) if kinds[name] in numeric
    ]
