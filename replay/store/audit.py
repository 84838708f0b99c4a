"""Audits: queries that return offending rows, one query per file, with a severity and advice.

Each file begins with a header:

    -- severity: error | warning | info
    -- advice: what to do about the rows it returns
    -- doc: what the rows are
    -- needs: run | panel          (only if it reads one; run.TABLE: a run that has this table)

`$name` in the query is a threshold, from `audits.toml` or a file by the user.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.resources import files
from importlib.resources.abc import Traversable
from numbers import Real
from pathlib import Path
from typing import Any, Literal, cast

import duckdb

from restock.errors import ConfigError, StoreError
from restock.files import first_line
from restock.process import interrupts_raised
from restock.renamed import AUDITS
from restock.replay.store.definitions import install_named, is_empty, rows_held
from restock.replay.store.parquet_views import damage
from restock.replay.store.query import found, interruptible, rows_of
from restock.toml import read_toml

Severity = Literal["error", "warning", "info"]
Status = Literal["pass", "fail", "warn", "info", "skipped"]
Thresholds = Mapping[str, Mapping[str, float | str]]

SAMPLE_ROWS = 10
OFFENDED: Mapping[Severity, Status] = {"error": "fail", "warning": "warn", "info": "info"}
WORST_FIRST: tuple[Status, ...] = ("fail", "warn", "info", "pass", "skipped")


@dataclass(frozen=True)
class Audit:
    """An audit's query and header."""

    name: str
    severity: Severity
    advice: str
    doc: str
    needs: str | None  # "run", "panel", or one of their tables, as in "run.sampled_episodes"
    sql: str

    @property
    def place(self) -> str | None:
        """Return what the audit reads besides the store: "run", "panel" or None."""
        return self.needs.split(".")[0] if self.needs else None

    @property
    def query(self) -> str:
        """Return the SQL without its header, so that words of the header do not create views."""
        return re.sub(r"\A(?:--.*\n)*", "", self.sql)

    @property
    def parameters(self) -> set[str]:
        """Return the thresholds that the query uses."""
        return set(re.findall(r"\$([A-Za-z_]\w*)", self.sql))


@dataclass(frozen=True)
class Finding:
    """The result of one audit."""

    audit: Audit
    status: Status
    rows: int  # number of offending rows
    columns: list[str]
    sample: list[dict[str, Any]]  # the first SAMPLE_ROWS of them
    thresholds: Mapping[str, float | str]


def shipped_audits() -> list[Audit]:
    """Return the audits that come with Restock, sorted by name."""
    return _load((files("restock.replay.store") / "audits").iterdir(), "restock")


def load_audits(folder: str | Path | None = None) -> list[Audit]:
    """Load the shipped audits and those of a folder, which replace shipped ones of the same name.

    Raises ConfigError for a folder without audits, or a file with an invalid header.
    """
    by_name = {audit.name: audit for audit in shipped_audits()}
    if folder is not None:
        path = Path(folder)
        if not path.is_dir() or not list(path.glob("*.sql")):
            what = "it contains no audits (*.sql)" if path.is_dir() else "no such folder"
            raise ConfigError(what, where=str(path))
        by_name |= {audit.name: audit for audit in _load(path.iterdir(), str(path))}
    return [by_name[name] for name in sorted(by_name)]


def load_thresholds(file: str | Path | None = None) -> dict[str, dict[str, float | str]]:
    """Load the shipped thresholds, and override them with those of a file.

    Raises ConfigError if the file is not TOML, or contains anything but tables of values.
    """
    shipped = (files("restock.replay.store") / "audits.toml").read_text(encoding="utf-8")
    thresholds: dict[str, dict[str, float | str]] = tomllib.loads(shipped)
    if file is None:
        return thresholds
    given = read_toml(Path(file))
    for name, table in given.items():
        if not isinstance(table, dict):
            raise ConfigError(
                f"{name!r} is not a table", where=str(file), remedy="write [audit] tables of values"
            )
        for key, value in table.items():
            _check_value(f"{name}.{key}", value, thresholds.get(name, {}).get(key), str(file))
        thresholds[name] = {**thresholds.get(name, {}), **table}
    return thresholds


def _check_value(key: str, value: object, shipped: float | str | None, where: str) -> None:
    """Refuse values of another type than the shipped threshold, and NaN, which no row exceeds."""
    number = not isinstance(value, bool) and isinstance(value, Real) and not math.isnan(value)
    if shipped is None or (number if isinstance(shipped, int | float) else isinstance(value, str)):
        return
    kind = "a number" if isinstance(shipped, int | float) else "a text"
    raise ConfigError(f"{key} must be {kind}, got {value!r}", where=where)


