"""A missions file: which missions to drive next, as TOML for people and for `restock twin record`.

[[missions]]
kind = "wheel_slip"      # condition that the missions should meet
missions = 14            # number of missions; or `hours` of logging, if missions cannot be chosen
zone = "aisle_2_east"    # zone on their route; if left out, any
layout = "default"       # floor; if left out, any floor in use
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
    """An order for a number of missions of one kind, or for hours of logging."""

    kind: str | None = None  # condition that a mission should meet; None: any
    missions: Annotated[int, Meta(ge=1)] | None = None
    hours: Annotated[float, Meta(gt=0)] | None = None  # total; with `missions`: their duration
    zone: str | None = None
    robot: str | None = None
    layout: str | None = None
    fills: tuple[str, ...] = ()  # descriptions of the gaps that the order fills

    def check(self) -> None:
        if self.missions is None and self.hours is None:
            raise ValueError("one of `missions` and `hours` must be given")


class MissionsFile(Checked, frozen=True, kw_only=True):
    """The contents of a missions file: orders, and the store and mixture whose gaps they fill."""

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
        ConfigError: the file cannot be read, or has an unknown key or an invalid value.
    """
    remedy = "`restock coverage gaps STORE --missions-out FILE` writes one"
    document = read_toml(Path(path), remedy=remedy)
    return typed(document, MissionsFile, where=str(path), remedy=_REMEDY, renamed=MISSIONS_KEYS)


def from_shopping_list(found: ShoppingList, *, store: str, mixture: str) -> MissionsFile:
    """Convert a shopping list to a missions file; `store` is STORE@VERSION.

    Raises:
        ConfigError: the list has no orders: there are no gaps, or no gap has a known rate.
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
    """Raise ConfigError if the path exists."""
    if path.exists():
        raise ConfigError(
            "already there", where=str(path), remedy="choose another name, or remove it"
        )


def write_missions(path: Path, missions: MissionsFile) -> None:
    """Write a missions file atomically. Raises ConfigError if it cannot be written."""
    try:
        write_text(path, as_toml(missions))
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error


def as_toml(missions: MissionsFile) -> str:
    """Return the TOML text of a missions file."""
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
