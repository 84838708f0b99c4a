"""Decide whether two arms differ only in the treatment: by their settings, and by what was fed.

A test for a difference does not suit feeds: with a million draws it rejects trifles, and it takes
rows of one episode for independent ones. So two feeds are comparable only if the data show that
they differ by *at most* a stated limit. Shares are of conditions, which mean the same in both runs;
the meaning of a stratum depends on its mixture. What a mixture fixes (the logged rows) is compared
directly. What is random (the fresh episodes) is resampled by whole episodes. Total variation
distance alone does not show a rare condition, so ratios of shares are checked, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from statistics import NormalDist
from typing import Any, Literal

import duckdb
import numpy as np
import pyarrow as pa

from restock.arrays import F64, Ints
from restock.errors import RunError
from restock.toml import by_path
from restock.train.run.run import Run

Verdict = Literal["comparable", "inconclusive", "incomparable"]
_CHECKS = 30  # approximate number of checks of random figures in a comparison
_ORDER: list[Verdict] = ["comparable", "inconclusive", "incomparable"]


@dataclass(frozen=True)
class ComparabilityLimits:
    """Limits within which two feeds count as the same."""

    distance: float = 0.02  # total variation distance between the mixes of the whole run
    tenth_distance: float = 0.05  # the same for a tenth of the run, which has fewer episodes
    share_ratio: float = 1.25  # ratio between the arms' shares of a condition
    share_floor: float = 0.0005  # ratios of shares that are smaller in both feeds are not checked
    unlabelled: float = 0.5  # share of the fresh rows drawn before their episode had labels
    episode_ratio: float = 1.5  # ratio between numbers of episodes that a condition was drawn from
    confidence: float = 0.95
    resamples: int = 1000


LIMITS = ComparabilityLimits()


@dataclass(frozen=True)
class Feed:
    """What one arm's critics were fed: draws by run, cell, tenth of the training and episode.

    A cell is a source and a condition. Each of the n rows sums the draws of one combination.
    """

    cells: list[str]  # "logs/wheel_slip", …
    cell: Ints  # (n,) index in `cells`
    tenth: Ints  # (n,) 0 to 9
    episode: Ints  # (n,) codes; fresh episodes of different runs have different codes
    run: Ints  # (n,) index of the run in its arm
    drawn: F64  # (n,) number of draws
    weight: F64  # (n,) sum of their importance weights


@dataclass(frozen=True)
class Check:
    """One check of comparability, with its verdict."""

    name: str  # "mix", "mix after weights", "share of logs/wheel_slip", …
    part: str  # "whole run", or "tenth 3"
    first: float | None  # the figure of each arm, if the check has one
    second: float | None
    value: float  # distance, or ratio of the larger to the smaller
    low: float  # lower end of the value's confidence interval
    high: float
    limit: float

    @classmethod
    def exact(cls, name: str, first: float, second: float, value: float, limit: float) -> Check:
        """Make a check of exact figures of the whole run, which have no interval."""
        return cls(name, "whole run", first, second, value, value, value, limit)

    @property
    def verdict(self) -> Verdict:
        if self.high <= self.limit:
            return "comparable"
        return "incomparable" if self.low > self.limit else "inconclusive"


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """Return the worst of several verdicts; "comparable" if there are none."""
    return max(verdicts, key=_ORDER.index, default="comparable")


def check_feeds(first: Feed, second: Feed, rng: np.random.Generator) -> list[Check]:
    """Run all checks. Both feeds must name the same cells in the same order."""
    checks = []
    totals = [_resampled(feed, rng) for feed in (first, second)]
    # Without importance weights, the mix after weights equals the mix before.
    weighted = any(not np.array_equal(feed.drawn, feed.weight) for feed in (first, second))
    for kind, name in enumerate(("mix", "mix after weights")[: 1 + weighted]):
        for tenth in (None, *range(10)):
            limit = LIMITS.distance if tenth is None else LIMITS.tenth_distance
            part = "whole run" if tenth is None else f"tenth {tenth + 1}"
            cells = slice(None) if tenth is None else slice(tenth, tenth + 1)
            a, b = (total[:, kind, cells].sum(1) for total in totals)
            fed = a[0].sum() > 0, b[0].sum() > 0
            if not all(fed):
                if any(fed):  # only one arm was fed in this tenth
                    checks.append(Check(name, part, None, None, 1.0, 1.0, 1.0, limit))
                continue
            with np.errstate(invalid="ignore"):  # a resample without rows is NaN, so inconclusive
                a, b = a / a.sum(1, keepdims=True), b / b.sum(1, keepdims=True)
            checks.append(_check_distance(name, part, a, b, limit))
            if tenth is None:
                checks += _check_ratios(first.cells, name, a, b)
    return checks + _check_unlabelled(first, second) + _check_episodes(first, second)


def _check_ratios(cells: Sequence[str], name: str, a: F64, b: F64) -> list[Check]:
    after = " after weights" if name.endswith("weights") else ""
    checks = []
    for index, cell in enumerate(cells):
        shares = float(a[0, index]), float(b[0, index])
        if max(shares) < LIMITS.share_floor:
            continue
        checks.append(_check_ratio(f"share of {cell}{after}", a[:, index], b[:, index]))
    return checks


def _check_unlabelled(first: Feed, second: Feed) -> list[Check]:
    """Check the share of fresh rows drawn before they had labels, if it is large in a feed."""
    fresh = [name.startswith("fresh/") for name in first.cells]
    shares = []
    for feed in (first, second):
        drawn = np.bincount(feed.cell, feed.drawn, len(feed.cells))
        unknown = [name == "fresh/unlabelled" for name in feed.cells]
        shares.append(float(drawn[unknown].sum() / max(drawn[fresh].sum(), 1e-12)))
    most = max(shares)
    if most <= LIMITS.unlabelled:
        return []
    name = "unlabelled share of fresh rows"
    return [Check(name, "whole run", shares[0], shares[1], most, 0.0, most, LIMITS.unlabelled)]


def _check_episodes(first: Feed, second: Feed) -> list[Check]:
    """Compare the numbers of episodes that each cell was drawn from, which are exact."""
    checks = []
    totals = [np.bincount(f.cell, f.drawn, len(f.cells)) / f.drawn.sum() for f in (first, second)]
    for index, cell in enumerate(first.cells):
        if max(total[index] for total in totals) < LIMITS.share_floor:
            continue
        one, other = _episodes_per_run(first, index), _episodes_per_run(second, index)
        value = max(one, other) / min(one, other) if min(one, other) else math.inf
        name = f"episodes of {cell}"
        checks.append(Check.exact(name, one, other, value, LIMITS.episode_ratio))
    return checks


def _episodes_per_run(feed: Feed, cell: int) -> float:
    """Return the number of distinct episodes that a cell was drawn from, averaged over runs."""
    drawn = feed.cell == cell
    pairs = np.stack([feed.run[drawn], feed.episode[drawn]])
    return float(np.unique(pairs, axis=1).shape[1] / (int(feed.run.max()) + 1))


def _check_distance(name: str, part: str, a: F64, b: F64, limit: float) -> Check:
    """Check the total variation distance of two mixes (1 + R, C): originals, then resamples."""
    values = np.abs(a - b).sum(1) / 2
    value = float(values[0])
    low, high, lowest, highest = _interval(values[1:])
    # Resampling adds noise: resamples are further apart than their originals, so their interval is
    # too high. Mirrored about the original distance, it is too low. Each end is taken from the
    # interval that reaches further, so that noise alone does not show "same" or "different".
    low, high = min(lowest, 2 * value - highest), max(high, 2 * value - low)
    return Check(name, part, None, None, value, max(low, 0.0), high, limit)


def _check_ratio(name: str, a: F64, b: F64) -> Check:
    """Check the ratio of larger to smaller share; a, b (1 + R,) are originals, then resamples."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(a) - np.log(b)
    logs[np.isnan(logs)] = 0.0  # both shares are 0
    low, high, lowest, highest = _interval(logs[1:])
    nearest = 0.0 if lowest <= 0 <= highest else min(abs(lowest), abs(highest))
    return Check(
        name,
        "whole run",
        float(a[0]),
        float(b[0]),
        float(np.exp(abs(logs[0]))),
        math.exp(nearest) if nearest < 700 else math.inf,
        math.exp(max(abs(low), abs(high))) if max(abs(low), abs(high)) < 700 else math.inf,
        LIMITS.share_ratio,
    )


