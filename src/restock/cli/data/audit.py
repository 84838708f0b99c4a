"""`restock audit`: check the coverage of a store, a panel and a run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import duckdb

from restock.cli import output
from restock.cli.words import Option, Positional, refuse
from restock.errors import ConfigError, ExitCode, RestockError, RunError, quoted
from restock.files import expect_file_place, read_json, write_text
from restock.ingest.store.location import Location
from restock.process import interrupts_raised
from restock.replay.places import RUN_CONFIG, beside_of, open_place
from restock.replay.store.audit import (
    OFFENDED,
    SAMPLE_ROWS,
    Audit,
    Finding,
    Severity,
    Status,
    Thresholds,
    check_thresholds,
    junit_suites,
    load_audits,
    load_thresholds,
    recommend_capacity,
    run_audits,
)
from restock.replay.store.definitions import install_named
from restock.replay.store.query import rows_of
from restock.replay.store.store import Store


@dataclass
class AuditCommand:
    """Check whether a store is good enough to learn from. Exits 1 if an audit fails.

    Each audit is a query that returns offending rows, with a severity: an error fails, a warning
    warns, an info informs. Audits of a panel or a run are skipped unless one is given.
    The thresholds are in replay/store/audits.toml; docs/audit.md lists all audits.

    With --against, everything that an earlier store or version held must still be there; with
    --baseline, the run must have passed `restock gate`. A comparison that is not possible fails,
    too. docs/audit.md has a workflow to copy.

    Example: `restock audit store/ runs/a --against store@41 --baseline runs/main`
    """

    store: Annotated[str, Positional("STORE")]
    """The store to audit. With --reward, it may also be a run."""
    second: Annotated[Path | None, Positional("PANEL|RUN")] = None
    """Also audit a panel that was made from the store, or the evaluation of a run."""
    third: Annotated[Path | None, Positional("RUN")] = None
    """Also audit the other of panel and run; either may come first."""
    against: Annotated[str | None, Option("OLD")] = None
    """The earlier store, or an earlier version (store@41): everything it held must still be
    there."""
    baseline: Annotated[str | None, Option("planner|RUN|FILE.onnx")] = None
    """The run must have passed `restock gate` against this baseline, written as for the gate."""
    audits: Annotated[Path | None, Option("DIR")] = None
    """A folder of your own audits (*.sql). An audit with the name of a shipped one replaces it."""
    thresholds: Annotated[Path | None, Option("FILE")] = None
    """A TOML file with thresholds that replace the shipped ones."""
    capacity: bool = False
    """Instead of auditing, show how coverage grows with the number of rows kept, and how many are
    enough."""
    reward: bool = False
    """Only check whether the reward agrees with the outcomes: print returns by driver, condition
    and outcome, and check that more success earns a higher return (docs/task.md)."""
    discount: float | None = None
    """With --reward on a store: the discount per step. Default: 0.99. For a run, the discount of
    its evaluations is used."""
    strict: bool = False
    """Warnings fail, too."""
    json: bool = False
    """Print one JSON document: {"store", "failed", "audits": [{"part", "audit", "status", …}]}."""
    junit: Annotated[Path | None, Option("FILE")] = None
    """Also write JUnit XML: one suite each for audits, difference and gate."""

    def run(self) -> int:
        """Run the audits and print them; return an exit code that tells whether one failed."""
        if (self.capacity or self.reward) and self.second is not None:
            option = "--capacity" if self.capacity else "--reward"
            raise ConfigError("takes one place", where=option, remedy=f"leave out {self.second}")
        if self.capacity:
            _refuse_with(self, "--capacity", "audits", "thresholds", "reward")
            _refuse_with(self, "--capacity", "discount", "strict", "junit")
            _refuse_with(self, "--capacity", "against", "baseline")
            return self._capacity()
        self._check_options()
        audits, thresholds = load_audits(self.audits), load_thresholds(self.thresholds)
        reward: RewardAudit | None = None
        if self.reward:
            reward = audit_reward(
                self.store,
                audits,
                thresholds,
                discount=self.discount,
            )
            parts = [Part("audit", reward.findings)]
        else:
            parts = [Part("audit", self._run_audits(audits, thresholds)), *self._comparisons()]
        failing = {"fail", "warn"} if self.strict else {"fail"}
        failed = sum(one.status in failing for part in parts for one in part.findings)
        self._write(parts, failing)
        if self.json:
            document: dict[str, Any] = {
                "store": str(self.store),
                "failed": failed,
                "audits": [_document(part.name, one) for part in parts for one in part.findings],
            }
            if reward is not None:
                document |= {
                    "discount": reward.discount,
                    "returns": reward.returns,
                    "order": reward.order,
                }
            output.print_json(document)
        elif reward is not None:
            _print_reward(reward)
        else:
            _print([one for part in parts for one in part.findings])
        return int(ExitCode.FAILED if failed else ExitCode.OK)

    def _beside(self) -> dict[str, Path]:
        return beside_of(place for place in (self.second, self.third) if place is not None)

    def _check_options(self) -> None:
        """Refuse options without effect and outputs that cannot be written, before any audit.

        Raises:
            ConfigError: an option has no effect, or an output file cannot be written.
            StoreError: a second or third PLACE is not a panel or a run, or both are of one kind.
        """
        if self.discount is not None and not (self.reward and 0 <= self.discount <= 1):
            raise ConfigError(
                f"must be within [0, 1], got {self.discount:g}"
                if self.reward
                else "applies only to --reward",
                where="--discount",
                remedy="give --reward, and the discount per step, for example 0.99",
            )
        if self.reward:
            _refuse_with(self, "--reward", "against", "baseline")
        if self.baseline is not None and "run" not in self._beside():
            raise ConfigError(
                "applies only to a run", where="--baseline", remedy="give the run after the store"
            )
        expect_file_place(self.junit, "--junit")

    def _run_audits(self, audits: Sequence[Audit], thresholds: Mapping[str, Any]) -> list[Finding]:
        given = self._beside()
        place = open_place(
            self.store,
            beside=given,
            only_store=True,
            opened=Store.verify,
        )
        with place as connection, output.progress("audits", len(audits)) as advance:
            return run_audits(
                connection, audits, thresholds, beside=given, done=lambda name: advance(1, name)
            )

    def _comparisons(self) -> list[Part]:
        """Compare the store with --against, and the run with --baseline, if they are given."""

        parts = []
        if self.against is not None:
            parts.append(Part("diff", self._difference(self.against)))
        if self.baseline is not None:
            from restock.train.judge.gate import passed_gate

            try:
                found = gate_findings(passed_gate(self._beside()["run"], self.baseline))
            except RestockError as error:
                found = failed_comparison("comparable", error, option=f"--baseline {self.baseline}")
            parts.append(Part("gate", found))
        return parts

    def _difference(self, old: str) -> list[Finding]:
        from restock.replay.fleet.store_difference import diff_stores

        try:
            with Store(old) as first, Store(self.store) as second:
                first.verify()
                return difference_findings(diff_stores(first, second), old=old)
        except RestockError as error:
            return failed_comparison("comparable", error, option=f"--against {old}")

    def _write(self, parts: Sequence[Part], failing: set[str]) -> None:
        """Write the findings as JUnit XML, if --junit was given."""
        if self.junit is not None:
            suites = {f"{part.name} {self.store}": part.findings for part in parts}
            write_text(self.junit, junit_suites(suites, failing))

    def _capacity(self) -> int:
        with open_place(self.store, only_store=True) as connection:
            capacity = recommend_capacity(connection)
        if self.json:
            output.print_json({"store": str(self.store), "capacity": asdict(capacity)})
            return int(ExitCode.OK)
        output.print_table(capacity.curve, title="what the newest rows cover")
        output.print_text(
            f"{capacity.recommended:,} rows: {capacity.reason}. A smaller buffer forgets cells "
            "that no sampling can bring back"
        )
        if not capacity.saturated:
            output.print_text(
                f"the newest half keeps {capacity.half_share:.0%}: the logs still add new cells, "
                "and more recordings will add more"
            )
        return int(ExitCode.OK)


def _refuse_with(command: AuditCommand, other: str, *names: str) -> None:
    refuse(command, names, f"cannot be combined with {other}", remedy="leave out one of them")


def _document(part: str, finding: Finding) -> dict[str, Any]:
    return {
        "part": part,
        "audit": finding.audit.name,
        "status": finding.status,
        "severity": finding.audit.severity,
        "rows": finding.rows,
        "doc": finding.audit.doc,
        "advice": finding.audit.advice,
        "thresholds": dict(finding.thresholds),
        "sample": finding.sample,
    }


def _print(findings: list[Finding]) -> None:
    """Print findings with their rows and advice, then the names of passed and skipped audits."""
    reported = [finding for finding in findings if finding.rows]
    if reported:
        output.print_table(
            [
                {
                    "audit": finding.audit.name,
                    "status": finding.status,
                    "rows": finding.rows,
                    "what it looks for": finding.audit.doc,
                }
                for finding in reported
            ]
        )
    for finding in reported:
        output.print_text()
        more = finding.rows - min(SHOWN, len(finding.sample))
        title = f"{finding.status}: {finding.audit.name}" + (f" ({more} more)" if more else "")
        output.print_table(finding.sample[:SHOWN], finding.columns, title=title)
        output.print_text(f"  {finding.audit.advice}")
    for status in ("pass", "skipped"):
        names = [finding.audit.name for finding in findings if finding.status == status]
        if names:
            output.print_wrapped(f"{status}: {', '.join(names)}")
    output.print_text(f"\n{_summary(findings)}")


def _print_reward(reward: RewardAudit) -> None:
    """Print returns by driver, and whether more success earns a higher return."""
    names = ("condition", "driver", "outcome", "episodes", "success_share")
    title = f"returns by driver, discounted by {reward.discount:g} a step"
    output.print_table(reward.returns, [*names, "discounted_mean", "return_mean"], title=title)
    output.print_text()
    pairs = [
        {
            "condition": row["condition"],
            "more success": row["driver"],
            "than": row["other"],
            "more by": _interval(row["success"] - row["other_success"], row["more_success"]),
            "return more by": _interval(
                row["discounted_return"] - row["other_discounted_return"], row["more_return"]
            ),
            "episodes": f"{row['episodes']}, {row['other_episodes']}",
            "verdict": row["verdict"] + (f": {row['why']}" if row["why"] else ""),
        }
        for row in reward.order
    ]
    if pairs:
        output.print_table(pairs, title="does more success earn more? [95 % intervals]")
    reported = Counter(row["verdict"] for row in reward.order)
    for finding in reward.findings:
        if finding.rows:
            output.print_text(f"{finding.status}: {finding.audit.doc}")
            output.print_text(f"  {finding.audit.advice}")
    counts = ", ".join(f"{reported[name]} {name}" for name in VERDICTS if reported[name])
    output.print_text(f"\n{counts or 'nothing to compare: undetermined'}")


VERDICTS = ("reversed", "undetermined", "agrees", "same success")  # for a pair of drivers


def _interval(value: float, ends: list[float]) -> str:
    from restock.stats import interval_text

    low, high = (None if math.isnan(end) else end for end in ends)
    return interval_text(value, low, high)


def _summary(findings: list[Finding]) -> str:
    """Count findings by status, and name what the skipped audits need."""
    past_tense = {"fail": "failed", "warn": "warned", "info": "informed", "pass": "passed"}
    counts = [
        f"{count} {word}"
        for status, word in past_tense.items()
        if (count := sum(finding.status == status for finding in findings))
    ]
    skipped = [finding.audit.place for finding in findings if finding.status == "skipped"]
    if skipped:
        places = " and ".join(f"a {place}" for place in sorted({place or "" for place in skipped}))
        counts.append(f"{len(skipped)} skipped (they need {places})")
    return ", ".join(counts)


SHOWN = 5  # rows of a finding on a terminal


class Part(NamedTuple):
    """The findings of one part of a check: the audits, the difference or the gate."""

    name: str
    findings: list[Finding]


def difference_findings(document: dict[str, Any], *, old: str) -> list[Finding]:
    """Return the difference of two stores (`diff_stores`) as findings.

    What the new store lost is a failure. Changed definitions and labels are a warning, because they
    may be intended. New recordings are for information.
    """
    recordings, episodes = document["recordings"], document["episodes"]
    gone = [row for row in recordings if row["change"] == "out"]
    changes = episodes["changes"]
    gone_ids = {row["recording_id"] for row in gone}
    lost = [
        row for row in changes if row["change"] == "out" and row.get("recording_id") not in gone_ids
    ]
    definitions = [row for row in document["definitions"] if row["what"] != "restock_version"]
    found: list[tuple[str, Severity, str, str, list[dict[str, Any]]]] = [
        ("recordings_lost", "error", f"Recordings that are in {old} but not in this store",
         "ingest them again, or compare with a store without them", gone),
        ("episodes_lost", "error",
         f"Episodes that are in {old} but not in this store, of recordings that are in both",
         "find out what changed: the profile, the conditions, or a damaged recording", lost),
        ("definitions_changed", "warning",
         "Conditions, labels or profiles with changed definitions",
         "if this was not intended, restore the old ones and ingest again", definitions),
        ("labels_changed", "warning", "Rows whose condition changed",
         "`restock coverage diff` shows all of them; `restock review STORE` lets a person"
         " check labels", document["labels"]["changes"]),
        ("recordings_new", "info", "Recordings that were added, or written again",
         "nothing to do: these recordings explain the differences",
         [row for row in recordings if row["change"] != "out"]),
    ]  # fmt: skip
    return [_make_finding(*one) for one in found]


def gate_findings(document: Mapping[str, Any]) -> list[Finding]:
    """Return a finding per test of a run's gate. It fails unless "not worse" has been shown."""
    from restock.train.judge.sequential import NOT_WORSE

    found = []
    for cell in document["cells"]:
        shown = {key: value for key, value in cell.items() if key != "curve" and value is not None}
        found.append(
            _make_finding(
                f"{cell['measure']}.{cell['perturbation']}.{cell['condition']}",
                "error",
                f"{cell['name']}: not worse than {document['baseline']}",
                "`restock compare` and `restock diagnose` help to find out why",
                [] if cell["verdict"] == NOT_WORSE else [shown],
            )
        )
    return found


