"""`restock compare`: check whether two runs were fed the same, and which did better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from restock.cli.output import plain, print_json, print_sections, say
from restock.cli.words import Positional
from restock.errors import ConfigError, ExitCode

if TYPE_CHECKING:
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

    runs: Annotated[tuple[Path, ...], Positional("RUN")]
    """Two runs; or, with --against, all runs (seeds) of the first method."""
    against: tuple[Path, ...] = ()
    """The runs of the second method."""
    treatment: Literal["algorithm", "target", "mixture", "practice", "data", "method"] = "algorithm"
    """The treatment: what is compared, and therefore may differ."""
    json: bool = False
    """Print the verdict, the differences, the checks and the outcomes as JSON."""

    def run(self) -> int:
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
        if self.json:
            print_json(comparison.as_json())
        else:
            _show(comparison, _names(first, second))
        return int(ExitCode.OK if comparison.verdict == "comparable" else ExitCode.FAILED)


def _names(first: Sequence[Path], second: Sequence[Path]) -> tuple[str, str]:
    """Name each arm by its run, or by the common name of its runs without the seed."""
    names = []
    for paths in (first, second):
        stems = {path.name.rstrip("-_.0123456789") for path in paths}
        names.append(paths[0].name if len(paths) == 1 else stems.pop() if len(stems) == 1 else "")
    one, other = names
    return (one, other) if one and other and one != other else ("first", "second")


def _show(comparison: Comparison, names: tuple[str, str]) -> None:
    """Print what differs, the checks that failed, the verdict and the outcomes."""
    from restock.report import gate_section, outcome_section

    found = plain(comparison.as_json())
    failed = [check for check in found["checks"] if check["verdict"] != "comparable"]
    print_sections([gate_section({**found, "checks": failed}, *names)], folded=True)
    say(comparison.sentence)
    if comparison.rows:
        print_sections([outcome_section(found, *names)])
    for reason in dict.fromkeys(row["no_interval"] for row in comparison.rows):
        if reason is not None:
            say(f"no interval: {reason}")
