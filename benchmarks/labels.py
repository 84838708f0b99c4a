"""Labels against the truth, on fresh logs of the twin's stand-in: by step and by event.

    python benchmarks/labels.py --cache FOLDER [--part held-out] [--minutes 24] [--quick] [--bound]
    python benchmarks/labels.py --cache FOLDER --fit blocked_aisle
    python benchmarks/labels.py --cache FOLDER --verdicts

Records logs of seeds that no rule was set on, on the default floor and on `generated:test` floors
(`--part development`: the seeds and `generated:train` floors that the rules were set on; `seen`:
logs that were looked at while they were), ingests them, and prints precision and recall of each
condition, by events with 95 % intervals, and the reliability of the
probabilities. `--bound` adds the best that any rule could do: `label_bound.py`. `--fit` prints the
weights of a condition's `odds` that suit the development
logs best. `--verdicts` prints what a person's verdicts gain on the longer sample log, by doubt and
at random. What is in FOLDER is not recorded again; labels follow the rules as they are now.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from harness import finish, markdown, option_parser, run_restock
from label_bound import Log, bounds, has, logs_of, with_known
from scipy.optimize import minimize
from scipy.special import expit

from restock.arrays import F64
from restock.ingest.store.manifest import LabelScore, label_scores
from restock.ingest.store.transitions import replaced
from restock.ingest.task.conditions import let_values, shipped
from restock.ingest.task.schema import signal_columns, true_names
from restock.ingest.task.task import STORED_SIGNALS
from restock.replay.review.events import (
    DoubtfulEvent,
    doubtful_events,
)
from restock.replay.store.store import Store
from restock.stats import wilson
from restock.train.twin.recording.recorder import RecordingPlan, record

SEEDS = {
    "development": {"default": range(1001, 1009), "generated:train": range(1101, 1117)},
    "held-out": {"default": range(921, 927), "generated:test": range(931, 937)},
    "seen": {"default": range(901, 907), "generated:test": range(911, 917)},  # when rules were made
}
TARGETS = {"event": 0.9, "step": 0.85}
MONDAY = Path(__file__).parents[1] / "sample_logs" / "amr_monday.mcap"
RIDGE = 1e-3  # of standardised terms


def main() -> int:
    parser = option_parser(__doc__, quick="two logs of 6 minutes each")
    parser.add_argument(
        "--cache", type=Path, required=True, help="folder for recordings and stores"
    )
    parser.add_argument("--part", choices=sorted(SEEDS), default="held-out")
    parser.add_argument("--minutes", type=float, default=24.0, help="of each log")
    parser.add_argument("--bound", action="store_true", help="train networks: what is possible")
    parser.add_argument("--fit", metavar="CONDITION", help="print the weights that suit it best")
    parser.add_argument("--verdicts", action="store_true", help="print what verdicts gain")
    options = parser.parse_args()
    if options.verdicts:
        return print_verdicts(options)
    count = 2 if options.quick else None
    minutes = 6.0 if options.quick else options.minutes
    if options.fit:
        weights = fit(development(options.cache, minutes, count), options.fit)
        lines = [f"{value:+.2f} {name}" for name, value in weights.items()]
        return finish(options, weights, [], lines)
    stores = {
        floors: stored(options.cache, floors, list(seeds)[:count], minutes)
        for floors, seeds in SEEDS[options.part].items()
    }
    bound: dict[str, dict[str, LabelScore]] = {}
    if options.bound:
        measured = {floors: list(logs_of(path)) for floors, path in stores.items()}
        bound = bounds(development(options.cache, minutes, count), measured)
    lines = []
    figures: dict[str, Any] = {}
    missed: list[str] = []
    for floors, path in stores.items():
        with Store(path) as store:
            found = [one for one in scores_of(store) if one.condition in shipped()]
            bins = store.sql("FROM label_reliability").to_arrow_table().to_pylist()
        lines += [f"\n{options.part}, floors {floors}:\n", table(found, bound.get(floors, {}))]
        lines += ["", reliability_table(bins)]
        figures[floors] = {one.condition: vars(one) for one in found}
        missed += [miss for one in found for miss in misses(floors, one)]
    return finish(options, figures, missed, lines)


def development(cache: Path, minutes: float, count: int | None) -> list[Log]:
    """Return the steps of the development logs, kept in `cache` beside what is measured."""
    logs = []
    for floors, seeds in SEEDS["development"].items():
        for seed in list(seeds)[:count]:
            file = cache / f"{floors.replace(':', '_')}_{seed}_{minutes:g}.npz"
            if not file.exists():
                for one in logs_of(stored(cache, floors, [seed], minutes)):
                    np.savez_compressed(file, **one)
            with np.load(file) as kept:
                logs.append(with_known(dict(kept)))
    return logs


def stored(cache: Path, floors: str, seeds: Sequence[int], minutes: float) -> Path:
    """Return the store of these logs, newly labelled; missing ones are recorded and ingested."""
    cache.mkdir(parents=True, exist_ok=True)
    name = floors.replace(":", "_")
    store = cache / f"{name}_{seeds[0]}_{minutes:g}"
    for seed in seeds:
        log = cache / f"{name}_{seed}_{minutes:g}.mcap"
        if not log.exists():
            print(f"recording {log.name}", file=sys.stderr)
            record(log, RecordingPlan(minutes=minutes, seed=seed, layouts=floors))
        run_restock(["ingest", str(log), "--store", str(store)])
    run_restock(["store", "label", str(store)])
    return store


def scores_of(store: Store) -> list[LabelScore]:
    """Return each condition's counts over all recordings of a store."""
    names = [field.name for field in fields(LabelScore)]
    counts = ", ".join(f"sum({name})::BIGINT" for name in names[1:])
    query = f"SELECT condition, {counts} FROM label_scores GROUP BY condition ORDER BY condition"
    return [LabelScore(*row) for row in store.sql(query).fetchall()]