def failed_comparison(name: str, error: RestockError, *, option: str) -> list[Finding]:
    """Return a failed finding for an impossible comparison, because pipelines must not pass it.

    `option` is the option that requested the comparison, with its value.
    """
    row = {"what": error.what, "where": error.where or ""}
    where = f"{error.where}: " if error.where and error.where not in option else ""
    advice = error.remedy or f"correct {option.split()[0]}, or leave it out"
    return [_make_finding(name, "error", f"{option}: {where}{error.what}", advice, [row])]


def _make_finding(
    name: str, severity: Severity, doc: str, advice: str, rows: Iterable[dict[str, Any]]
) -> Finding:
    every = list(rows)
    status: Status = OFFENDED[severity] if every else "pass"
    audit = Audit(name, severity, advice, doc, None, "")
    columns = list(every[0]) if every else []
    return Finding(audit, status, len(every), columns, every[:SAMPLE_ROWS], {})


DISCOUNT = 0.99  # default discount per step for a store
REWARD_AUDITS = ("reward_order", "reward_undetermined")
OF_RUN = "evaluated_"  # prefix of the audits that read a run's evaluations


@dataclass(frozen=True)
class RewardAudit:
    """The audit of the reward of a store or a run."""

    discount: float
    returns: list[dict[str, Any]]  # one row per condition, driver and outcome
    # One row per condition and pair of drivers. `more_return` is the interval of the difference of
    # their returns; its ends are NaN if a driver has fewer than three episodes.
    order: list[dict[str, Any]]
    findings: list[Finding]


