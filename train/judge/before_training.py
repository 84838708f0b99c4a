"""Diagnose the rows of a panel or store before anything is trained, with the twin alone.

A critic that is fed consistent mistakes learns them, and no figure of its training shows it: logs
that swap left and right are consistent in themselves. So the rows are compared with fresh rows of
the twin and with the task's definitions. If the twin cannot be driven, the checks that do not
need it still run, and the others report why they did not.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError, RestockError, RunError, StoreError
from restock.ingest.profile.profile import Profile
from restock.ingest.task.conditions import Condition
from restock.replay.panel.panel import HEADER, Panel
from restock.replay.store.store import Store, is_store, profiles_of
from restock.train.feed.collector import conditions_in_twin
from restock.train.judge.answers import Answer, TwinFits, answers, permuted_actions
from restock.train.judge.beside import beside_others
from restock.train.judge.causes import Finding, findings
from restock.train.judge.fed_rows import (
    Comparison,
    FedRows,
    Flags,
    correct_over_parts,
    drive_twin,
    not_run,
    of_panel,
    of_store,
    unflagged,
)
from restock.train.judge.mission_checks import mission_checks, with_missions
from restock.train.judge.row_checks import fed_labels, outcomes, row_order, stored, values
from restock.train.run.run_profile import carried_profile, profile_of_panel
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.layout import DEFAULT, Warehouse
from restock.train.twin.physics.perturbation import Perturbation

MIN_ROWS = 500  # fewer rows are never called healthy, and smaller parts are not compared
MOST = 40  # at most so many parts are compared: the largest ones
RECORDINGS_CHECK = "recordings"
_MAX_PARTS = 0.8  # a fault in a larger share of the parts is reported for all rows
_MAX_NAMES = 3  # at most so many parts or files are named in a text


@dataclass
class Part:
    """A set of rows that is judged by itself: all rows, or those of one robot or recording."""

    name: str  # "" for all rows
    kind: str  # "robots", "recordings" or "groups of recordings"; "" for all rows
    rows: FedRows
    answers: list[Answer] = field(default_factory=list)
    others: list[Comparison] = field(default_factory=list)

    @property
    def comparisons(self) -> list[Comparison]:
        """Return the results of all checks of these rows."""
        return [row for one in self.answers for row in one.comparisons] + self.others


def parts_of(logs: FedRows) -> tuple[list[Part], Comparison | None]:
    """Split rows into parts: all rows, then each robot's and recording's if several are large.

    Robots are parts if there are several and every recording is tagged with one. Recordings are
    parts, too, if each has `MIN_ROWS` rows. Without robots, recordings that are shorter are grouped
    by their start. The returned comparison counts the parts; None if there is one recording.
    """
    parts = [Part("", "", logs)]
    recordings, place, rows = np.unique(logs.recording, return_inverse=True, return_counts=True)
    if len(recordings) < 2:
        return parts, None
    robots, short = np.unique(logs.robot), (rows < MIN_ROWS)[place.reshape(-1)]
    levels = []
    if len(robots) > 1 and "" not in robots:
        levels.append(("robots", np.char.add("robot ", logs.robot)))
    if not levels or (len(robots) < len(recordings) and not short.any()):
        kind, part = "recordings", logs.recording.astype(object)
        if short.any():
            kind, part[short] = "groups of recordings", _group_by_start(logs.take(short))
        levels.append((kind, part.astype(np.str_)))
    compared = []
    for kind, part in levels:
        names, rows = np.unique(part, return_counts=True)
        chosen = names[np.argsort(-rows, kind="stable")][: min((rows >= MIN_ROWS).sum(), MOST)]
        if len(chosen) > 1:
            parts += [Part(name, kind, logs.take(part == name)) for name in chosen.tolist()]
            inside = np.unique(logs.recording[np.isin(part, chosen)])
            compared.append(
                f"{len(chosen)} {kind} with {MIN_ROWS} rows were compared: {len(inside)} of"
                f" {len(recordings)} recordings"
            )
    what = f"each of the {levels[-1][0]} by itself"
    if not compared:
        reason = f"there are no two {levels[-1][0]} with {MIN_ROWS} rows"
        return parts, not_run(RECORDINGS_CHECK, what, reason)
    rows_compared = sum(len(one.rows) for one in parts[1:] if one.kind == parts[1].kind)
    return parts, Comparison(
        RECORDINGS_CHECK, what, "recordings", "ok", logs_rows=rows_compared,
        note="; ".join(compared),
    )  # fmt: skip


def _group_by_start(logs: FedRows) -> NDArray[np.str_]:
    """Sort recordings by start time, and group neighbours; return the group of each row, (N,).

    A group has at least `MIN_ROWS` rows, and more if there would be over `MOST` groups.
    """
    names, place, rows = np.unique(logs.recording, return_inverse=True, return_counts=True)
    place = place.reshape(-1)
    start = np.full(len(names), np.iinfo(np.int64).max)
    np.minimum.at(start, place, logs.logged_ns)
    order = np.argsort(start, kind="stable")
    middle = np.cumsum(rows[order]) - rows[order] / 2
    groups = np.clip(len(logs) // (MIN_ROWS + rows.max()), 1, MOST)  # + max: recordings stay whole
    begins = np.searchsorted(middle * groups / len(logs), np.arange(groups + 1))
    named = np.empty(len(names), object)
    for first, end in pairwise(begins.tolist()):
        named[order[first:end]] = f"{names[order[first]]} and the next {end - first - 1}"
    return np.asarray(named[place], np.str_)


def _merge_findings(
    parts: Sequence[Part], each: Sequence[Sequence[Finding]], files: Mapping[str, str]
) -> tuple[list[Finding], list[Finding]]:
    """Merge the parts' findings: return those of some robots or recordings, then of all rows."""
    found = list(each[0])
    kinds = {one.kind: sum(other.kind == one.kind for other in parts) for one in parts[1:]}
    by_cause: dict[tuple[str, str, int], list[tuple[Part, Finding]]] = {}
    for part, of_part in zip(parts[1:], each[1:], strict=True):
        for place, one in enumerate(of_part):
            again = sum(one.cause == other.cause for other in of_part[:place])
            by_cause.setdefault((one.cause, part.kind, again), []).append((part, one))
    of_some: list[Finding] = []
    reported: dict[str, str] = {}  # cause -> kind of the parts in which it was first found
    for (cause, kind, _), some in by_cause.items():
        if reported.setdefault(cause, kind) != kind:
            continue  # already reported by robot
        if len(some) > _MAX_PARTS * kinds[kind]:
            if not any(cause == one.cause for one in found):
                found.append(replace(some[0][1], text=f"in all {kind}: {some[0][1].text}"))
        else:
            of_some.append(_merge_same(some, kinds[kind], files))
    explained = {check.partition(", ")[0] for one in of_some for check in one.evidence}
    return of_some, [one for one in found if explained.isdisjoint(one.evidence)]