def _interval(values: F64) -> tuple[float, float, float, float]:
    """Return the interval that may show "the same", and the wider one that may show "different".

    Feeds are the same only if all checks pass, but different if a single one fails. So the second
    interval is widened for the number of checks (Bonferroni); else noise would sometimes fail one.
    """
    tail = (1 - LIMITS.confidence) / 2
    # Not interpolated, as interpolation between two infinite ratios is NaN.
    low, high = np.quantile(values, [tail, 1 - tail], method="nearest")
    if not np.isfinite(values).all():
        return float(low), float(high), float(values.min()), float(values.max())
    # The wider interval reaches beyond the resamples, so it is that of a normal distribution.
    centre, spread = float(values.mean()), float(values.std())
    reach = NormalDist().inv_cdf(1 - tail / _CHECKS) * spread
    return float(low), float(high), centre - reach, centre + reach


def _resampled(feed: Feed, rng: np.random.Generator) -> F64:
    """Return draws and weights by tenth and cell, (1 + R, 2, 10, C): the originals, then resamples.

    A fresh episode is resampled as a whole, in all tenths and cells that it was drawn in. Logged
    rows stay as they are.
    """
    from scipy.sparse import csr_array

    cells = len(feed.cells)
    place = feed.tenth * cells + feed.cell
    amounts = (feed.drawn, feed.weight)
    counts = [np.bincount(place, a, 10 * cells).astype(np.float64) for a in amounts]
    total = np.stack(counts).reshape(2, 10, cells)
    sums: F64 = np.repeat(total[None], 1 + LIMITS.resamples, axis=0)
    random = np.array([name.startswith("fresh/") for name in feed.cells])
    fresh = random[feed.cell]
    if not fresh.any():
        return sums
    _, episode = np.unique(feed.episode[fresh], return_inverse=True)
    episodes = int(episode.max()) + 1
    matrices = [
        csr_array((a[fresh], (episode, place[fresh])), (episodes, 10 * cells)) for a in amounts
    ]
    for start in range(0, LIMITS.resamples, 100):
        stop = min(start + 100, LIMITS.resamples)
        # Each episode is drawn a Poisson number of times. Unlike multinomial draws, these have no
        # fixed total, which does not matter for shares.
        times = rng.poisson(1.0, (stop - start, episodes)).astype(np.float64)
        for kind, matrix in enumerate(matrices):
            drawn = (times @ matrix).reshape(-1, 10, cells)
            # The share of fresh rows is a setting and not random, so resamples are scaled to it.
            was, now = total[kind][:, random].sum(-1), drawn[..., random].sum(-1)
            drawn *= (was / np.maximum(now, 1e-12))[..., None]
            sums[1 + start : 1 + stop, kind][..., random] = drawn[..., random]
    return sums