@interrupts_raised
def audit_reward(
    place: str | Path,
    audits: Sequence[Audit],
    thresholds: Thresholds,
    *,
    discount: float | None = None,
) -> RewardAudit:
    """Check whether more success earns a higher return, in a store's logs or a run's evaluations.

    If a reward favours haste, a driver that touches something in a quarter of its missions can get
    a higher return than a driver that touches nothing, and an agent learns to touch. The returns
    of the drivers in the logs show this before any training.

    Args:
        place: a store, or a run.
        audits, thresholds: all audits and their thresholds; only the reward audits are run.
        discount: factor per step; None: the discount of the run, or DISCOUNT for a store.

    Raises:
        ConfigError: the run was evaluated with another discount, or a threshold names an unknown
            audit.
        RunError: the run was not evaluated, or an early version of Restock evaluated it.
        StoreError: `place` is neither a store nor a run.
    """
    folder = Location.of(place).folder
    of_run = folder is not None and (folder / RUN_CONFIG).is_file()
    names = [OF_RUN + name if of_run else name for name in REWARD_AUDITS]
    check_thresholds(audits, thresholds)
    chosen = [audit for audit in audits if audit.name in names]
    limits = {name: table for name, table in thresholds.items() if name in names}
    if of_run:
        assert folder is not None
        discount = _discount_of(folder, discount)
    discount = DISCOUNT if discount is None else discount
    beside = {"run": place} if of_run else {}
    with open_place(
        place,
        beside=beside,
        only_store=not of_run,
        opened=Store.verify,
    ) as connection:
        if of_run:
            _check_evaluated(connection, Path(place))
        else:
            install_named(connection, "driven_episodes returns_of return_order")
            connection.execute(
                "CREATE OR REPLACE VIEW driven_episodes AS"
                f" FROM discounted_episodes({float(discount)!r})"
            )
        findings = run_audits(connection, chosen, limits, beside=beside)
        source = "run.driven_episodes" if of_run else "driven_episodes"
        least = max(float(table["min_episodes"]) for table in limits.values())
        same = float(limits[names[1]]["same_success"])
        order = rows_of(connection, f"FROM return_order('{source}', {least!r}, {same!r})")
        for row in order:
            row["more_return"] = [math.nan if end is None else end for end in row["more_return"]]
        returns = rows_of(connection, f"FROM returns_of('{source}')")
        return RewardAudit(discount, returns, order, findings)


def _discount_of(run: Path, requested: float | None) -> float:
    config = read_json(run / RUN_CONFIG, error=RunError)["config"]
    discount = float(config["loss"]["discount"])
    if requested is not None and abs(requested - discount) > 1e-9:
        raise ConfigError(
            f"the evaluations of {run} are discounted by {discount:g}, not {requested:g}",
            where="--discount",
            remedy="leave it out: an evaluation does not keep its rewards by step",
        )
    return discount


def _check_evaluated(connection: duckdb.DuckDBPyConnection, run: Path) -> None:
    query = "SELECT table_name FROM information_schema.tables WHERE table_schema = 'run'"
    if ("driven_episodes",) not in connection.execute(query).fetchall():
        raise RunError(
            "has no evaluation with discounted returns",
            where=str(run),
            remedy=f"restock eval {quoted(run)} --policies agent,planner,operator --episodes 200"
            " --perturbations none",
        )