def _merge_same(
    each: Sequence[tuple[Part, Finding]], compared: int, files: Mapping[str, str]
) -> Finding:
    """Merge the same finding of several parts into one, with the text of the first."""
    names = ", ".join(_describe_part(part, files) for part, _ in each[:_MAX_NAMES])
    more = f" and {len(each) - _MAX_NAMES} more" if len(each) > _MAX_NAMES else ""
    first, kind = each[0][1], each[0][0].kind
    return replace(
        first,
        text=f"in {len(each)} of {compared} {kind} ({names}{more}): {first.text}",
        remedy=f"for these {kind} alone: {first.remedy}",
        evidence=tuple(f"{check}, {part.name}" for part, one in each for check in one.evidence),
    )


def _describe_part(part: Part, files: Mapping[str, str]) -> str:
    """Return a part's name for people: a recording's file, or a robot with its files."""
    recordings = np.unique(part.rows.recording).tolist()
    names = [files.get(one, one) for one in recordings[:_MAX_NAMES]]
    if part.name in recordings:
        return files.get(part.name, part.name)
    if not part.name.startswith("robot ") or not set(recordings) <= files.keys():
        return part.name
    more = f" and {len(recordings) - _MAX_NAMES} more" if len(recordings) > _MAX_NAMES else ""
    return f"{part.name}: {', '.join(names)}{more}"


