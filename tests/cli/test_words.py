"""Plain command lines are parsed without tyro, with the same result."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from restock.cli import FOLDER_OF, command_of
from restock.cli.command_line import parse
from restock.cli.data.ingest import IngestCommand
from restock.cli.data.sql import SqlCommand
from restock.cli.twin.layout import LayoutCommand
from restock.cli.words import parse_plain

COMMANDS = [command_of(name) for name in (*FOLDER_OF, "node", "mcp")]
WORDS = ("a", "store/b", "7", "0.5", "-3", "None", "", "-", "--", "new", "cpu", "k=v", "1_0", " 2 ")


@st.composite
def lines(draw: st.DrawFn) -> tuple[type[Any], list[str]]:
    """Draw a command and words: positional arguments, then options and values that may fit."""
    command = draw(st.sampled_from(COMMANDS))
    names = [field.name.replace("_", "-") for field in dataclasses.fields(command)]
    option, word = st.sampled_from([f"--{name}" for name in names]), st.sampled_from(WORDS)
    part = st.one_of(
        option.map(lambda name: [name]),
        st.tuples(option, word).map(list),
        st.tuples(option, word).map(lambda both: ["=".join(both)]),
        st.sampled_from(("--no-twin", "--jsn", *WORDS)).map(lambda one: [one]),
    )
    places = draw(st.lists(st.sampled_from(("a", "new")), max_size=2))
    return command, [*places, *(one for words in draw(st.lists(part, max_size=3)) for one in words)]


@settings(max_examples=200, deadline=None)
@given(lines())
def test_plain_lines_are_parsed_as_by_tyro(line: tuple[type[Any], list[str]]) -> None:
    command, words = line
    plain = parse_plain(command, words)
    event("plain" if plain else "left to tyro")
    assert plain is None or plain == parse(command, "restock", words)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--export x.csv s", SqlCommand(path="s", export=Path("x.csv"))),
        ("a b --store=-s --json", IngestCommand(paths=("a", "b"), store="-s", json=True)),
        ("--tag k=v --tag=l=w a", IngestCommand(paths=("a",), tag=("k=v", "l=w"))),
        ("--from s --by map", LayoutCommand(source="s", by="map")),
    ],
)
def test_plain_lines_need_no_tyro(words: str, expected: object) -> None:
    assert parse_plain(type(expected), words.split()) == expected


@pytest.mark.parametrize(
    "words", ["", "a --help", "a --jsn", "a --store", "a --workers x", "a -- b", "a --store b c"]
)
def test_other_lines_are_left_to_tyro(words: str) -> None:
    assert parse_plain(IngestCommand, words.split()) is None