@interrupts_raised
def run_audits(
    connection: duckdb.DuckDBPyConnection,
    audits: Sequence[Audit],
    thresholds: Thresholds,
    *,
    beside: Iterable[str] = (),
    done: Callable[[str], None] = lambda name: None,
) -> list[Finding]:
    """Run audits over a connection with a store's views; return findings, the worst first.

    `beside` names the other schemas of the connection: "run", "panel". Audits that need a schema or
    table that does not exist (older runs lack some) are skipped. `done` is called with each name.

    Raises:
        ConfigError: an audit's SQL fails, a threshold is missing, or no audit uses a given one.
        StoreError: the store has no transitions, so no audit could find anything.
    """
    if is_empty(connection):
        raise StoreError(
            "it holds no transitions: there is nothing to audit",
            remedy="`restock ingest` recordings first",
        )
    check_thresholds(audits, thresholds)
    available = set(beside)
    available |= {
        f"{schema}.{table}" for schema, table in _tables(connection) if schema in available
    }
    findings = []
    with rows_held(connection, [audit.query for audit in audits]):
        for audit in audits:
            finding = Finding(audit, "skipped", 0, [], [], {})
            if audit.needs is None or audit.needs in available:
                finding = _run(connection, audit, thresholds.get(audit.name, {}))
            findings.append(finding)
            done(audit.name)
    return sorted(findings, key=lambda one: (WORST_FIRST.index(one.status), one.audit.name))


def _tables(connection: duckdb.DuckDBPyConnection) -> list[tuple[str, str]]:
    """Return schema and name of every table and view."""
    query = "SELECT table_schema, table_name FROM information_schema.tables"
    rows: list[tuple[str, str]] = connection.sql(query).fetchall()
    return rows


def junit_suites(suites: Mapping[str, Sequence[Finding]], failing: Collection[str]) -> str:
    """Write suites of findings as JUnit XML; those whose status is in `failing` fail."""
    from xml.etree.ElementTree import Element, SubElement, indent, tostring

    root = Element("testsuites")
    for name, findings in suites.items():
        suite = SubElement(
            root,
            "testsuite",
            name=_printable(name),
            tests=str(len(findings)),
            failures=str(sum(finding.status in failing for finding in findings)),
            errors="0",
            skipped=str(sum(finding.status == "skipped" for finding in findings)),
        )
        for finding in findings:
            case = SubElement(
                suite, "testcase", classname=_printable(name), name=finding.audit.name
            )
            lines = [f"{finding.rows} rows. {finding.audit.advice}", *map(str, finding.sample)]
            text = _printable("\n".join(lines))
            if finding.status in failing:
                SubElement(case, "failure", message=finding.audit.doc).text = text
            elif finding.status == "skipped":
                SubElement(case, "skipped", message=f"needs a {finding.audit.needs}")
            elif finding.rows:
                SubElement(case, "system-out").text = text
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _printable(text: str) -> str:
    """Replace the characters that XML 1.0 cannot contain, not even escaped."""
    return re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", text)


def _run(
    connection: duckdb.DuckDBPyConnection, audit: Audit, thresholds: Mapping[str, float | str]
) -> Finding:
    where = f"audit {audit.name!r}"
    if missing := sorted(audit.parameters - thresholds.keys()):
        raise ConfigError(
            f"no threshold {', '.join(missing)}",
            where=where,
            remedy=f"put it under [{audit.name}] in a file and give it with --thresholds",
        )

    def run() -> tuple[list[str], list[tuple[Any, ...]]]:
        install_named(connection, audit.query)
        return found(connection, audit.sql, dict(thresholds) or None)

    try:
        columns, rows = interruptible(connection, run)
    except duckdb.Error as error:
        if damaged := damage(error):
            raise damaged from error
        if type(error) is duckdb.Error or isinstance(error, duckdb.OperationalError):
            raise StoreError(
                f"is damaged or cannot be read: {first_line(error)}",
                remedy="restore its files from a copy, or ingest the recordings again",
            ) from error
        raise ConfigError(f"its SQL does not run: {error}", where=where) from error
    sample = [dict(zip(columns, row, strict=True)) for row in rows[:SAMPLE_ROWS]]
    status: Status = OFFENDED[audit.severity] if rows else "pass"
    return Finding(audit, status, len(rows), columns, sample, thresholds)


def check_thresholds(
    audits: Sequence[Audit], thresholds: Thresholds, *, others: bool = False
) -> None:
    """Refuse thresholds that no audit uses.

    If other audits may exist (`others`), unknown names are refused only if they look misspelt.

    Raises:
        ConfigError: an unknown name of an audit or threshold, or a value of another type than the
            shipped one.
    """
    used, shipped = {audit.name: audit.parameters for audit in audits}, load_thresholds()
    for name, table in thresholds.items():
        if name not in used:
            likely = get_close_matches(name, used, n=1, cutoff=0.9 if others else 0.6)
            if others and not likely and name not in AUDITS:
                continue
            remedy = _suggest(name, likely, f"the audits are {', '.join(used)}")
            raise ConfigError(f"no audit named {name!r}", where="thresholds", remedy=remedy)
        if unknown := sorted(table.keys() - used[name]):
            names = ", ".join(sorted(used[name])) or "none"
            likely = get_close_matches(unknown[0], used[name], n=1)
            raise ConfigError(
                f"{name}.{unknown[0]} is not a threshold of this audit",
                where="thresholds",
                remedy=_suggest(unknown[0], likely, f"its thresholds are {names}"),
            )
        for key, value in table.items():
            _check_value(f"{name}.{key}", value, shipped.get(name, {}).get(key), "thresholds")


