"""The logged rows of a run, with the columns that the record and the loss terms need."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from restock.arrays import F32, Bools, Ints
from restock.errors import ConfigError
from restock.replay.mixture.share_controller import PlannedDraws
from restock.replay.panel.logged_sampler import LoggedSampler, sampler_by_shares, sampler_for
from restock.train.dqn.config import LossConfig

if TYPE_CHECKING:
    from restock.replay.panel.panel import Panel

_UNPLANNED = PlannedDraws()
_IN_MEMORY_BYTES = 4 << 30  # larger panels stay memory-mapped


@dataclass(frozen=True)
class Coded:
    """A column of few distinct values: a code per row into `names`."""

    codes: NDArray[np.int32]  # (n,)
    names: list[str]

    @classmethod
    def of(cls, column: pa.ChunkedArray) -> Coded:
        encoded = column.combine_chunks().dictionary_encode()
        if isinstance(encoded, pa.ChunkedArray):
            encoded = encoded.combine_chunks()
        codes = encoded.indices.fill_null(len(encoded.dictionary))
        names = [*encoded.dictionary.to_pylist(), "unknown"]
        return cls(np.asarray(codes, np.int32), names)

    def name(self, row: int) -> str:
        return str(self.names[self.codes[row]])

    def known(self, row: int) -> str | None:
        """Return the text of a row, or None if the column has none."""
        code = self.codes[row]
        return str(self.names[code]) if code < len(self.names) - 1 else None


@dataclass(frozen=True)
class Logs:
    """The logged rows that a run draws from, with the columns that are recorded about them."""

    rows: Tensor  # (n, W) float32
    strata: list[str]
    timings: list[str]  # pre | post, of each stratum
    stratum_rows: list[Ints]  # the rows of each stratum
    shares: NDArray[np.float64]  # (S,)
    weights: F32 | None  # (n,) importance weights, or None if all are 1
    as_of_ns: int  # calendar ages are against it
    transition_id: Ints  # (n,)
    stamp_ns: Ints  # (n,), when each was logged: measurement stamps may be a simulator's
    condition: Coded
    behaviour_policy: Coded
    behaviour_version: Coded
    episode: Coded

    perturbation: Coded | None = None  # of the twin; null for hardware
    panel: Panel | None = None  # that they are from
    planned: PlannedDraws = _UNPLANNED  # what the run will draw

    @classmethod
    def of_panel(
        cls,
        panel: Panel,
        planned: PlannedDraws = _UNPLANNED,
        *,
        as_of_ns: int | None = None,
    ) -> Logs:
        """Read a panel's rows into memory (memory-mapped if it is larger than 4 GiB).

        Their ages are against `as_of_ns`, when training began; None: against their newest.
        """
        rows = np.asarray(panel.rows)
        if rows.nbytes <= _IN_MEMORY_BYTES and panel.header.mixture.sampling == "memory":
            rows = np.array(rows)
        with warnings.catch_warnings():  # a read-only map is fine: nothing writes to it
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            tensor = torch.from_numpy(rows)
        weights = panel.weights
        meta = panel.meta
        return cls(
            rows=tensor,
            strata=[stratum.name for stratum in panel.strata],
            timings=[stratum.timing for stratum in panel.strata],
            stratum_rows=panel.stratum_rows(),
            shares=np.array([stratum.share for stratum in panel.strata]),
            weights=None if np.all(weights == 1) else weights,
            as_of_ns=panel.header.newest_ns if as_of_ns is None else as_of_ns,
            transition_id=np.asarray(meta["transition_id"], np.int64),
            stamp_ns=np.asarray(meta["logged_ns"], np.int64),
            condition=Coded.of(meta["condition"]),
            behaviour_policy=Coded.of(meta["behaviour_policy"]),
            behaviour_version=Coded.of(meta["behaviour_version"]),
            episode=Coded.of(meta["episode_id"]),
            perturbation=Coded.of(
                meta["perturbation"]
                if "perturbation" in meta.column_names  # a panel from before has no such column
                else pa.chunked_array([pa.nulls(len(meta), pa.string())])
            ),
            panel=panel,
            planned=planned,
        )

    def __len__(self) -> int:
        return len(self.rows)

    def sampler(
        self,
        batch_size: int,
        logs_share: float | None,
        seed: int,
        fresh: Bools | None = None,
    ) -> LoggedSampler:
        """Make the sampler of the logs: by the mixture of their panel, else by their shares.

        `fresh` (S,): which strata rows of a ring beside them can be in; None: there is no ring.

        Raises:
            MixtureError: see `sampler_for`.
        """
        if self.panel is None:
            return sampler_by_shares(
                self.rows.numpy(),
                self.strata,
                self.stratum_rows,
                self.shares,
                batch_size,
                seed=seed,
                logs_share=logs_share or 0.0,
                weights=self.weights,
            )
        return sampler_for(
            self.panel,
            batch_size,
            seed=seed,
            planned=self.planned,
            logs_share=logs_share,
            fresh=fresh,
        )


@dataclass(frozen=True)
class LogTerms:
    """Masks over the panel's rows on the learner's device; None if no loss term needs one."""

    expert: Tensor | None  # (n,) bool: DQfD's margin applies

    @classmethod
    def of(cls, loss: LossConfig, logs: Logs | None, device: torch.device) -> LogTerms:
        """Make the terms of `loss` on these logs.

        Raises:
            ConfigError: it names a behaviour policy or stratum that they do not have, or there are
                no logs.
        """
        if logs is None:
            _refuse_without_logs(loss)
            return cls(None)
        expert = None
        if loss.margin:
            expert = torch.from_numpy(_expert(loss, logs)).to(device)
        return cls(expert)

    def expert_rows(self, log_rows: Ints) -> Tensor | None:
        """Return `expert` of some rows of the panel."""
        if self.expert is None:
            return None
        return self.expert[torch.from_numpy(log_rows).to(self.expert.device)]


def check_terms(loss: LossConfig, panel: Panel | None) -> None:
    """Refuse what `LogTerms.of` would, from the panel's columns alone."""
    if panel is None:
        _refuse_without_logs(loss)
        return
    if loss.margin:
        policy = Coded.of(panel.meta["behaviour_policy"])
        _refuse_unknown(loss, policy.names, [stratum.name for stratum in panel.strata])


def _refuse_without_logs(loss: LossConfig) -> None:
    if loss.margin:
        raise ConfigError(
            "loss.margin applies to logged rows, but this run has no logs",
            remedy="give --panel, or leave it out",
        )


def _refuse_unknown(loss: LossConfig, policies: list[str], strata: list[str]) -> None:
    _known("loss.margin_policies", loss.margin_policies, policies)
    _known("loss.margin_strata", loss.margin_strata, strata)


def _expert(loss: LossConfig, logs: Logs) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Select the rows (n,) of `margin_policies` in `margin_strata`."""
    policy = logs.behaviour_policy
    _refuse_unknown(loss, policy.names, logs.strata)
    chosen = np.isin(policy.codes, [policy.names.index(name) for name in loss.margin_policies])
    if loss.margin_strata:
        inside = np.zeros(len(chosen), np.bool_)
        for name, rows in zip(logs.strata, logs.stratum_rows, strict=True):
            inside[rows] = name in loss.margin_strata
        chosen &= inside
    return chosen


def _known(key: str, names: tuple[str, ...], known: list[str]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(
                f"{key}: the logs have no {name!r}",
                remedy=f"choose from what they have: {', '.join(dict.fromkeys(known))}",
            )