Verdict = Literal["HEALTHY", "BUFFER", "UNDETERMINED"]


@dataclass(frozen=True)
class RowDiagnosis:
    """The verdict on rows before training, with the evidence."""

    verdict: Verdict
    findings: list[Finding]
    comparisons: list[Comparison]
    about: dict[str, Any]  # counts of the rows, the path, the profile and its task, seconds taken

    @property
    def not_run(self) -> list[Comparison]:
        """Return the checks that could not run, each with the reason in `note`."""
        return [row for row in self.comparisons if row.status == "not run"]


class OpenedRows(NamedTuple):
    """Rows of a panel or store, with their profile, and checks and file names from their store."""

    rows: FedRows
    profile: Profile
    checks: list[Flags]  # results of the checks that need the store
    files: dict[str, str]  # recording ID -> file name


def diagnose_before_training(
    path: Path | str,
    *,
    profile: Profile | None = None,
    twin: bool = True,
    perturbation: Perturbation | None = None,
    layouts: str = DEFAULT,
) -> RowDiagnosis:
    """Compare the rows of a panel or store with the twin and with the task's definitions.

    Args:
        profile: defines the task and conditions of the twin; None: the profile of the rows.
        twin: False: only run the checks that do not need the twin.
        perturbation: of the twin, as `restock twin fit` fits it; None: the nominal twin.
        layouts: the floors that the twin drives on, in the form of `env.layouts`.

    Raises:
        RunError: the path is neither a panel nor a store.
        PanelError, StoreError: the panel or store is damaged or empty, or lacks its profile.
        ConfigError: the rows are of another task than the profile's.
    """
    begun = time.perf_counter()
    opened = open_rows(Path(path), profile)
    own = opened.profile
    floors = open_floors(layouts)
    fresh, reason = _drive(own, perturbation, layouts) if twin else (None, "it was not requested")
    diagnosis = diagnose_rows(
        opened.rows, fresh, reason, more=opened.checks, files=opened.files,
        floors=floors if twin else (),
    )  # fmt: skip
    diagnosis.about.update(
        path=str(path), profile=own.name, task_hash=own.task.hash,
        seconds=round(time.perf_counter() - begun, 1),
    )  # fmt: skip
    return diagnosis


def diagnose_rows(
    rows: FedRows, twin: FedRows | None, reason: str = "", *,
    more: Sequence[Flags] = (), floors: Sequence[Warehouse] = (),
    files: Mapping[str, str] | None = None,
) -> RowDiagnosis:  # fmt: skip
    """Diagnose rows: all of them, and those of each robot and recording.

    `reason` is why `twin` is None. `more` are results of checks made elsewhere, which count in the
    same way. `floors` are those that the twin drives on; `files` maps recordings to file names.
    """
    parts, compared = parts_of(rows)
    of_twin: TwinFits = {}  # fits to the twin, shared by all parts
    for part in parts:
        own = part.rows
        inside = np.isin(rows.transition_id, own.transition_id)
        part.answers = answers(own, twin, of_twin)
        part.others = [
            *permuted_actions(own, twin),
            *outcomes(own, twin),
            *row_order(own),
            *values(own, twin),
            *mission_checks(own, twin, floors, rows.take(~inside) if part.name else None),
            *(one.of(own) for one in more),
        ]
    for kind in dict.fromkeys(part.kind for part in parts[1:]):
        some = [part for part in parts if part.kind == kind]
        of_values = beside_others([part.rows for part in some], [part.answers for part in some])
        for part, compared_values in zip(some, of_values, strict=True):
            part.others += compared_values
    correct_over_parts([part.comparisons for part in parts])
    each = [findings(part.answers, part.others, rows.task) for part in parts]
    of_some, of_all = _merge_findings(parts, each, files or {})
    found = of_some + of_all
    comparisons = parts[0].comparisons
    for part in parts[1:]:
        comparisons += [replace(row, check=f"{row.check}, {part.name}")
                        for row in part.comparisons if row.off]  # fmt: skip
    if compared is not None:
        comparisons.append(replace(compared, status="off" if of_some else compared.status))
    if twin is None:
        comparisons.append(not_run("twin", "rows of the twin", reason))
    verdict: Verdict = "BUFFER" if found else "HEALTHY"
    if not found and (len(rows) < MIN_ROWS or any(row.suspicious for row in comparisons)):
        verdict = "UNDETERMINED"
    about = {
        "rows": len(rows),
        "episodes": int(rows.last.sum()),
        "left_out": rows.left_out,
        "twin_rows": len(twin) if twin is not None else 0,
    }
    return RowDiagnosis(verdict, found, comparisons, about)


