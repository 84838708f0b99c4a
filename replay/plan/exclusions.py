"""Leave rows out of a panel, and count them by reason."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.errors import MixtureError, counted
from restock.ingest.task.schema import GOLDEN, splitmix64
from restock.replay.mixture.mixture import EvaluationSplit, Mixture
from restock.replay.plan.candidates import Places, bools, codes
from restock.replay.plan.strata import NO_STRATUM
from restock.replay.store.definitions import install_repeated_rows

DAY_NS = 86_400 * 10**9
# `by` of an evaluation split -> column and name of its groups. Other values use episodes as groups.
_GROUPS = {"recording": ("recording_id", "recording")} | {n: (n, n) for n in ("robot", "site")}
# If one whole episode is more than this multiple of the share, the end of an episode is held out.
_WHOLE_AT_MOST = 2.0
GAP_S = 2.0  # seconds left out before the held-out end of an episode
_GAP_AT_MOST = 0.25  # largest fraction of an episode that the gap may take
_LEFT_AT_LEAST = 0.2  # fraction of an episode's rows that must remain for learning
EPISODE_REPEATS = 3  # an episode is left out if this many of its rows repeat the evaluation split


@dataclass
class LeftOut:
    """Rows (N,) that are left out of a panel; each is counted under the first reason found."""

    gone: Bools
    admitted: Bools  # rows within the mixture's limits, including those held out for evaluation
    reasons: dict[str, int] = field(default_factory=dict)

    def add(self, reason: str, rows: Bools) -> None:
        new = int((rows & ~self.gone).sum())
        if new:
            self.reasons[reason] = self.reasons.get(reason, 0) + new
        self.gone |= rows


def leave_out(table: pa.Table, mixture: Mixture, split: EvaluationRows, as_of_ns: int) -> LeftOut:
    """Return the rows to leave out before strata are assigned.

    `table` comes from `read_candidates`; ages count back from `as_of_ns`.

    Raises:
        MixtureError: every row is too old, or some have no label and the mixture refuses that.
    """
    none = np.zeros(len(table), np.bool_)
    out = LeftOut(none, ~none)
    out.add("refused by the mixture's `where`", ~bools(table, "admitted"))
    if mixture.safety is not None:
        unsafe = bools(table, "unsafe")
        if mixture.safety.leave_out == "episodes":
            episode = codes(table, "episode_id")
            unsafe = np.isin(episode, np.unique(episode[unsafe]))
        out.add("unsafe", unsafe)
    logged = table["logged_ns"].to_numpy()
    if mixture.max_age_days is not None:
        too_old = logged < as_of_ns - int(min(mixture.max_age_days * DAY_NS, 2.0**62))
        if too_old.all():
            youngest = (as_of_ns - int(logged.max())) / DAY_NS
            raise MixtureError(
                f"every row is older than max_age_days = {mixture.max_age_days:g}: the newest is"
                f" {youngest:,.1f} days old",
                remedy="raise it, or set in the mixture the date from which ages count back:"
                " as_of = 2026-01-31T00:00:00Z",
            )
        out.add("too old", too_old)
    out.admitted = ~out.gone
    out.add("evaluation split", split.held)
    out.add("gap before the evaluation split", split.gap)
    no_label = ~bools(table, "labelled") & ~out.gone
    if no_label.any() and mixture.unlabelled == "refuse":
        raise MixtureError(
            f"{int(no_label.sum())} rows have no coverage label: their condition is unknown",
            remedy='`restock store label` the store, or set unlabelled = "drop" (or "nominal")',
        )
    if mixture.unlabelled == "drop":
        out.add("without a coverage label", no_label)
    if mixture.uncertain == "drop":
        out.add("with an uncertain condition", bools(table, "uncertain"))
    return out


@contextmanager
def repeats_installed(connection: duckdb.DuckDBPyConnection, mixture: Mixture) -> Iterator[None]:
    """Install the SQL that `repeats_of` needs, in a thread beside the `with` block.

    The block must not use `connection`. Raises StoreError if manifests cannot be read.
    """
    if mixture.evaluation_split.is_empty:
        yield
        return
    with ThreadPoolExecutor(1, "restock-repeats") as beside:
        installed = beside.submit(install_repeated_rows, connection)
        yield
        installed.result()


def repeats_of(
    connection: duckdb.DuckDBPyConnection, table: pa.Table, places: Places, evaluation_split: Bools
) -> Bools:
    """Find rows (N,) outside the evaluation split that repeat steps of the split under other ids.

    A store has such rows if it contains a recording and a part of it, or two recordings of one
    drive. If at least EPISODE_REPEATS rows of an episode repeat steps, all its rows are returned.
    Requires `repeats_installed` on the connection.

    Raises:
        MixtureError: all rows outside the split repeat its steps.
    """
    repeated = np.zeros(len(table), np.bool_)
    if not evaluation_split.any():
        return repeated
    found = connection.sql(
        "SELECT transition_id, same_as_transition_id FROM repeated_rows(1)"
    ).to_arrow_table()
    copy, original = (found[name].to_numpy() for name in found.column_names)

    def held(ids: Ints) -> Bools:
        place = places.of(ids)  # -1 if the row is not in `table`
        return np.asarray((place >= 0) & evaluation_split[place], np.bool_)

    originals = np.union1d(original[held(copy)], original[held(original)])
    same = places.of(np.concatenate([originals, copy[np.isin(original, originals)]]))
    repeated[same[same >= 0]] = True
    repeated &= ~evaluation_split
    episode = codes(table, "episode_id")
    whole = np.bincount(episode[repeated], minlength=1) >= EPISODE_REPEATS
    repeated |= np.isin(episode, np.flatnonzero(whole)) & ~evaluation_split
    if repeated.any() and (repeated | evaluation_split).all():
        raise MixtureError(
            f"all {int(repeated.sum())} rows outside the evaluation split repeat its steps:"
            " the same drive is in the store more than once",
            remedy="remove the repeated recordings with `restock store remove STORE RECORDING` "
            "(the audit `repeated_steps` lists them), or ingest more",
        )
    return repeated


def leave_out_of_strata(
    table: pa.Table,
    mixture: Mixture,
    stratum: NDArray[np.int16],
    out: LeftOut,
) -> Bools:
    """Leave out rows without a stratum, and rows beyond the cap per episode or recording.

    Returns the rows beyond a cap, (N,), because they still count for natural shares.

    Raises:
        MixtureError: rows without a stratum, if the mixture refuses them.
    """
    unlisted = (stratum == NO_STRATUM) & ~out.gone
    if unlisted.any() and mixture.unlisted == "refuse":
        seen = sorted(set(table["condition"].to_numpy(zero_copy_only=False)[unlisted]))
        raise MixtureError(
            f"{int(unlisted.sum())} rows belong to no stratum (conditions: {', '.join(seen)})",
            remedy="list a stratum for them, "
            + ("add [each_condition], " if mixture.each_condition is None else "")
            + 'or set unlisted = "drop"',
        )
    out.add("in no stratum", unlisted)
    beyond_any = np.zeros(len(table), np.bool_)
    for column, name in (("episode_id", "episode"), ("recording_id", "recording")):
        cap = getattr(mixture, f"max_rows_per_{name}")
        if cap is not None:
            beyond = beyond_cap(table, column, stratum, cap, out.gone, mixture.seed)
            beyond_any |= beyond
            out.add(f"beyond the cap of rows per {name}", beyond)
    return beyond_any


def beyond_cap(
    table: pa.Table,
    column: str,
    stratum: NDArray[np.int16],
    cap: int,
    gone: Bools,
    seed: int,
) -> Bools:
    """Find the rows (N,) to drop so that `cap` rows stay per stratum and episode (or recording).

    Which rows stay depends only on their ids and the seed: the first by `row_number() OVER
    (PARTITION BY stratum, episode ORDER BY hash(transition_id, seed))`.
    """
    rows = np.flatnonzero(~gone & (stratum != NO_STRATUM))
    order_of = scramble(table["transition_id"].to_numpy()[rows], seed)
    group = stratum[rows].astype(np.int64) * (len(table) + 1) + codes(table, column)[rows]
    order = np.lexsort((order_of, group))
    sorted_group = group[order]
    first = np.flatnonzero(np.append(True, sorted_group[1:] != sorted_group[:-1]))
    place = np.arange(len(rows)) - np.repeat(first, np.diff(np.append(first, len(rows))))
    beyond = np.zeros(len(table), np.bool_)
    beyond[rows[order]] = place >= cap
    return beyond


@dataclass(frozen=True)
class EvaluationRows:
    """The rows held out for evaluation, of N rows."""

    held: Bools  # (N,)
    gap: Bools  # (N,) just before a held-out end of an episode: not in the panel, not in the split
    by: str  # how rows were chosen, as in `EvaluationSplit.by`; may differ from the mixture's
    note: str = ""  # what was held out instead of whole groups, or why nothing was
    warning: str = ""  # set if far more was held out than requested

    @classmethod
    def none(cls, rows: int, note: str = "") -> EvaluationRows:
        """Return an object without held-out rows."""
        return cls(np.zeros(rows, np.bool_), np.zeros(rows, np.bool_), "none", note)


def split_for_evaluation(table: pa.Table, mixture: Mixture) -> EvaluationRows:
    """Choose the rows held out for evaluation.

    These are whole episodes, recordings, robots or sites, the latest episodes, or the end of each
    episode. If there is a single episode, its end is held out. If a single episode is chosen and
    has more than twice the requested share, it may contain all rows of a condition: then only the
    end of the longest episode is held out, and nothing of the other episodes. Episodes without a
    row that the mixture's `where` admits are ignored.

    Raises:
        MixtureError: the split would hold out everything, there is only one group, the mixture
            admits no row of a named robot, or it admits rows of an unknown robot or site.
    """
    episode = codes(table, "episode_id")
    admitted = np.isin(episode, np.unique(episode[bools(table, "admitted")]))
    if admitted.all():
        return _choose_rows(table, mixture)
    split = _choose_rows(table.filter(pa.array(admitted)), mixture)
    held, gap = np.zeros(len(table), np.bool_), np.zeros(len(table), np.bool_)
    held[admitted], gap[admitted] = split.held, split.gap
    return EvaluationRows(held, gap, split.by, split.note, split.warning)


def _choose_rows(table: pa.Table, mixture: Mixture) -> EvaluationRows:
    """Choose the rows for `split_for_evaluation`, from a table without episodes to ignore."""
    rule, seed = mixture.evaluation_split, mixture.seed
    if rule.is_empty:
        return EvaluationRows.none(len(table))
    episodes = len(np.unique(codes(table, "episode_id")))
    if rule.by == "within_episode" or (rule.by in ("episode", "time") and episodes == 1):
        return _ends_of_episodes(table, rule, mixture.n_step)
    held = _whole_groups(table, rule, seed)
    if rule.by == "episode" and held.mean() > _WHOLE_AT_MOST * rule.share:
        code = codes(table, "episode_id")
        longest = int(np.bincount(code).argmax())
        ends = _ends_of_episodes(table, rule, mixture.n_step, longest)
        if len(np.unique(code[held])) == 1 and ends.held.any():
            return ends
    none, warning = np.zeros(len(table), np.bool_), ""
    if not rule.robots and held.mean() > _WHOLE_AT_MOST * rule.share:
        column, group = _GROUPS.get(rule.by, ("episode_id", "episode"))
        kept, of = (len(np.unique(codes(table, column)[rows])) for rows in (held, ~none))
        finer = "within_episode" if group == "episode" else "episode"
        warning = (
            f"the evaluation split holds out {held.mean():.0%} of the rows instead of"
            f" {rule.share:.0%}: {kept} of {counted(of, group)}, whole; [evaluation_split]"
            f' by = "{finer}" is closer to that'
        )
    return EvaluationRows(held, none, rule.by, warning=warning)


def _ends_of_episodes(
    table: pa.Table, rule: EvaluationSplit, n_step: int, only: int | None = None
) -> EvaluationRows:
    """Hold out the last `share` of each episode, after a gap that no n-step return spans.

    With `only`, hold out the end of that one episode, about `share` of all rows.
    """
    episode, stamp_ns = codes(table, "episode_id"), table["stamp_ns"].to_numpy()
    step = table["step_index"].to_numpy()
    count, share = int(episode.max()) + 1, rule.share
    if only is not None:
        share = min(share * len(table) / int((episode == only).sum()), 1.0)
    first_ns, last_ns = np.full(count, np.iinfo(np.int64).max), np.zeros(count, np.int64)
    np.minimum.at(first_ns, episode, stamp_ns)
    np.maximum.at(last_ns, episode, stamp_ns)
    long_s = (last_ns - first_ns) * 1e-9
    # Do not split shorter episodes: the gap would take too much of them.
    split = (long_s * _GAP_AT_MOST >= GAP_S)[episode]
    if only is not None:
        split &= episode == only
    begin_ns = last_ns - (share * (last_ns - first_ns)).astype(np.int64)
    held = split & (stamp_ns > begin_ns[episode])
    first_held = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(first_held, episode[held], step[held])
    near = stamp_ns > begin_ns[episode] - round(GAP_S * 1e9)
    near |= step >= first_held[episode] - n_step
    rows_of = np.maximum(np.bincount(episode, minlength=count), 1)
    left = np.bincount(episode[~near], minlength=count) / rows_of
    held, near = (rows & (left > _LEFT_AT_LEAST)[episode] for rows in (held, near))
    if not held.any():
        short = f"the one episode lasts {long_s.max():.1f} s"
        if count > 1:
            short = f"no episode is longer than {long_s.max():.1f} s"
        return EvaluationRows.none(len(table), f"nothing, as {short}: too short to split")
    whole = "each episode" if rule.by == "within_episode" else "the one episode there is"
    if only is not None:
        whole = f"the longest of {len(np.unique(episode))} episodes"
    note = f"the last {share:.0%} of {whole}, after a gap of {GAP_S:g} s"
    return EvaluationRows(held, split & near & ~held, "within_episode", note)


def _whole_groups(table: pa.Table, rule: EvaluationSplit, seed: int) -> Bools:
    """Return the rows (N,) of the whole groups that are held out."""
    column, group = _GROUPS.get(rule.by, ("episode_id", "episode"))
    code = codes(table, column)
    without_tag = (code < 0) & bools(table, "admitted")
    if without_tag.any():
        of = len(np.unique(codes(table, "recording_id")[without_tag]))
        raise MixtureError(
            f"{int(without_tag.sum()):,} rows of {counted(of, 'recording')} have no {column}: "
            "they could belong "
            "to one that is held out",
            remedy=f"add it with `restock ingest RECORDING --tag {column}=…`, or leave them out:"
            f' where = "{column} IS NOT NULL"',
        )
    names = table[column].combine_chunks().dictionary.to_pylist()
    rows = np.bincount(code[code >= 0], minlength=len(names))
    if rule.robots:
        present = sorted(name for name, count in zip(names, rows.tolist(), strict=True) if count)
        if absent := sorted(set(rule.robots) - set(present)):
            raise MixtureError(
                f"evaluation_split.robots: the mixture admits no rows of {', '.join(absent)}",
                remedy=f"the robots are {', '.join(present)}",
            )
        if set(present) == set(rule.robots):
            raise MixtureError(
                "evaluation_split.robots names every robot: nothing would be left to learn from",
                remedy="name some of them",
            )
        return np.isin(code, [names.index(robot) for robot in rule.robots])
    if rule.by == "time":
        newest = np.zeros(len(names), np.int64)
        np.maximum.at(newest, code, table["logged_ns"].to_numpy())
        order = np.argsort(-newest, kind="stable")
    else:
        order = np.argsort([_hash(name, seed) for name in names], kind="stable")
    order = order[rows[order] > 0]
    if len(order) < 2:
        raise MixtureError(
            f"one {group} cannot be split into a panel and an evaluation split",
            remedy='ingest more, or set [evaluation_split] by = "none" in a mixture of your own',
        )
    wanted = rule.share * len(table)
    # Hold out as few groups as reach the share: at least one, never all.
    count = int(np.searchsorted(np.cumsum(rows[order]), wanted)) + 1
    chosen = order[: min(count, len(order) - 1)]
    return np.isin(code, chosen)


def _hash(name: str, seed: int) -> int:
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=7).digest()
    return int.from_bytes(digest, "big")


def scramble(ids: Ints, seed: int) -> NDArray[np.uint64]:
    """Return a hash of each id, which is the same on every machine and for any order of ids."""
    return splitmix64(ids.astype(np.uint64) + np.uint64((seed * GOLDEN + 1) % 2**64))