Treatment = Literal["algorithm", "target", "mixture", "practice", "data", "method"]
Kind = Literal[
    "algorithm",
    "target",
    "feed",
    "practice",
    "environment",
    "store",
    "evaluation",
    "task",
    "software",
    "free",
]

# Treatment -> the kinds of settings that may differ; "free" and "software" always may.
ALLOWED: Mapping[Treatment, frozenset[Kind]] = {
    "algorithm": frozenset({"algorithm"}),
    "target": frozenset({"target"}),
    "mixture": frozenset({"feed", "environment"}),
    "practice": frozenset({"practice"}),
    "data": frozenset({"feed", "environment", "practice"}),  # all that the policy learns from
    # Off-policy and policy-gradient methods have no replay in common. So only the twin, its
    # conditions, the environment steps and the evaluation must be the same.
    "method": frozenset({"algorithm", "target", "feed"}),
}
_KINDS: dict[str, Kind] = {
    "config.seed": "free",
    "config.device": "free",
    "config.threads": "free",
    "config.record": "free",
    "config.profile": "free",  # a name or file; what it defines is compared in `profile`
    "config.target": "target",
    "config.evaluation.off_policy": "free",
    "config.evaluation": "evaluation",
    "config.network": "algorithm",
    "config.loss": "algorithm",
    "config.optimizer": "algorithm",
    "config.teacher": "algorithm",
    "config.practice": "practice",
    "config.env.conditions": "practice",
    "config.env.perturbation": "environment",
    "config.env.layouts": "environment",
    "config.env.missions": "practice",
    "config.env.missions_share": "practice",
    "config": "feed",  # replay, schedule, env, epsilon decide which rows are drawn and how often
    "panel.store": "store",
    "panel.store_version": "store",
    "panel.others": "store",
    "panel.labels_version": "store",
    "panel.path": "free",
    "panel": "feed",
    "task_hash": "task",
    "labels_version": "task",
    "profile": "task",
    "next_value": "algorithm",
    "versions": "software",
}
_NO_SETTING = frozenset(  # keys of config.json that are not settings, or follow from others
    {"format", "created_ns", "target", "seeds", "update_path", "profile_toml"}
)