def _suggest(name: str, likely: Sequence[str], known: str) -> str:
    if name in AUDITS:
        return AUDITS[name]
    return f"did you mean {likely[0]!r}?" if likely else known


def _load(entries: Iterable[Traversable], where: str) -> list[Audit]:
    ordered = sorted((e for e in entries if e.name.endswith(".sql")), key=lambda entry: entry.name)
    return [
        _parse(entry.name.removesuffix(".sql"), entry.read_text(encoding="utf-8"), where)
        for entry in ordered
    ]


def _parse(name: str, text: str, where: str) -> Audit:
    header = dict(re.findall(r"^-- (severity|advice|doc|needs): (.+)$", text, re.MULTILINE))
    for key in ("severity", "advice", "doc"):
        if key not in header:
            raise ConfigError(f"its header has no `-- {key}: …`", where=f"{where}/{name}.sql")
    if header["severity"] not in OFFENDED:
        raise ConfigError(
            f"severity {header['severity']!r} is not one of error, warning, info",
            where=f"{where}/{name}.sql",
        )
    return Audit(
        name=name,
        severity=cast(Severity, header["severity"]),
        advice=header["advice"],
        doc=header["doc"],
        needs=header.get("needs"),
        sql=text,
    )


CELLS_SHARE = 0.95
EFFECTIVE_EPISODES = 50.0


@dataclass(frozen=True)
class Capacity:
    """How coverage grows with a buffer's capacity, and the smallest capacity that is enough."""

    rows: int  # number of rows in the store
    cells: int  # number of condition x zone x action cells that have rows in the store
    recommended: int  # smallest number of newest rows that meets both requirements
    cells_share: float  # required share of the cells
    effective_episodes: float  # required number of effective episodes
    rows_for_cells: int  # smallest number of newest rows that keeps `cells_share`
    rows_for_episodes: int | None  # same for `effective_episodes`; None: all rows have fewer
    half_share: float  # share of the cells that the newest half of the rows keeps
    curve: list[dict[str, Any]]  # a row per capacity: cells, cells_share, conditions, episodes, …

    @property
    def saturated(self) -> bool:
        """Return whether the newest half of the rows already keeps `cells_share` of the cells."""
        return self.half_share >= self.cells_share

    @property
    def reason(self) -> str:
        """Return a sentence that explains the recommended capacity."""
        cells = (
            f"{self.rows_for_cells:,} of {self.rows:,} rows keep {self.cells_share:.0%} of the"
            f" {self.cells} condition x zone x action cells ever seen"
        )
        if self.rows_for_episodes is None:
            return (
                f"{cells}, and all of them are worth less than"
                f" {self.effective_episodes:g} effective episodes"
            )
        return (
            f"{cells}, and {self.rows_for_episodes:,} are worth"
            f" {self.effective_episodes:g} effective episodes"
        )


def recommend_capacity(
    connection: duckdb.DuckDBPyConnection,
    cells_share: float = CELLS_SHARE,
    effective_episodes: float = EFFECTIVE_EPISODES,
) -> Capacity:
    """Recommend a buffer's capacity: the smallest number of newest rows that keeps the diversity.

    These rows have `cells_share` of the condition x zone x action cells ever seen, and are worth
    `effective_episodes`. A smaller first-in-first-out buffer forgets whole cells, which no sampling
    brings back, or has rows of a few drives only.

    Raises StoreError if there are no transitions, ConfigError for a share outside [0, 1] or
    negative effective_episodes.
    """
    if not 0 <= cells_share <= 1 or not effective_episodes >= 0:
        raise ConfigError(
            f"cells_share must be in [0, 1], and effective_episodes at least 0, got {cells_share} "
            f"and {effective_episodes}"
        )
    install_named(connection, "capacity_curve capacity_needed")

    def run() -> tuple[list[dict[str, Any]], tuple[Any, ...]]:
        curve = rows_of(connection, "FROM capacity_curve()")
        needed = connection.execute(
            "FROM capacity_needed($cells, $episodes)",
            {"cells": cells_share, "episodes": effective_episodes},
        )
        return curve, needed.fetchall()[0]

    curve, (cells, for_cells, for_episodes) = interruptible(connection, run)
    if not curve:
        raise StoreError("it holds no transitions", remedy="`restock ingest` recordings first")
    rows = curve[-1]["capacity"]
    return Capacity(
        rows=rows,
        cells=cells,
        recommended=max(for_cells, rows if for_episodes is None else for_episodes),
        cells_share=cells_share,
        effective_episodes=effective_episodes,
        rows_for_cells=for_cells,
        rows_for_episodes=for_episodes,
        half_share=curve[-2]["cells_share"] if len(curve) > 1 else 1.0,
        curve=curve,
    )
