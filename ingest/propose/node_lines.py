"""What Restock's own node published: a proposal reads it as `restock-node --write-profile` does."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from restock.errors import ConfigError
from restock.ingest.live.node_topics import with_node_topics
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.evidence.gather import Evidence
from restock.toml import toml_value


def node_lines(seen: Evidence, lines: Sequence[str]) -> list[str]:
    """The tables for those of the node's topics that were recorded, besides the proposal's own.

    Args:
        seen: with the node's topics.
        lines: the TOML of the proposal so far; where it lacks an input there is nothing to add to.
    """
    if not seen.node_topics:
        return []
    try:
        profile = parse_profile("\n".join(lines), where="the proposal")
    except ConfigError:
        return []
    full, heard = with_node_topics(profile), seen.node_topics.items()
    tables: list[tuple[str, msgspec.Struct]] = [
        (f"[command_sources.{name}]  # who drives while it is true", source)
        for name, source in full.command_sources.items()
        if name not in profile.command_sources and (source.topic, source.type) in heard
    ]
    signals = {
        name: signal
        for name, signal in full.signals.items()
        if name not in profile.signals and (signal.topic, signal.type) in heard
    }
    tables += [(f"[signals.{name}]", signal) for name, signal in signals.items()]
    tables += [
        ("[[condition]]", condition)
        for condition in full.own_conditions
        if condition not in profile.own_conditions and "limiter_rule" in signals
    ]
    added = [line for header, table in tables for line in [header, *_given(table), ""]]
    return ["# Published by Restock's node, or for it:", "", *added] if added else []


def _given(table: msgspec.Struct) -> list[str]:
    """The keys of a table that are not at their defaults."""
    values = msgspec.to_builtins(table)
    return [
        f"{one.name} = {toml_value(values[one.encode_name])}"
        for one in msgspec.structs.fields(table)
        if values[one.encode_name] not in (one.default, {})
    ]