@dataclass(frozen=True)
class Difference:
    """A setting in which two arms, or two runs of one arm, differ."""

    setting: str
    kind: Kind
    first: Any
    second: Any


class Arm:
    """Runs of one method. Raises RunError if their settings differ, or one has made no update."""

    def __init__(self, name: str, paths: Sequence[Path | str]) -> None:
        self.name = name
        self.runs = [Run.open(path) for path in paths]
        for run in self.runs:
            fed = run.table("sampled_episodes")
            if not fed.num_rows or fed["condition"].null_count:
                raise RunError(
                    "has no record of the episodes it sampled by condition",
                    where=str(run.path),
                    remedy="it has made no update yet, or was written by an older Restock: train "
                    "it again",
                )
        refuse_dependent(self.runs)

    @cached_property
    def totals(self) -> dict[str, float]:
        """Return the mean numbers of environment steps and of updates of the arm's runs."""
        for run in self.runs:
            if not run.table("progress").num_rows:
                raise RunError(
                    "is missing or has no rows, so the length of the run is unknown",
                    where=str(run.path / "progress.parquet"),
                    remedy="restore the file from a copy, or train the run again",
                )
        last = [
            run.table("progress").slice(run.table("progress").num_rows - 1) for run in self.runs
        ]
        return {
            name: float(np.mean([row[name][0].as_py() for row in last]))
            for name in ("env_steps", "gradient_steps")
        }

    def fed(self) -> pa.Table:
        """Return draws by run, cell, tenth and episode (`fed_mix.sql`)."""
        query = files("restock.train.judge").joinpath("fed_mix.sql").read_text(encoding="utf-8")
        parts = []
        with duckdb.connect() as connection:
            for number, run in enumerate(self.runs):
                connection.register("fed", run.table("sampled_episodes"))
                table: pa.Table = connection.sql(query).to_arrow_table()
                runs = pa.array([number] * table.num_rows, pa.int64())
                parts.append(table.append_column("run", runs))
        return pa.concat_tables(parts)