def table(found: Sequence[LabelScore], bound: Mapping[str, LabelScore]) -> str:
    """Return the table as the docs have it."""
    header = ["condition", "true steps", "precision", "recall", "true events", "event precision",
              "event recall", "bound: steps", "bound: events"]  # fmt: skip
    rows = []
    for one in found:
        best = bound.get(one.condition)
        rows.append(
            [
                f"`{one.condition}`",
                one.support,
                *(f"{share or 0:.2f}" for share in (one.precision, one.recall)),
                one.event_support,
                _of_events(one.event_right, one.event_labelled),
                _of_events(one.event_found, one.event_support),
                _pair(best.precision, best.recall) if best else "",
                _pair(best.event_precision, best.event_recall) if best else "",
            ]
        )
    return markdown(header, rows)


def _of_events(part: int, whole: int) -> str:
    low, high = wilson(part, whole)
    return f"{part / whole if whole else 0:.2f} ({low:.2f} to {high:.2f})"


def _pair(precision: float | None, recall: float | None) -> str:
    return f"{precision or 0:.2f} / {recall or 0:.2f}"


def reliability_table(bins: Sequence[Mapping[str, Any]]) -> str:
    """Return a row a condition, a column a tenth of probability: the share that is true."""
    names = sorted({row["condition"] for row in bins})
    one = {(row["condition"], round(row["from_probability"] * 10)): row for row in bins}
    rows = [
        [f"`{name}`", *(f"{one[name, tenth]['true_share']:.2f} of {one[name, tenth]['known']:,}"
                        if (name, tenth) in one else "" for tenth in range(10))]
        for name in names
    ]  # fmt: skip
    return markdown(["probability", *(f"{tenth / 10:g} to {tenth / 10 + 0.1:.1f}"
                                      for tenth in range(10))], rows)  # fmt: skip


def misses(floors: str, one: LabelScore) -> list[str]:
    """Return what of a condition is below its target."""
    shares = {
        "step": (one.precision, one.recall),
        "event": (one.event_precision, one.event_recall),
    }
    return [
        f"{floors}: {one.condition}: {kind} {name} {value or 0:.2f}, target {TARGETS[kind]}"
        for kind, values in shares.items()
        for name, value in zip(("precision", "recall"), values, strict=True)
        if (value or 0) < TARGETS[kind]
    ]


# -- the weights ------------------------------------------------------------------------------

_TERM = re.compile(r"([+-]\s*[\d.]+) \* (\w+)")
_CONSTANT = re.compile(r"[+-]\s*[\d.]+(?!\S| \*)")


