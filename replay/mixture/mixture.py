"""A mixture: which transitions a learner samples, in which shares, as a TOML file.

Unknown keys are refused with their path. `restock mix --dry-run` shows every default, and
`docs/mixture.md` explains each key.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from restock.errors import ConfigError
from restock.renamed import MIXTURE_KEYS, MIXTURES
from restock.replay.sampling.rules import RULES, Prioritised
from restock.toml import Checked, parse_toml, read_toml, typed

Fraction = Annotated[float, Meta(ge=0, le=1)]


_SHIPPED = files("restock.replay.mixture") / "mixtures"

AtLeastOne = Annotated[int, Meta(ge=1)]
Count = Annotated[int, Meta(ge=0)]
FromOne = Annotated[float, Meta(ge=1)]
Positive = Annotated[float, Meta(gt=0)]
Timing = Literal["pre", "post"]
Share = Fraction | Literal["natural", "equal"]
Correction = Literal["none", "full", "clipped", "density_ratio"]
Shortfall = Literal["refuse", "redistribute", "shrink"]
Unit = Literal["step", "episode"]
Uncertain = Literal["drop", "keep", "nominal"]
Within = Annotated[str, Meta(extra_json_schema={"enum": list(RULES)})]  # a key of RULES
Represents = Literal["natural", "archive"] | dict[str, Fraction]  # dict: stratum -> share of rows


class OtherStore(Checked, frozen=True):
    """Another store to draw rows from, with the strata of the mixture and a share of each batch."""

    name: str  # prefix of its strata, which are called `name/stratum`
    path: str  # absolute, or relative to the mixture's file; PATH@VERSION for an older version
    share: Fraction  # share of a batch
    # Natural shares that its rows represent: their own ("natural"), the main store's ("archive"),
    # or given ones.
    represents: Represents | None = None

    def check(self) -> None:
        _check_rates(self.represents)
        _require(
            bool(self.name) and "/" not in self.name, f"name {self.name!r} is not valid for a store"
        )
        _require(
            self.name not in ("logs", "fresh"), f"a store cannot be called {self.name!r}: taken"
        )


class SourceShares(Checked, frozen=True):
    """Shares of an online batch by source; fresh rows take the rest."""

    logs: Fraction = 0.5
    stores: tuple[OtherStore, ...] = ()
    represents: Represents | None = None  # rates that the main store's rows represent

    def check(self) -> None:
        _check_rates(self.represents)
        _require(
            self.represents != "archive",
            'sources.represents: an "archive" stands for the main store\'s rates, and this is the '
            "main store: give the rates as a table",
        )
        names = [store.name for store in self.stores]
        _require(len(set(names)) == len(names), f"stores named twice: {sorted(names)}")
        total = sum(self.parts.values())
        _require(total <= 1 + 1e-6, f"sources sum to {total:g}, above 1")
        _require(self.logs > 0, "sources.logs must be above 0: the offline phase draws from it")

    @property
    def parts(self) -> dict[str, float]:
        """Return the share of a batch of each source except fresh rows."""
        return {"logs": self.logs, **{store.name: store.share for store in self.stores}}

    @property
    def represented(self) -> dict[str, Represents | None]:
        """Return `represents` of each source except fresh rows; None if the mixture omits it."""
        return {"logs": self.represents, **{store.name: store.represents for store in self.stores}}

    def chosen(self, name: str) -> bool:
        """Return whether a source's rows represent other natural shares than their own."""
        return self.represented[name] not in (None, "natural")


def _check_rates(represents: Represents | None) -> None:
    _require(
        represents != {},
        "`represents` is an empty table: give the rate of a stratum, or leave it out",
    )
    total = sum(represents.values()) if isinstance(represents, dict) else 0.0
    _require(total <= 1 + 1e-6, f"the rates of `represents` sum to {total:g}, above 1")


def _require(ok: bool, message: str) -> None:
    if not ok:
        raise ValueError(message)


def _check_within(name: str) -> None:
    _require(name in RULES, f"within is {name!r}: the rules are {', '.join(RULES)}")


