"""`restock --tyro-write-completion SHELL FILE`: completion of verbs, jobs and options, by tyro."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Union

import tyro

from restock.cli import COMPLETION, JOBS, VERBS, command_of
from restock.cli.command_line import prepared
from restock.errors import ConfigError, ExitCode

SHELLS = ("bash", "zsh", "tcsh", "fish")


def write_completion(args: list[str]) -> int:
    """Write the script that completes `restock` in a shell.

    Raises:
        ConfigError: a shell and a file are not given.
    """
    if len(args) != 3 or args[1] not in SHELLS:
        raise ConfigError(
            "takes the name of a shell, and a file to write to, or - for stdout",
            where=COMPLETION,
            remedy=f"choose one of {', '.join(SHELLS)}",
        )
    try:
        tyro.cli(
            _every_command(),
            prog="restock",
            args=args,
            use_underscores=False,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes),
        )
    except SystemExit as stop:
        return int(stop.code or ExitCode.OK)
    return int(ExitCode.OK)


def _every_command() -> Any:
    """Return a union of all verbs; a verb that has nothing but jobs is a union of these."""
    kinds = {}
    for verb in VERBS:
        if verb in ("store", "twin"):
            jobs = {job: prepared(command_of(f"{verb} {job}")) for job in JOBS[verb]}
            kinds[verb] = dataclasses.make_dataclass(verb, [("job", _union(jobs))])
        else:
            kinds[verb] = prepared(command_of(verb))
    return _union(kinds)


def _union(kinds: Mapping[str, type[Any]]) -> Any:
    named = [
        Annotated[kind, tyro.conf.subcommand(name, prefix_name=False, description=None)]
        for name, kind in kinds.items()
    ]
    return Union[tuple(named)]  # noqa: UP007