def fit(logs: Sequence[Log], name: str) -> dict[str, float]:
    """Fit the weights of the terms of a condition's `odds` by logistic regression on these logs.

    `odds` is written as `+ .27 + 3.52 * near_m ...`, perhaps within `CASE WHEN`; each term is a
    `let`. It sees the steps whose odds that sum is, and no other branch's.
    """
    condition = shipped()[name]
    written = {term: _number(weight) for weight, term in _TERM.findall(condition.let["odds"])}
    constant = _CONSTANT.search(condition.let["odds"])
    if not written or constant is None:
        sys.exit(f"the `odds` of {name} are no sum such as `+ 0.27 + 3.52 * near_m`")
    parts = []
    for one in logs:
        values = let_values(steps_of(one), condition)
        terms = np.stack([values[term] for term in written], axis=1)
        total = _number(constant.group()) + terms @ np.array(list(written.values()))
        decided = one["known"] & (np.abs(total - values["odds"]) < 1e-3)
        parts.append((terms[decided], has(one, name)[decided]))
    x, y = (np.concatenate(part) for part in zip(*parts, strict=True))
    middle, scale = x.mean(0), x.std(0) + 1e-9
    scaled = (x - middle) / scale

    def loss(weights: F64) -> tuple[float, F64]:
        odds = scaled @ weights[1:] + weights[0]
        wrong = expit(odds) - y
        gradient = np.concatenate([[wrong.mean()], (wrong[:, None] * scaled).mean(0)])
        gradient[1:] += 2 * RIDGE * weights[1:]
        value = np.logaddexp(0, odds).mean() - (odds * y).mean() + RIDGE * (weights[1:] ** 2).sum()
        return float(value), gradient

    found = minimize(loss, np.zeros(1 + x.shape[1]), jac=True, method="L-BFGS-B").x
    weights = found[1:] / scale
    return {
        "": float(found[0] - weights @ middle),
        **dict(zip(written, weights.tolist(), strict=True)),
    }


def _number(text: str) -> float:
    return float(text.replace(" ", ""))


def steps_of(one: Log) -> pa.Table:
    """Return the steps as conditions see them, of a log's signals."""
    columns = signal_columns({s.name: one[s.name].astype(s.dtype) for s in STORED_SIGNALS})
    places = {name: one[name].astype(np.int64) for name in ("episode_index", "step_index")}
    return pa.table(places | columns)


# -- what verdicts gain -----------------------------------------------------------------------

VERDICTS = (0, 30, 100)
RANDOM_ORDERS = 5


def print_verdicts(options: Any) -> int:
    """Print how good labels are after some verdicts of a person who knows the truth.

    The verdict on an event is its true steps. At random: the mean of orders of all events.
    """
    store = options.cache / "monday"
    run_restock(["ingest", str(MONDAY), "--store", str(store)])
    with Store(store) as opened:
        rows = opened.sql("FROM transitions ORDER BY episode_index, step_index").to_arrow_table()
        events = doubtful_events(opened)
        names = [condition.name for condition in opened.conditions()]
        period_s = opened.task().control_period_s
    orders = 2 if options.quick else RANDOM_ORDERS
    shuffles = [np.random.default_rng(seed).permutation(len(events)) for seed in range(orders)]
    places = {"by doubt": [np.arange(len(events))], "at random": shuffles}
    figures = {
        order: [
            np.mean([quality_after(rows, [events[at] for at in one[:count]], names, period_s)
                     for one in several], axis=0).tolist()
            for count in VERDICTS
        ]
        for order, several in places.items()
    }  # fmt: skip
    header = ["verdicts", *(f"{what}, {order}" for what in ("event precision", "event recall",
              "wrong steps") for order in places)]  # fmt: skip
    table = [
        [count, *(f"{figures[order][row][column]:.{digits}f}"
                  for column, digits in ((0, 3), (1, 3), (2, 0)) for order in places)]
        for row, count in enumerate(VERDICTS)
    ]  # fmt: skip
    lines = [f"{len(events)} events, {orders} random orders", "", markdown(header, table)]
    return finish(options, figures, [], lines)


def quality_after(
    rows: pa.Table, judged: Sequence[DoubtfulEvent], names: Sequence[str], period_s: float
) -> tuple[float, float, float]:
    """Return precision and recall of events, and wrong steps, once these events have verdicts."""
    truth = [true_names(text) for text in rows["true_condition"].to_pylist()]
    held = [set(one) for one in rows["conditions"].to_pylist()]
    places = zip(rows["episode_id"].to_pylist(), rows["step_index"].to_pylist(), strict=True)
    row_at = {place: row for row, place in enumerate(places)}
    for event in judged:
        steps = range(event.first_step, event.last_step + 1)
        own = [row_at[event.episode_id, step] for step in steps]
        true = [row for row in own if event.condition in truth[row]]
        for row in own:
            held[row].discard(event.condition)
        for row in range(true[0], true[-1] + 1) if true else ():
            held[row].add(event.condition)
    rows = replaced(rows, {"conditions": [sorted(one) for one in held]})
    scores = [one for one in label_scores(rows, names, period_s) if one.condition in names]

    def total(name: str) -> int:
        return sum(getattr(one, name) for one in scores)

    return (
        total("event_right") / total("event_labelled"),
        total("event_found") / total("event_support"),
        total("labelled") + total("support") - 2 * total("agreed"),
    )


if __name__ == "__main__":
    sys.exit(main())
