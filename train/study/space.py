"""A space of settings to search: what its TOML file says, and which settings a trial has.

Every trial is trained with the same seeds and judged on the same episodes; what differs is drawn
from `[space]`, whose keys are those of `restock train --set`, and `mixture`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from restock.errors import ConfigError
from restock.toml import Checked, read_toml, typed
from restock.train.dqn.config import TrainConfig, apply_overrides, as_overrides, parse_config
from restock.train.evaluation.references import wrong_seed
from restock.train.study.study import (
    StudyEvaluation,
    check_seeds,
    refuse_judging_by_the_choice,
    refuse_unknown_names,
)

Count = Annotated[int, msgspec.Meta(ge=1)]
MIXTURE = "mixture"  # the one key of a space that is no setting


class Parameter(Checked, frozen=True):
    """One key of a space: a range, or choices."""

    low: float | int | None = None
    high: float | int | None = None  # included
    log: bool = False
    step: float | int | None = None
    choices: tuple[Any, ...] = ()

    def check(self) -> None:
        ranged = self.low is not None and self.high is not None
        if ranged == bool(self.choices):
            raise ValueError("a key of a space has low and high, or choices")
        if not ranged:
            return
        assert self.low is not None
        assert self.high is not None
        if self.low >= self.high:
            raise ValueError(f"low must be below high, got {self.low} and {self.high}")
        if self.log and (self.low <= 0 or self.step is not None):
            raise ValueError(f"log must have a low above 0 and no step, got low = {self.low}")

    @property
    def integers(self) -> bool:
        """Whether whole numbers are drawn: both ends are."""
        return isinstance(self.low, int) and isinstance(self.high, int)


class Search(Checked, frozen=True):
    """The whole file."""

    space: dict[str, Any]  # `Parameter`s by key of `restock train --set`
    doc: str = ""
    store: str | None = None  # store from which mixtures are made
    mixture: str | None = None  # name of a shipped mixture, or a TOML file
    panel: str | None = None  # an existing panel
    seeds: tuple[int, ...] = (0,)  # each trial is trained with all of them
    trials: Count = 30
    sampler: Literal["tpe", "random"] = "tpe"
    sampler_seed: int = 0
    prune: bool = True  # stop bad trials early, by their periodic evaluations
    startup_trials: Count = 5  # first trials: random, never pruned
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # settings of all trials
    evaluation: StudyEvaluation = StudyEvaluation()

    def check(self) -> None:
        if not self.parameters:
            raise ValueError("space must have at least one key")
        if self.mixture is not None and self.panel is not None:
            raise ValueError("panel must not be given beside mixture: choose one")
        mixed = self.mixture is not None or MIXTURE in self.parameters
        if mixed and self.store is None:
            raise ValueError("a mixture is given without a store")
        if MIXTURE in self.parameters and (self.panel is not None or self.mixture is not None):
            raise ValueError("space contains mixture: do not give mixture or panel as well")
        check_seeds(self.seeds)
        if wrong := wrong_seed(self.sampler_seed):
            raise ValueError(f"sampler_seed {wrong}")
        if "seed" in self.settings or "seed" in self.parameters:
            raise ValueError("the search sets the seeds: settings and space must not set seed")

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Each with its dotted key, quoted in the file or not."""
        return dict(_flat(self.space, ""))


def _flat(table: Mapping[str, Any], prefix: str) -> list[tuple[str, Parameter]]:
    found: list[tuple[str, Parameter]] = []
    for key, value in table.items():
        name = prefix + key
        if isinstance(value, Parameter):
            found.append((name, value))
        elif not isinstance(value, Mapping):
            what = "must be a table with low and high, or with choices"
            raise ValueError(f"space.{name} {what}, got {value!r}")
        elif value.keys() & {"low", "high", "choices"}:
            try:
                found.append((name, msgspec.convert(value, Parameter)))
            except (msgspec.ValidationError, ValueError) as error:
                raise ValueError(f"space.{name}: {error}") from error
        else:
            found += _flat(value, f"{name}.")
    return found


def load_search(path: Path) -> Search:
    """A search from a TOML file; every end and choice of its space must be a setting.

    Raises:
        ConfigError: no such file, no TOML, an unknown key or an invalid value; names the key.
    """
    remedy = "docs/compare.md lists every key with its meaning"
    search = typed(read_toml(path), Search, where=str(path), remedy=remedy)
    refuse_unknown_names(search.evaluation, str(path))
    for name, parameter in search.parameters.items():
        values = parameter.choices or (parameter.low, parameter.high)
        for value in () if name == MIXTURE else values:
            try:
                _config(search, {name: value}, path)
            except ConfigError as error:
                raise ConfigError(
                    f"`space.{name}` = {value!r}: {error.what}", where=str(path), remedy=remedy
                ) from error
    chosen = _config(search, {}, path).evaluation
    refuse_judging_by_the_choice("every trial", chosen, search.evaluation, str(path))
    return search


def _config(search: Search, values: Mapping[str, Any], path: Path) -> TrainConfig:
    return parse_config(apply_overrides({}, settings_of(search, values)), where=str(path))


def settings_of(search: Search, values: Mapping[str, Any]) -> list[str]:
    """`key=value` of a trial; the space's win over the search's own."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        if key == MIXTURE:
            continue
        *tables, last = key.split(".")
        place = nested
        for table in tables:
            place = place.setdefault(table, {})
        place[last] = value
    return [*as_overrides(search.settings), *as_overrides(nested)]


def trial_name(values: Mapping[str, Any]) -> str:
    """Of a trial's values, 10 hex digits: the same values are the same runs."""
    content = json.dumps(dict(values), sort_keys=True)
    return hashlib.blake2b(content.encode(), digest_size=5).hexdigest()


__all__ = ["Parameter", "Search", "load_search", "settings_of", "trial_name"]
