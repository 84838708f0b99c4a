"""`restock profile schema`: prints what a TOML file may contain, for editors."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from restock.cli import output
from restock.cli.words import Positional
from restock.errors import ConfigError

# name of a config -> the files that have it
CONFIGS: Mapping[str, str] = {
    "train": "`restock train --config`",
    "mixture": "`restock mix --mixture`",
    "profile": "`restock ingest --profile`: a robot's topics and task",
    "study": "`restock train`: arms to compare",
    "layout": "`--layouts`: a floor",
    "perturbation": "`restock twin record --perturbation`: effective parameters",
    "schedule": "the same: effective parameters, drawn per episode from `ranges`",
    "missions": "`restock twin record --missions`",
}


@dataclass
class SchemaCommand:
    """Print the JSON Schema of a config, with which an editor completes and checks the TOML file.

    Without NAME, it lists the configs. Run `restock profile schema train > train.schema.json`, and
    make this the first line of the TOML file: #:schema ./train.schema.json (read by Taplo, and so
    by the VS Code extension Even Better TOML).
    """

    name: Annotated[str | None, Positional("NAME")] = None
    """The name of the config."""
    json: bool = False
    """Print the list as JSON (a schema is always JSON)."""

    def run(self) -> None:
        """Print the schema, or the list."""
        if self.name is not None and self.name not in CONFIGS:
            raise ConfigError(
                f"there is no config named {self.name!r}",
                remedy=f"choose one of {', '.join(CONFIGS)}",
            )
        if self.name is not None:
            sys.stdout.write(schema_of(self.name))
        else:
            rows = [{"name": name, "of": of} for name, of in CONFIGS.items()]
            output.print_json(rows) if self.json else output.print_table(rows)


def schema_of(name: str) -> str:
    """Return the JSON Schema of a config, as text (`#:schema FILE` in the TOML).

    It contains the types, ranges and defaults of the struct, but no rules about several keys.
    Those are checked when the file is read.
    """
    schema = msgspec.json.schema(_kinds()[name])
    for definition in schema["$defs"].values():  # docstrings keep their indent before Python 3.13
        definition["description"] = inspect.cleandoc(definition.get("description", ""))
    if name == "profile":
        _conditions_in_files(schema)
    draft = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps({"$schema": draft, "title": f"Restock {name}", **schema}, indent=1) + "\n"


def _kinds() -> dict[str, type]:
    from restock.ingest.profile.profile import Profile
    from restock.replay.fleet.missions_file import MissionsFile
    from restock.replay.mixture.mixture import Mixture
    from restock.train.dqn.config import TrainConfig
    from restock.train.study.study import Study
    from restock.train.twin.floors.floor_files import FloorFile
    from restock.train.twin.physics.perturbation import Perturbation, Schedule

    return {
        "train": TrainConfig,
        "mixture": Mixture,
        "profile": Profile,
        "study": Study,
        "layout": FloorFile,
        "perturbation": Perturbation,
        "schedule": Schedule,
        "missions": MissionsFile,
    }


def _conditions_in_files(schema: dict[str, Any]) -> None:
    """Allow a `[[condition]]` to name a .sql file instead of giving its `sql`."""
    condition = schema["$defs"]["Condition"]
    condition["properties"]["file"] = {
        "type": "string",
        "pattern": r"\.sql$",
        "description": "with the rule and its settings, in the profile's folder; or sql",
    }
    condition["required"] = [key for key in condition["required"] if key == "name"]
    condition["oneOf"] = [{"required": ["sql"]}, {"required": ["file"]}]
