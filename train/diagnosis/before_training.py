"""What can be known before anything is trained: from a panel or a store, and the twin alone.

A critic that is fed consistent mistakes learns them, and no figure of its training shows it: logs
that swap left and right explain themselves. So the rows are held against fresh rows of the twin,
and against what must hold by definition. Where the twin cannot be driven, the checks
that need none still run, and the others say why they did not.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from restock.errors import ConfigError, RestockError, RunError, StoreError
from restock.ingest.profile.profile import Profile
from restock.ingest.task.conditions import Condition
from restock.replay.panel.panel import HEADER, Panel
from restock.replay.store.store import Store, is_store, profiles_of
from restock.train.diagnosis.answers import answers, permuted_actions
from restock.train.diagnosis.by_recording import unlike_recordings
from restock.train.diagnosis.causes import Finding, findings
from restock.train.diagnosis.evidence import Comparison, not_run
from restock.train.diagnosis.fed_rows import FedRows, of_panel, of_store
from restock.train.diagnosis.gap_evidence import gap_evidence, untrusted
from restock.train.diagnosis.outcomes import outcomes
from restock.train.diagnosis.row_order import row_order
from restock.train.diagnosis.stored import fed_labels, stored
from restock.train.diagnosis.twin_rows import drive_twin
from restock.train.diagnosis.values import values
from restock.train.feed.collector import conditions_in_twin
from restock.train.run.run_profile import carried_profile, profile_of_panel
from restock.train.twin.physics.perturbation import Perturbation

Verdict = Literal["HEALTHY", "BUFFER", "UNDETERMINED"]
MIN_ROWS = 500  # of the logs, for silence to mean health


@dataclass(frozen=True)
class RowDiagnosis:
    """What is wrong with rows before they are trained on, and the evidence."""

    verdict: Verdict
    findings: list[Finding]
    comparisons: list[Comparison]
    about: dict[str, Any]  # what was looked at

    @property
    def not_run(self) -> list[Comparison]:
        """Checks that could not be made, each with the reason in `note`."""
        return [row for row in self.comparisons if row.status == "not run"]

    @property
    def untrusted(self) -> list[str]:
        """The conditions in which `restock twin gap` found the twin far from these logs."""
        return untrusted(self.comparisons)

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "verdict": self.verdict,
            "untrusted": self.untrusted,
            "findings": [asdict(one) for one in self.findings],
            "comparisons": [asdict(row) for row in self.comparisons],
            "about": self.about,
        }


class OpenedRows(NamedTuple):
    """Rows at hand, and what needs more than them."""

    rows: FedRows
    profile: Profile
    comparisons: list[Comparison]  # with the signals of their store
    folders: list[Path]  # of the store and the panel: where a measured gap may be


def diagnose_before_training(
    path: Path | str,
    *,
    profile: Profile | None = None,
    twin: bool = True,
    perturbation: Perturbation | None = None,
    task_hash: str | None = None,
    run: Path | str | None = None,
    seed: int = 0,
) -> RowDiagnosis:
    """Hold the rows of a panel or a store against the twin, and against the task's definitions.

    Args:
        profile: whose task and conditions the twin is driven with; None: that of the rows.
        twin: False: only the checks that need none.
        perturbation: of the twin, as `restock twin fit` finds it; None: the nominal one.
        task_hash: whose rows, where a store has several tasks.
        run: the run that was fed these rows, whose measured gap counts first.

    Raises:
        RunError: there is not a panel or a store.
        PanelError, StoreError: it is damaged, has no rows, or its profile is not at hand.
        ConfigError: the profile's task is not that of the rows.
    """
    begun = time.perf_counter()
    opened = open_rows(Path(path), profile, task_hash)
    own = opened.profile
    fresh, reason = _drive(own, perturbation, seed) if twin else (None, "it was not requested")
    diagnosis = diagnose_rows(opened.rows, fresh, reason, seed=seed, more=opened.comparisons)
    places = [*([Path(run)] if run is not None else []), *opened.folders]
    diagnosis = replace(diagnosis, comparisons=[*diagnosis.comparisons, *gap_evidence(places)])
    diagnosis.about.update(
        path=str(path), profile=own.name, task_hash=own.task.hash,
        seconds=round(time.perf_counter() - begun, 1),
    )  # fmt: skip
    return diagnosis


def diagnose_rows(
    rows: FedRows, twin: FedRows | None, reason: str = "", *, seed: int = 0,
    more: Sequence[Comparison] = (),
) -> RowDiagnosis:  # fmt: skip
    """The same of rows at hand; `reason` says why there are none of a twin. `more` comparisons,
    made elsewhere, count like these."""
    compared = answers(rows, twin, seed)
    permuted = list(permuted_actions(rows, twin))
    others = [*outcomes(rows, twin, seed), *row_order(rows), *values(rows, twin, seed), *more]
    found = findings(compared, permuted, others, rows.task)
    comparisons = [row for one in compared for row in one.comparisons]
    of_relations = {row.check for row in comparisons}
    comparisons += [row for row, _ in permuted] + others
    of_robots = [one for one in found if not of_relations.isdisjoint(one.evidence)]
    if of_robots or not found:  # else the rows are at fault, whichever robot's they are
        own, unlike = unlike_recordings(rows, twin, seed)
        comparisons += unlike
        found = [one for one in found if not own or one not in of_robots] + own
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


def open_rows(
    path: Path, profile: Profile | None = None, task_hash: str | None = None
) -> OpenedRows:
    """The rows of a panel or a store.

    Raises:
        as `diagnose_before_training`.
    """
    opened = _open(path, profile, task_hash)
    own, of_rows = opened.profile, opened.rows.task.hash
    if own.task.hash != of_rows:
        raise ConfigError(
            f"profile {own.name!r} defines task {own.task.hash}, the rows are of {of_rows}",
            where=str(path),
            remedy="give the profile with which they were ingested",
        )
    return opened


def _open(path: Path, profile: Profile | None, task_hash: str | None) -> OpenedRows:
    if (path / HEADER).is_file():
        panel = Panel.open(path)
        rows, own = of_panel(panel), profile or profile_of_panel(panel)
        store_path, version = Path(panel.header.store), panel.store_version
        if version < 0 or not is_store(store_path):
            reason = f"the panel's store is no longer at {store_path}"
            missing = [
                not_run("fed labels", "labels against the store's", reason),
                not_run("labels", "labels by stored signals", reason),
            ]
            return OpenedRows(rows, own, missing, [path])
        with Store(store_path, version=version) as store:
            compared = [*fed_labels(store, rows), *_of_store(store, rows, own)]
            return OpenedRows(rows, own, compared, [store_path, path])
    if is_store(path):
        with Store(path) as store:
            chosen = task_hash or store.task().hash
            rows, own = of_store(store, chosen), profile or _profile_of_store(store, chosen)
            return OpenedRows(rows, own, _of_store(store, rows, own), [path])
    raise RunError(
        "is not a panel or a store" if path.exists() else "there is no such panel or store",
        where=str(path),
        remedy="`restock mix STORE --mixture coverage --out PANEL` makes a panel",
    )


def _of_store(store: Store, rows: FedRows, profile: Profile) -> list[Comparison]:
    conditions = conditions_in_twin(profile.conditions, profile.signals, lidar=profile.task.lidar)[
        0
    ]
    return list(stored(store, rows, profile, conditions))


def _profile_of_store(store: Store, task_hash: str) -> Profile:
    newest = profiles_of(store.connection, task_hash)[0]
    where, option = str(store.path), f"--profile {newest.name}.toml"
    return carried_profile(newest.name, newest.toml, task_hash, where, option, StoreError)


def _drive(
    profile: Profile, perturbation: Perturbation | None, seed: int
) -> tuple[FedRows | None, str]:
    conditions: list[Condition] = conditions_in_twin(
        profile.conditions, profile.signals, lidar=profile.task.lidar
    )[0]
    try:
        driven = drive_twin(
            profile.task, conditions, robot=profile.robot, perturbation=perturbation, seed=seed
        )
        return driven, ""
    except RestockError as error:  # no such robot in the twin: the other checks still say much
        return None, f"the twin cannot be driven with this profile: {error.what}"


__all__ = [
    "OpenedRows",
    "RowDiagnosis",
    "Verdict",
    "diagnose_before_training",
    "diagnose_rows",
    "open_rows",
]