class EvaluationSplit(Checked, frozen=True):
    """Which rows are held out for evaluation: whole groups (`by`), about `share` of the rows.

    If the store has a single episode, or a single chosen episode has more than twice the share, the
    end of the longest episode is held out instead, as with "within_episode".
    """

    by: Literal["episode", "recording", "robot", "site", "time", "within_episode", "none"] = (
        "episode"
    )
    share: Annotated[float, Meta(ge=0, lt=1)] = 0.1
    robots: tuple[str, ...] = ()  # hold out these robots, instead of a share

    def check(self) -> None:
        _require(
            not self.robots or self.by == "robot",
            f'evaluation_split.robots needs by = "robot", got {self.by!r}',
        )

    @property
    def is_empty(self) -> bool:
        """Return whether the split never holds anything out."""
        return self.by == "none" or (self.share == 0 and not self.robots)


class Safety(Checked, frozen=True):
    """Rows that must not be learned from."""

    unsafe: str  # SQL predicate over `transitions`
    leave_out: Literal["rows", "episodes"] = "rows"  # "episodes": whole episodes with an unsafe row


class CorrectionRule(Checked, frozen=True):
    """Importance weights that offset the boost of strata (drawn share over natural share)."""

    pre: Correction = "none"  # for strata selected by state: their boost does not bias Q
    post: Correction = "density_ratio"  # for strata selected by outcome: their boost would bias Q
    clip: FromOne = 4.0  # largest weight; "clipped" weights are also at least 1 / clip
    # What to do if weights take a stratum's share of the gradient below its share of the rows.
    below_natural: Literal["refuse", "allow"] = "refuse"


class StratumLimits(Checked, frozen=True, kw_only=True):
    """Keys that [[strata]] and [each_condition] have in common."""

    unit: Unit = "step"  # "episode": whole episodes that met the condition; nominal: the others
    min_steps: AtLeastOne = 1  # with unit "episode": steps in which the condition must hold
    floor: Fraction = 0.0
    cap: Fraction = 1.0
    correction: Correction | None = None  # default: `pre` or `post` of the mixture's [correction]
    within: Within | None = None  # default: the mixture's `within`

    def check(self) -> None:
        name = getattr(self, "name", "each_condition")
        if self.within is not None:
            _check_within(self.within)
        _require(
            self.floor <= self.cap,
            f"floor of {name!r} is {self.floor:g}, above its cap of {self.cap:g}",
        )
        _require(
            self.unit == "episode" or self.min_steps == 1,
            f'min_steps of {name!r} applies to episodes: it needs unit = "episode"',
        )


class StratumRule(StratumLimits, frozen=True, kw_only=True):
    """One stratum of [[strata]]. A row goes to the matching stratum with the lowest `priority`."""

    name: str  # name of a condition or exposure, "nominal", or any name with `where`
    where: str | None = None  # SQL predicate over `transitions`
    share: Share = "natural"  # share of the rows that its source gives to a batch
    priority: int | None = None  # default: the condition's, 50 with `where`, or 1000 for nominal
    timing: Timing | None = None  # default: the condition's; "post" for a `where` stratum

    def check(self) -> None:
        super().check()
        _require(bool(self.name), "name is empty: a stratum needs a name")
        if isinstance(share := self.share, int | float):
            problem = f"share of {self.name!r} is {share:g}"
            _require(share >= self.floor, f"{problem}, below its floor of {self.floor:g}")
            _require(share <= self.cap, f"{problem}, above its cap of {self.cap:g}")


class EachCondition(StratumLimits, frozen=True, kw_only=True):
    """A stratum for every condition of the store (and nominal) that `strata` does not name."""

    share: Literal["natural", "equal"] = "natural"
    kind: Literal["outcome", "exposure"] = (
        "outcome"  # "exposure": strata of the store's exposures, which are situations met
    )


