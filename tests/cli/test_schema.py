"""`restock profile schema`: the schemas accept what Restock reads, and nothing else."""

import json
import subprocess
import tomllib
from typing import Any

import msgspec
import pytest
from jsonschema import Draft202012Validator
from support.paths import ROOT

from restock.cli.learning.schema import CONFIGS, schema_of
from restock.train.dqn.config import TrainConfig
from restock.train.twin.physics.perturbation import PERTURBATIONS

SCHEMAS = {name: json.loads(schema_of(name)) for name in CONFIGS}


def problems(name: str, document: dict[str, Any]) -> list[str]:
    plain = json.loads(json.dumps(document, default=str))  # TOML has dates, JSON has not
    errors = Draft202012Validator(SCHEMAS[name]).iter_errors(plain)
    return [f"{error.json_path}: {error.message}" for error in errors]


def kind_of(path: str, document: dict[str, Any]) -> str | None:
    """Return the kind of a shipped TOML file, by its path and keys."""
    if path.startswith("ingest/profile/profiles/"):
        return "profile"
    if path.startswith(("replay/mixture/mixtures/", "benchmarks/")):
        return "study" if "arms" in document else "mixture"
    return None


def shipped() -> list[tuple[str, str]]:
    tracked = subprocess.run(
        ["git", "ls-files", "*.toml"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split()
    files = tracked or [
        str(p.relative_to(ROOT)) for p in (ROOT / "replay").rglob("mixtures/*.toml")
    ]
    found = [(path, kind_of(path, tomllib.loads((ROOT / path).read_text()))) for path in files]
    return [(path, kind) for path, kind in found if kind is not None]


@pytest.mark.parametrize("name", CONFIGS)
def test_schema_is_valid(name: str) -> None:
    Draft202012Validator.check_schema(SCHEMAS[name])
    assert SCHEMAS[name]["title"] == f"Restock {name}"
    assert problems(name, {"nothing_has_this_key": 1})


@pytest.mark.parametrize(("path", "kind"), shipped())
def test_shipped_file_is_accepted(path: str, kind: str) -> None:
    assert problems(kind, tomllib.loads((ROOT / path).read_text())) == []


def test_written_configs_are_accepted() -> None:
    assert problems("train", msgspec.to_builtins(TrainConfig())) == []
    for perturbation in PERTURBATIONS.values():
        assert problems("perturbation", msgspec.to_builtins(perturbation)) == []


@pytest.mark.parametrize(
    ("name", "toml", "problem"),
    [
        ("train", "[loss]\nn_steps = 3", "n_steps"),
        ("train", "[loss]\nn_step = 0", "less than the minimum"),
        ("train", "record.trackers = ['comet']", "is not one of"),
        ("mixture", "n_step = 'three'", "is not of type 'integer'"),
        ("study", "seeds = [0]", "'arms' is a required property"),
        ("profile", "name = 'x'\n[task.body]\nlength_m = 1", "'width_m' is a required property"),
        ("layout", "width_m = 3\ndepth_m = 3\nracks = [[0, 0, 1]]", "too short"),
        ("missions", "[[missions]]\nkind = 'nominal'\nmissions = 2\nzones = 'a'", "zones"),
    ],
)
def test_invalid_config_is_rejected(name: str, toml: str, problem: str) -> None:
    assert problem in "; ".join(problems(name, tomllib.loads(toml)))


def test_schema_verb_lists_and_prints_schemas(shell):
    assert [row["name"] for row in shell.json("profile", "schema")] == list(CONFIGS)
    assert json.loads(shell.out("profile", "schema", "study")) == SCHEMAS["study"]
    assert "choose one of train" in shell.err("profile", "schema", "robot")