def open_rows(path: Path, profile: Profile | None = None) -> OpenedRows:
    """Open the rows of a panel or a store.

    Raises:
        RunError, PanelError, StoreError, ConfigError: as `diagnose_before_training`.
    """
    if (path / HEADER).is_file():
        panel = Panel.open(path)
        rows, own = of_panel(panel), profile or profile_of_panel(panel)
        store_path, version = Path(panel.header.store), panel.store_version
        if version < 0 or not is_store(store_path):
            reason = f"the panel's store is no longer at {store_path}"
            missing = [
                unflagged("fed labels", "labels against the store's", reason),
                unflagged("labels", "labels by stored signals", reason),
            ]
            return OpenedRows(rows, _check_task(own, rows, path), missing, {})
        with Store(store_path, version=version) as store:
            own = _check_task(own, rows, path)
            compared = [*fed_labels(store, rows), *stored(store, rows, own, _twin_conditions(own))]
            return OpenedRows(with_missions(store, rows), own, compared, _file_names(store))
    if is_store(path):
        with Store(path) as store:
            chosen = store.task().hash
            rows = of_store(store, chosen)
            own = _check_task(profile or _profile_of_store(store, chosen), rows, path)
            compared = [*stored(store, rows, own, _twin_conditions(own))]
            return OpenedRows(with_missions(store, rows), own, compared, _file_names(store))
    raise RunError(
        "is not a run, a panel or a store" if path.exists() else "does not exist",
        where=str(path),
        remedy="`restock mix STORE --mixture coverage --out PANEL` makes a panel",
    )


def _check_task(own: Profile, rows: FedRows, path: Path) -> Profile:
    """Return the profile; raise ConfigError if the rows are of another task."""
    if own.task.hash == rows.task.hash:
        return own
    raise ConfigError(
        f"profile {own.name!r} defines task {own.task.hash}, but the rows are of task"
        f" {rows.task.hash}",
        where=str(path),
        remedy="pass the profile that these rows were ingested with",
    )


def _file_names(store: Store) -> dict[str, str]:
    """Map each recording's ID to its file name."""
    found = store.connection.sql("SELECT recording_id, source_file FROM recordings").fetchall()
    return {str(name): Path(path).name for name, path in found}


def _twin_conditions(profile: Profile) -> list[Condition]:
    """Return the profile's conditions that can be computed from the twin's signals."""
    return conditions_in_twin(profile.conditions, profile.signals, lidar=profile.task.lidar)[0]


def _profile_of_store(store: Store, task_hash: str) -> Profile:
    newest = profiles_of(store.connection, task_hash)[0]
    where, option = str(store.path), f"--profile {newest.name}.toml"
    return carried_profile(newest.name, newest.toml, task_hash, where, option, StoreError)


def _drive(
    profile: Profile, perturbation: Perturbation | None, layouts: str
) -> tuple[FedRows | None, str]:
    task, robot, conditions = profile.task, profile.robot, _twin_conditions(profile)
    try:
        rows = drive_twin(task, conditions, robot=robot, perturbation=perturbation, layouts=layouts)
        return rows, ""
    except RestockError as error:  # the twin lacks such a robot, but the other checks are useful
        return None, f"the twin cannot be driven with this profile: {error.what}"