def refuse_dependent(runs: Sequence[Run]) -> None:
    """Refuse runs that are not independent seeds of one method, as their spread would be too small.

    Raises:
        RunError: there are no runs, their settings differ, or two runs are the same run, copies of
            it, or have the same seed.
    """
    if not runs:
        raise RunError("no run was given", remedy="give at least one of each method")
    by_seed: dict[Any, Run] = {}
    for run in runs:
        unlike = [
            difference
            for difference in differences(runs[0], run)
            if difference.kind not in ("free", "software")
        ]
        if unlike:
            raise RunError(
                f"differs from {runs[0].path} in {unlike[0].setting}"
                f" ({unlike[0].first!r} against {unlike[0].second!r}): the runs of one method "
                "may differ only in their seed",
                where=str(run.path),
                remedy="give runs of one method; `restock compare` takes the runs of another "
                "method after --against",
            )
        seed = run.document["config"].get("seed")
        other = by_seed.setdefault(seed, run)
        if other is run or seed is None:
            continue
        if other.path.resolve() == run.path.resolve():
            raise RunError("is given twice", where=str(run.path), remedy="leave one of them out")
        copied = same_run(other, run)
        raise RunError(
            f"is a copy of {other.path}" if copied else f"has the seed of {other.path}, {seed}",
            where=str(run.path),
            remedy="runs of one method count as independent seeds: leave one of them out"
            + ("" if copied else ", or train it again with another --set seed=N"),
        )


def same_run(first: Run, second: Run) -> bool:
    """Return whether two directories hold the same run: a copy has an equal config.json."""
    return first.document == second.document


def feeds(first: Arm, second: Arm) -> tuple[Feed, Feed]:
    """Return what each of two arms was fed; both feeds list the cells of both arms."""
    tables = first.fed(), second.fed()
    cells = sorted({name for table in tables for name in table["cell"].unique().to_pylist()})
    a, b = (_feed(table, cells) for table in tables)
    return a, b


def _feed(table: pa.Table, cells: list[str]) -> Feed:
    run = np.asarray(table["run"], np.int64)
    names = table["episode"].to_numpy(zero_copy_only=False).astype(str)
    fresh = np.asarray(table["source"].to_numpy(zero_copy_only=False) == "fresh")
    # Fresh episode 7 of one run is not that of another run; logged episodes are the same in all.
    owner = np.where(fresh, run, -1)
    _, episode = np.unique(
        np.char.add(np.char.add(owner.astype(str), "/"), names), return_inverse=True
    )
    place = {name: index for index, name in enumerate(cells)}
    cell = np.array([place[name] for name in table["cell"].to_pylist()], np.int64)

    def column(name: str) -> F64:
        return np.asarray(table[name], np.float64)

    return Feed(
        cells,
        cell,
        np.asarray(table["tenth"], np.int64),
        episode,
        run,
        column("drawn"),
        column("weight"),
    )


def differences(first: Run, second: Run) -> list[Difference]:
    """Return the settings in which two runs differ, each with the kind of difference."""
    a, b = _settings(first), _settings(second)
    if a.get("panel.id") is None or b.get("panel.id") is None:
        # If a run was fed no logs, keep only `panel.id`: the feed differs, not the store.
        for settings in (a, b):
            has = settings.get("panel.id") is not None
            for name in [name for name in settings if name.split(".")[0] == "panel"]:
                if not (name == "panel.id" and has):
                    del settings[name]
    for settings in (a, b):  # the natural rule ignores the other settings of practice
        if settings.setdefault("config.practice.rule", "natural") == "natural":
            for name in [n for n in settings if n.startswith("config.practice.")]:
                settings[name] = "natural" if name.endswith(".rule") else None
    return [
        Difference(name, kind_of(name), a.get(name), b.get(name))
        for name in dict.fromkeys([*a, *b])
        if a.get(name) != b.get(name)
    ]


def _settings(run: Run) -> dict[str, Any]:
    """Return a run's settings in `config.json`, by dotted name.

    Shares of strata are left out: `panel.id` covers them, and strata of two mixtures may have the
    same name and different rows.
    """
    document = run.document
    settings = by_path({key: document[key] for key in document if key not in _NO_SETTING})
    shares = ("panel.strata.", "panel.forecast")
    return {name: value for name, value in settings if not name.startswith(shares)}


def kind_of(setting: str) -> Kind:
    """Return the kind of a setting, by its longest prefix in `_KINDS`; else "algorithm"."""
    parts = setting.split(".")
    for length in range(len(parts), 0, -1):
        if (kind := _KINDS.get(".".join(parts[:length]))) is not None:
            return kind
    return "algorithm"
