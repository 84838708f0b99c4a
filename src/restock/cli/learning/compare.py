"""`restock compare`: check whether two runs were fed the same, and which did better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from restock.train.judge.comparability import Check
    from restock.train.judge.compare import Comparison


@dataclass
class CompareCommand:
    """Compare two methods. Refused, with exit code 1, if their critics were fed differently.

    Name the treatment: the one thing that may differ. With `algorithm` (network, loss, optimizer)
    and `target` (the target rule), both arms must have been fed the same rows in the same mix
    (decided by an equivalence test over episodes) and evaluated in the same way. With `mixture`,
    the feed is compared; the store, the algorithm, the target rule, the evaluation and the numbers
    of steps and updates must be the same. With `practice`, the missions in the twin may differ
    (`practice.*`, `env.conditions`, `env.missions`), and the logs must have been sampled in the
    same way. With `data`, what both of these allow may differ together. With `method`, everything
    about how an arm learns may differ (replay, target rule, updates), but not the twin, the
    environment steps and the evaluation.

    With several seeds per arm: `restock compare runs/a1 runs/a2 --against runs/b1 runs/b2`

    Example: `restock compare runs/uniform runs/quotas --treatment mixture`
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Two runs; or, with --against, all runs (seeds) of the first method."""
    against: tuple[Path, ...] = ()
    """The runs of the second method."""
    treatment: Literal["algorithm", "target", "mixture", "practice", "data", "method"] = "algorithm"
    """The treatment: what is compared, and therefore may differ."""
    page: Path | None = None
    """Write an HTML page that opens without a network. Replaces an existing file."""
    json: bool = False
    """Print the verdict, the differences, the checks and the outcomes as JSON."""

    def run(self) -> int:
        from restock.cli.output import print_json, say
        from restock.errors import ConfigError, ExitCode
        from restock.train.judge.compare import compare

        first, second = self.runs, self.against
        if second and not first:
            raise ConfigError(
                "needs the runs of the first method, too",
                where="restock compare",
                remedy="give them before --against: RUN RUN --against RUN RUN",
            )
        if not second:
            if len(first) != 2:
                raise ConfigError(
                    f"needs two runs, got {len(first)}",
                    where="restock compare",
                    remedy="several seeds of a method: RUN RUN --against RUN RUN",
                )
            first, second = first[:1], first[1:]
        comparison = compare(first, second, treatment=self.treatment)
        if self.page is not None:
            say(f"wrote {_write(comparison, first, second, self.page)}")
        if self.json:
            print_json(comparison.as_json())
        else:
            _show(comparison)
        return int(ExitCode.OK if comparison.verdict == "comparable" else ExitCode.FAILED)


def _write(
    comparison: Comparison, first: Sequence[Path], second: Sequence[Path], out: Path
) -> Path:
    """Write the page, with the curves and costs that the comparison itself does not need."""
    from restock.cli.output import plain
    from restock.report import comparison_page, write_page
    from restock.train.study.contrasts import learning_curves, training_cost

    names = _names(first, second)
    arms = dict(zip(names, (first, second), strict=True))
    found = {
        **comparison.as_json(),
        "names": names,
        "sentence": _sentence(comparison),
        "curves": learning_curves(arms),
        "cost": training_cost(arms),
        "runs": {name: [str(path) for path in paths] for name, paths in arms.items()},
    }
    return write_page(comparison_page(plain(found)), out)


def _names(first: Sequence[Path], second: Sequence[Path]) -> tuple[str, str]:
    """Name each arm by its run, or by what its runs are all called but for a seed."""
    names = []
    for paths in (first, second):
        bare = {path.name.rstrip("-_.0123456789") for path in paths}
        names.append(paths[0].name if len(paths) == 1 else bare.pop() if len(bare) == 1 else "")
    one, other = names
    return (one, other) if one and other and one != other else ("first", "second")


def _show(comparison: Comparison) -> None:
    from restock.cli.output import print_table, say

    refused = {difference.setting for difference in comparison.refused}
    if comparison.differences:
        rows = [
            {
                "setting": difference.setting,
                "first": difference.first,
                "second": difference.second,
                "": "not allowed" if difference.setting in refused else difference.kind,
            }
            for difference in comparison.differences
        ]
        print_table(rows, title=f"what differs (treatment: {comparison.treatment})")
    checks = comparison.totals + comparison.checks
    deciding = comparison.deciding_checks
    shown = [check for check in checks if check.verdict != "comparable"]
    if shown and not comparison.identical:  # too few episodes show nothing of the same runs
        treated = {
            "mixture": " (the treatment: shown, not compared)",
            "method": " (the treatment: shown, not compared)",
            "data": " (the treatment: shown, not compared)",
            "practice": " (of fresh rows it is the treatment: shown, not compared)",
        }.get(comparison.treatment, "")
        print_table(
            [_check(check, decides=check in deciding) for check in shown],
            title=f"what was fed{treated}",
        )
    say(_sentence(comparison))
    if comparison.rows:
        of = (
            "restock eval's episodes"
            if comparison.source == "restock eval"
            else "the last evaluation"
        )
        print_table(
            [_outcome(row) for row in comparison.rows],
            title=f"success on the same episodes, from {of}",
        )
        for reason in dict.fromkeys(row["no_interval"] for row in comparison.rows):
            if reason is not None:
                say(f"no interval: {reason}")


def _check(check: Check, *, decides: bool) -> dict[str, Any]:
    from restock.errors import verdict_said

    return {
        "check": check.name,
        "of": check.part,
        "first": check.first,
        "second": check.second,
        "value": check.value,
        "interval": f"{check.low:.3g} to {check.high:.3g}",
        "limit": check.limit,
        "": verdict_said(check.verdict, decides=decides),
    }


def _outcome(row: dict[str, Any]) -> dict[str, Any]:
    from restock.stats import interval_text

    low, high = row["difference_low"], row["difference_high"]
    return {
        "perturbation": row["perturbation"],
        "condition": row["condition"],
        "episodes": row["episodes"],
        "first": _success(row["success"][0]),
        "second": _success(row["success"][1]),
        "difference [95 %]": ("" if row["difference"] is None else f"{row['difference']:+.2f}")
        + ("" if low is None else f" [{low:+.2f}, {high:+.2f}]"),
        "P(second better) [95 %]": interval_text(
            row["improvement"], row["improvement_low"], row["improvement_high"]
        ),
    }


def _success(value: float | None) -> str:
    return "no goal" if value is None else f"{value:.2f}"


def _sentence(comparison: Comparison) -> str:
    if comparison.identical:
        return "COMPARABLE: both sides are the same runs"
    if comparison.verdict == "comparable":
        what = {
            "mixture": "settings, steps",
            "practice": "settings, steps and the logs' part of the feed",
            "method": "environment, environment steps and evaluation",
        }.get(comparison.treatment, "settings, steps and feed")
        return (
            f"COMPARABLE: {what} are the same within the limits, except the {comparison.treatment}"
        )
    if comparison.refused:
        names = ", ".join(difference.setting for difference in comparison.refused)
        return (
            f"REFUSED: the runs differ in {names}, which is not what --treatment"
            f" {comparison.treatment} compares"
        )
    failed = [check for check in comparison.deciding_checks if check.verdict == comparison.verdict]
    names = ", ".join(dict.fromkeys(f"{check.name} ({check.part})" for check in failed[:4]))
    more = f" and {len(failed) - 4} more" if len(failed) > 4 else ""
    if comparison.verdict == "inconclusive":
        return (
            f"REFUSED, inconclusive: too few episodes to show that {names}{more} are the same;"
            " add seeds to both sides (RUN RUN --against RUN RUN)"
        )
    return f"REFUSED: the critics were fed differently in {names}{more}"
