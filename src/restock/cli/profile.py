"""`restock profile`: propose a profile for a recording, or check one against it."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from restock.errors import ConfigError, ExitCode, RecordingError


@dataclass
class Profile:
    """Propose a profile for an unknown robot, or check one against a recording.

    `restock profile new RECORDING` proposes one from what is in the file: topics by type and name,
    rates, the speeds that were commanded; with a comment at each guess. It is printed, or written
    to --out.

    `restock profile check PROFILE RECORDING` says what would be used, what is missing, how many
    transitions there would be and what each condition would label. Nothing is written.
    """

    action: Annotated[Literal["new", "check"], tyro.conf.Positional]
    """new RECORDING, or check PROFILE RECORDING."""
    paths: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """The recording; for `check`, the profile (a file or a shipped name) first."""
    out: Path | None = None
    """Where `new` writes the profile. Nothing is overwritten."""
    typestore: str | None = None
    """Distribution whose message definitions serve recordings without their own (humble)."""
    json: bool = False
    """Print one JSON document: `new`: {"toml", "missing"}; `check`: {"inputs", "problems", …}."""

    def run(self) -> int:
        """Do one of the two."""
        wanted = 1 if self.action == "new" else 2
        if len(self.paths) != wanted:
            raise ConfigError(
                f"`profile {self.action}` takes {wanted} path{'s' * (wanted > 1)}, "
                f"got {len(self.paths)}",
                remedy="restock profile new RECORDING; restock profile check PROFILE RECORDING",
            )
        return self._new() if self.action == "new" else self._check()

    def _new(self) -> int:
        from restock.cli import output
        from restock.ingest.propose import propose
        from restock.ingest.readers import open_recording

        if self.out is not None and self.out.exists():
            raise ConfigError("is there already", where=str(self.out), remedy="name another --out")
        stem = (self.out or Path(self.paths[0])).stem
        with open_recording(self.paths[0], typestore=self.typestore) as recording:
            proposal = propose(recording, re.sub(r"\W+", "_", stem).strip("_") or "robot")
        if self.out is not None:
            self.out.write_text(proposal.toml, encoding="utf-8")
        if self.json:
            output.print_json({"toml": proposal.toml, "missing": proposal.missing})
        elif self.out is None:
            sys.stdout.write(proposal.toml)
        for name in proposal.missing:
            output.say(f"no topic for {name}, which every profile needs")
        return ExitCode.OK

    def _check(self) -> int:
        from restock.cli import output
        from restock.cli.ingest import as_json, show
        from restock.ingest.pipeline import ingest
        from restock.ingest.needs import input_problems
        from restock.ingest.profile import load_profile
        from restock.ingest.readers import open_recording

        profile = load_profile(self.paths[0])
        with open_recording(self.paths[1], typestore=self.typestore) as recording:
            topics = {n: t for n, t in recording.topics.items() if t.skipped is None}
            leaves = {name: recording.fields(name) for name in profile.topics if name in topics}
            problems = input_problems(profile, topics, leaves)
            inputs: list[dict[str, Any]] = [
                {
                    "input": name,
                    "topic": source.topic,
                    "type": source.type,
                    "messages": topics[source.topic].expected if source.topic in topics else 0,
                    "at most s old": source.max_age_s,
                    "optional": source.optional,
                }
                for name, source in profile.inputs.items()
            ]
        said: dict[str, Any] = {"profile": profile.name, "hash": profile.hash, "inputs": inputs}
        if not self.json:
            output.print_table(inputs)
        outcome, code = None, ExitCode.OK
        if not problems:
            try:
                outcome = ingest(self.paths[1], profile, store=None, typestore=self.typestore)
            except RecordingError as error:
                problems = [error.what]
        if problems:
            code = ExitCode.USAGE
        if self.json:
            said |= {"problems": problems, "outcome": as_json(outcome) if outcome else None}
            output.print_json(said)
        elif outcome is not None:
            show(outcome)
        for problem in problems:
            sys.stderr.write(f"restock: {self.paths[1]}: {problem}\n")
        return code
