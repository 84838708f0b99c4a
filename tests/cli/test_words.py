"""Command lines become the dataclasses of verbs, or errors that name the option."""

from pathlib import Path

import pytest

from restock.cli.data.ingest import IngestCommand
from restock.cli.data.sql import SqlCommand
from restock.cli.fleet.coverage import GapsCommand
from restock.cli.learning.diagnose import DiagnoseCommand
from restock.cli.learning.train import TrainCommand
from restock.cli.twin.layout import LayoutCommand
from restock.cli.words import parse
from restock.errors import ConfigError


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--export x.csv s", SqlCommand(path="s", export=Path("x.csv"))),
        ("s - --json", SqlCommand(path="s", second="-", json=True)),
        ("a b --store=-s --json", IngestCommand(paths=("a", "b"), store="-s", json=True)),
        ("a --store b c -- --d", IngestCommand(paths=("a", "c", "--d"), store="b")),
        ("--tag k=v --tag=l=w a", IngestCommand(paths=("a",), tag=("k=v", "l=w"))),
        ("a --watch", IngestCommand(paths=("a",), watch=())),
        ("", IngestCommand(paths=())),
        ("--from s --by map", LayoutCommand(source="s", by="map")),
        ("s --min-rows -4 --thresholds none", GapsCommand("s", "coverage", Path("none"), -4)),
        ("a --no-twin", DiagnoseCommand(places=(Path("a"),), twin=False)),
        ("--set a=1 --seconds 1e3 --set b=2", TrainCommand(set=("a=1", "b=2"), seconds=1000.0)),
    ],
)
def test_line_is_parsed(words: str, expected: object) -> None:
    assert parse(type(expected), "restock", words.split()) == expected


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("a --jsn", "unknown: --jsn (did you mean --json?)"),
        ("a --forc", "unknown: --forc (did you mean --force?)"),  # options are not abbreviated
        ("a --twin=1", "unknown: --twin=1"),
        ("a --store", "--store: expected one argument"),
        ("a --store --json", "--store: expected one argument"),
        ("a --workers x", "--workers: invalid int value: 'x'"),
        ("a --repeated keeps", "--repeated: invalid choice: 'keeps' (choose from"),
    ],
)
def test_wrong_line_is_refused(words: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse(IngestCommand, "restock ingest", words.split())
    assert message in refused.value.what
    assert str(refused.value.remedy).startswith("`restock ingest --help`")


def test_required_words_are_named() -> None:
    with pytest.raises(ConfigError, match="required: PATH"):
        parse(SqlCommand, "restock sql", [])
