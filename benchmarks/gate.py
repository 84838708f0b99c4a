"""Count how often the gate passes a policy that is worse, and how many episodes it takes.

    python benchmarks/gate.py --check
    python benchmarks/gate.py --figure docs/gate.png

Pairs of episodes are simulated: the baseline succeeds in 90 % of the missions, the policy is equal,
exactly at the margin (5 points worse), or 10 points worse, in one condition or in each, and the two
succeed together with a correlation. The bets are those of `restock gate`. Beside it stands the rule
of `restock eval --baseline --check`, which fails only what is shown to be worse.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from harness import finish, option_parser

from restock.arrays import F64
from restock.stats import mean_over_strata, wilson
from restock.train.judge.gate import ERROR, MEASURES, SUCCESS
from restock.train.judge.sequential import bets

BASELINE, MARGIN, BUDGET = 0.9, 0.05, 1000
CORRELATIONS = (0.0, 0.5, 0.9)
CONDITIONS = (1, 4, 12)
RUNS = 2000
EPISODES = (10, 30, 100, 300)  # of the old rule


def paired(worse: float, correlation: float, shape: tuple[int, ...], seed: int) -> F64:
    """Draw differences in success of a policy that is worse by so much."""
    policy = BASELINE - worse
    spread = np.sqrt(policy * (1 - policy) * BASELINE * (1 - BASELINE))
    both = min(policy * BASELINE + correlation * spread, policy)
    uniform = np.random.default_rng(seed).random(shape)
    up, down = policy - both, BASELINE - both
    return np.where(uniform < up, 1.0, np.where(uniform < up + down, -1.0, 0.0))


def decided_at(differences: F64) -> F64:
    """Return after how many pairs each row (n, pairs) is shown not to be worse; inf: never."""
    runs, pairs = differences.shape
    at, log_wealth = np.full(runs, -MARGIN), np.zeros(runs)
    total, squares, decided = np.zeros(runs), np.zeros(runs), np.full(runs, np.inf)
    measure = MEASURES[SUCCESS]
    for pair in range(pairs):
        bet, _ = bets(at, pair, total, squares, bound=measure.bound, variance=measure.variance)
        log_wealth += np.log1p(bet * (differences[:, pair] + MARGIN))
        total += differences[:, pair]
        squares += differences[:, pair] ** 2
        decided[(log_wealth >= np.log(1 / ERROR)) & np.isinf(decided)] = pair + 1
    return decided


def passes(conditions: int, worse: float, everywhere: bool, correlation: float) -> dict[str, Any]:
    """Simulate whole verdicts: all conditions must be decided."""
    decided = [
        decided_at(
            paired(worse if everywhere or not one else 0.0, correlation, (RUNS, BUDGET), seed)
        )
        for one, seed in enumerate(range(100, 100 + conditions))
    ]
    passed = int(np.isfinite(np.max(decided, axis=0)).sum())
    low, high = wilson(passed, RUNS)
    spent = np.minimum(np.array(decided), BUDGET)
    return {
        "conditions": conditions,
        "worse_by": worse,
        "everywhere": everywhere,
        "correlation": correlation,
        "passed": passed / RUNS,
        "low": low,
        "high": high,
        "pairs_of_a_condition": float(spent.mean()),
    }


def fixed_sample(passed: float, correlation: float) -> float:
    """Return the pairs with which a one-sided z test of a fixed sample has the same power."""
    from scipy.stats import norm

    variance = float(np.var(paired(0.0, correlation, (200_000,), 1)))
    z = norm.ppf(1 - ERROR) + norm.ppf(min(passed, 1 - 1 / RUNS))
    return float(variance * (z / MARGIN) ** 2)


def old_rule(episodes: int, worse: float, runs: int = 400) -> float:
    """Return how often the rule that fails only what is shown to be worse passes a policy."""
    rng = np.random.default_rng(0)
    shipped = 0
    for row in paired(worse, 0.5, (runs, episodes), 7):
        found = mean_over_strata([row], rng=rng)
        shipped += not (found.high < 0 and found.value < -MARGIN)
    return shipped / runs


def figure_rows() -> list[dict[str, Any]]:
    """Return the chance of shipping a policy 10 points worse, by episodes and rule."""
    decided = decided_at(paired(0.10, 0.5, (RUNS, BUDGET), 3))
    equal = decided_at(paired(0.0, 0.5, (RUNS, BUDGET), 4))
    rows = [
        {"episodes": count, "rule": "fails what is shown worse", "shipped": old_rule(count, 0.10)}
        for count in EPISODES
    ]
    for count in (*EPISODES, 600, BUDGET):
        for name, found in (("gate", decided), ("gate, an equal policy", equal)):
            rows.append(
                {"episodes": count, "rule": name, "shipped": float((found <= count).mean())}
            )
    return rows


def write_figure(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the chance of shipping a worse policy against episodes."""
    import altair as alt
    import vl_convert

    from restock.report.look.charts import CONFIG, plot

    chart = (
        plot(rows)
        .mark_line(point=True, strokeWidth=2)
        .encode(
            x=alt.X("episodes:Q", title="pairs of episodes", scale=alt.Scale(type="log")),
            y=alt.Y("shipped:Q", title="chance of passing", axis=alt.Axis(format="%")),
            color=alt.Color("rule:N", legend=alt.Legend(orient="top", columns=1, title=None)),
        )
        .properties(width=520, height=280)
        .configure(**{**CONFIG, "background": "white"})
    )
    out.write_bytes(vl_convert.vegalite_to_png(chart.to_dict(), scale=2))


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--figure", type=Path, help="also draw the figure of the documentation")
    options = parser.parse_args()
    rows = [
        passes(conditions, worse, everywhere, correlation)
        for conditions in CONDITIONS
        for correlation in CORRELATIONS
        for worse, everywhere in ((0.0, True), (MARGIN, False), (0.10, False))
    ]
    alone = [row for row in rows if row["conditions"] == 1 and row["worse_by"] == 0]
    fewer = [
        row["pairs_of_a_condition"] / fixed_sample(row["passed"], row["correlation"])
        for row in alone
    ]
    shipped = figure_rows()
    if options.figure is not None:
        write_figure(shipped, options.figure)
    missed = []
    if (low := max(row["low"] for row in rows if row["worse_by"] == MARGIN)) > ERROR:
        missed.append(f"at the margin more than {ERROR:.0%} pass: at least {low:.3f}")
    if (worse := max(row["passed"] for row in rows if row["worse_by"] == 0.10)) > 0:
        missed.append(f"a policy that is ten points worse passes: {worse:.4f}")
    if max(fewer) > 1:
        missed.append(f"equal policies take {max(fewer):.2f} of a fixed sample's pairs")
    lines = [
        f"{row['conditions']:>2} conditions, correlation {row['correlation']:.1f}, worse by"
        f" {row['worse_by']:.2f}: passed {row['passed']:.4f} [{row['low']:.4f},"
        f" {row['high']:.4f}], {row['pairs_of_a_condition']:.0f} pairs a condition"
        for row in rows
    ]
    lines += [
        f"equal policies, correlation {row['correlation']:.1f}: {share:.2f} of the pairs of a"
        " fixed sample with the same power"
        for row, share in zip(alone, fewer, strict=True)
    ]
    lines += [f"{row['episodes']:>5} pairs, {row['rule']}: {row['shipped']:.3f}" for row in shipped]
    figures = {"rows": rows, "pairs_of_a_fixed_sample": fewer, "figure": shipped}
    return finish(options, figures, missed, lines)


if __name__ == "__main__":
    sys.exit(main())
