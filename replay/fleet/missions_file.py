"""A missions file: which missions to drive next, as TOML for people and for `restock twin record`.

[[missions]]
kind = "wheel_slip"      # what it is to meet
missions = 14            # how many; or `hours` of logging, where missions cannot be chosen
zone = "aisle_2_east"    # that it comes through; left out: anywhere
layout = "default"       # the floor; left out: any of those that are driven on
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from restock.errors import ConfigError
from restock.files import write_text
from restock.renamed import MISSIONS_KEYS
from restock.toml import Checked, read_toml, toml_value, typed

if TYPE_CHECKING:
    from restock.replay.fleet.shopping_list import ShoppingList

FORMAT = "restock-missions/1"
_REMEDY = "docs/coverage.md lists the keys of a missions file"


class MissionOrder(Checked, frozen=True, kw_only=True):
    """So many missions of one kind, or so many hours of logging."""

    kind: str | None = None  # condition that a mission should meet; None: any
    missions: Annotated[int, Meta(ge=1)] | None = None
    hours: Annotated[float, Meta(gt=0)] | None = None  # of driving; with `missions`: their duration
    zone: str | None = None
    robot: str | None = None
    layout: str | None = None
    fills: tuple[str, ...] = ()  # the gaps that it fills

    def check(self) -> None:
        if self.missions is None and self.hours is None:
            raise ValueError("one of `missions` and `hours` must be given")


class MissionsFile(Checked, frozen=True, kw_only=True):
    """What to drive, and what it was worked out from."""

    missions: tuple[MissionOrder, ...]
    format: str = FORMAT
    store: str = ""  # STORE@VERSION
    mixture: str = ""

    def check(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"format is {self.format!r}, this Restock reads {FORMAT!r}")
        if not self.missions:
            raise ValueError("it contains no missions")


def read_missions(path: str | Path) -> MissionsFile:
    """Read a missions file.

    Raises:
        ConfigError: it cannot be read, an unknown key, or a value that does not fit.
    """
    remedy = "`restock coverage gaps STORE --missions-out FILE` writes one"
    document = read_toml(Path(path), remedy=remedy)
    return typed(document, MissionsFile, where=str(path), remedy=_REMEDY, renamed=MISSIONS_KEYS)


def of_list(found: ShoppingList, *, store: str, mixture: str) -> MissionsFile:
    """Return the plan of a shopping list for `store`, named as STORE@VERSION.

    Raises:
        ConfigError: it plans nothing: there are no gaps, or none that anything seen so far fills.
    """
    if not found.orders:
        raise ConfigError(
            "there is nothing to write to a missions file: "
            + ("no gap has a known rate" if found.gaps else "there are no gaps"),
            where=store,
            remedy="leave out --missions-out" + ("; write one by hand" if found.gaps else ""),
        )
    orders = [
        MissionOrder(
            kind=order.supply.kind,
            missions=round(order.amount) if found.unit == "missions" else None,
            hours=round(order.hours, 4) or None,
            zone=order.supply.zone,
            robot=order.supply.robot,
            fills=tuple(dict.fromkeys(order.fills)),
        )
        for order in found.orders
    ]
    return MissionsFile(missions=tuple(orders), store=store, mixture=mixture)


def refuse_existing(path: Path) -> None:
    """Raise ConfigError where there is something already."""
    if path.exists():
        raise ConfigError(
            "already there", where=str(path), remedy="choose another name, or remove it"
        )


def write_missions(path: Path, missions: MissionsFile) -> None:
    """Write a missions file in one step. Raises ConfigError where it cannot be written."""
    try:
        write_text(path, as_toml(missions))
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error


def as_toml(missions: MissionsFile) -> str:
    """Return the text of the file."""
    driven = any(order.missions is not None for order in missions.missions)
    how = "`restock twin record --missions` drives it" if driven else "the twin cannot drive hours"
    lines = [
        f"# What to log next, as `restock coverage gaps` planned it; {how}.",
        f"format = {toml_value(missions.format)}",
        f"store = {toml_value(missions.store)}",
        f"mixture = {toml_value(missions.mixture)}",
    ]
    for order in missions.missions:
        lines += ["", "[[missions]]"]
        for name in order.__struct_fields__:
            value = getattr(order, name)
            if value is not None and value != ():
                lines.append(f"{name} = {toml_value(value)}")
    return "\n".join(lines) + "\n"