class Mixture(Checked, frozen=True):
    """Which transitions a run samples, in which shares. `docs/mixture.md` explains every key."""

    doc: str = ""
    seed: int = 0
    # How rows are packed.
    discount: Fraction = 0.99  # discount (gamma) per step
    n_step: AtLeastOne = 1  # most steps of a return; it ends earlier with the episode or policy
    evaluation_split: EvaluationSplit = EvaluationSplit()
    # Which rows may be drawn.
    where: str | None = None  # SQL predicate; only transitions that it selects are used
    safety: Safety | None = None
    odometry_as_command: bool = False  # use rows whose action is measured motion
    max_age_days: Annotated[float, Meta(ge=0)] | None = None  # largest age of logged rows
    as_of: Annotated[datetime, Meta(tz=True)] | None = None  # date for ages; None: time of mixing
    max_age_env_steps: Count | None = None  # largest age of fresh rows
    max_rows_per_episode: AtLeastOne | None = None  # in each stratum
    max_rows_per_recording: AtLeastOne | None = None
    unlabelled: Literal["refuse", "drop", "nominal"] = "refuse"  # rows without a condition
    uncertain: Uncertain = "nominal"  # uncertain labels: ignore them ("nominal"), keep, or drop row
    unlisted: Literal["refuse", "drop"] = "refuse"  # rows that belong to no stratum
    # Shares of strata and sources.
    sources: SourceShares = SourceShares()
    # Rows that a run is assumed to draw. A run replaces this number with its own.
    planned_draws: AtLeastOne = 20_000 * 128
    strata: tuple[StratumRule, ...] = ()
    each_condition: EachCondition | None = None
    max_replays_per_row: FromOne | None = None  # largest number of times that a row is drawn
    shortfall: Shortfall = "redistribute"
    # How rows are drawn within a stratum.
    within: Within = "without_replacement"
    prioritised: Prioritised = Prioritised()
    correction: CorrectionRule = CorrectionRule()

    @property
    def most_draws(self) -> int | None:
        """Return `max_replays_per_row` rounded down; None for no limit."""
        return None if self.max_replays_per_row is None else int(self.max_replays_per_row)

    def check(self) -> None:
        _require(
            bool(self.strata) or self.each_condition is not None,
            "no strata: list some under [[strata]], or give [each_condition]",
        )
        _check_within(self.within)
        names = [rule.name for rule in self.strata]
        _require(len(set(names)) == len(names), f"strata named twice: {sorted(names)}")
        _require(not any("/" in name for name in names), "a stratum's name cannot contain a /")
        given = sum(rule.share for rule in self.strata if isinstance(rule.share, int | float))
        _require(given <= 1 + 1e-6, f"shares of strata sum to {given:g}, above 1")


def shipped_mixtures() -> list[str]:
    """Return the names of the mixtures that come with Restock."""
    names = (entry.name for entry in _SHIPPED.iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def load_mixture(name_or_path: str | Path) -> Mixture:
    """Load a shipped mixture by name, or a TOML file.

    Raises:
        ConfigError: no such name or file, invalid TOML, an unknown key or an invalid value.
    """
    name = str(name_or_path)
    path = Path(name)
    if name in shipped_mixtures():
        text = (_SHIPPED / f"{name}.toml").read_text(encoding="utf-8")
    elif path.is_file():
        return _mixture(read_toml(path), name)
    else:
        raise ConfigError(
            f"there is no mixture {name!r}",
            remedy=MIXTURES.get(name)
            or f"give a TOML file, or one of {', '.join(shipped_mixtures())}",
        )
    return parse_mixture(text, where=name)


def parse_mixture(text: str, *, where: str = "mixture") -> Mixture:
    """Parse a mixture from TOML text. Raises ConfigError with the path of the invalid key."""
    return _mixture(parse_toml(text, where=where), where)


def _mixture(document: dict[str, Any], where: str) -> Mixture:
    return typed(
        document,
        Mixture,
        where=where,
        remedy="docs/mixture.md lists every key",
        renamed=MIXTURE_KEYS,
    )


def nanoseconds(moment: datetime) -> int:
    """Return nanoseconds since 1970, exactly."""
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
