"""Typed TOML: values read back equal; a key or a value that does not fit is named."""

import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta, inspect

from restock.errors import ConfigError
from restock.ingest.profile.profile import Profile
from restock.ingest.task.task import Rewards
from restock.replay.mixture.mixture import Mixture
from restock.toml import Checked, parse_toml, read_toml, toml_value, typed
from restock.train.dqn.config import TrainConfig
from restock.train.study.study import Study

plain = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8")),
    lambda inner: (
        st.lists(inner) | st.dictionaries(st.text("abc_1", min_size=1), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(plain)
def test_toml_value_round_trips(value: Any) -> None:
    assert tomllib.loads(f"key = {toml_value(value)}")["key"] == value


Share = Annotated[float, Meta(ge=0, lt=1)]
Count = Annotated[int, Meta(ge=1)]


class Inner(Checked, frozen=True):
    share: Share = 0.5
    parts: tuple[Share, ...] = ()


class Config(Checked, frozen=True):
    share: Share = 0.5
    count: Count = 1
    positive: Annotated[float, Meta(gt=0)] = 1.0
    most: Annotated[float, Meta(le=1)] = 1.0
    low: Annotated[float, Meta(gt=-1, le=1)] = 0.0
    list_of: list[Share] = msgspec.field(default_factory=list)
    tuple_of: tuple[Share, ...] = ()
    pair: tuple[Share, Count] = (0.0, 1)
    table: dict[str, Share] = msgspec.field(default_factory=dict)
    lists: dict[str, tuple[Share, ...]] = msgspec.field(default_factory=dict)
    maybe: Share | None = None
    either: Literal["auto"] | Share = "auto"
    several: float | list[Share] | dict[str, Share] = 0.0
    unbounded: float = 0.0
    points: tuple[tuple[float, float], ...] = ()
    place: tuple[float, float] | None = None
    inner: Inner = Inner()
    inners: tuple[Inner, ...] = ()
    by_name: dict[str, Inner] = msgspec.field(default_factory=dict)
    free: str = ""

    def check(self) -> None:
        if self.count > 1 and self.free:
            raise ValueError("count must be 1 where free is given")


# What is wrong, and how both a file and Python say so.
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"share": 1.0}, "share must be in [0, 1), got 1.0"),
    ({"share": math.nan}, "share must be in [0, 1), got nan"),
    ({"positive": math.inf}, "positive must be finite, got inf"),
    ({"points": [[0.0, math.nan]]}, "points[0][1] must be finite, got nan"),
    ({"count": 0}, "count must be at least 1, got 0"),
    ({"positive": 0.0}, "positive must be above 0, got 0.0"),
    ({"low": -1.0}, "low must be in (-1, 1], got -1.0"),
    ({"list_of": [0.1, 7.0]}, "list_of[1] must be in [0, 1), got 7.0"),
    ({"pair": [0.5, 0]}, "pair[1] must be at least 1, got 0"),
    ({"table": {"a": 0.1, "b": 2.0}}, "table.b must be in [0, 1), got 2.0"),
    ({"lists": {"a": [0.1], "b": [0.1, 3.0]}}, "lists.b[1] must be in [0, 1), got 3.0"),
    ({"several": [0.1, 3.0]}, "several[1] must be in [0, 1), got 3.0"),
    ({"count": 2, "free": "x"}, "count must be 1 where free is given"),
]
IN_FILES: list[tuple[dict[str, Any], str]] = [
    ({"inner": {"share": 3.0}}, "inner.share must be in [0, 1), got 3.0"),
    ({"inners": [{}, {"parts": [0.1, 2.0]}]}, "inners[1].parts[1] must be in [0, 1), got 2.0"),
    ({"by_name": {"a": {}, "b": {"share": 3.0}}}, "by_name.b.share must be in [0, 1), got 3.0"),
    ({"nothing": 1}, "unknown key `nothing`"),
    ({"inners": [{"nothing": 1}]}, "unknown key `inners[0].nothing`"),
    ({"share": "x"}, "`share`: Expected `float`, got `str`"),
    ({"either": "no"}, "`either`: Invalid enum value 'no'; choose from \"auto\", a number"),
]


@pytest.mark.parametrize(("values", "message"), REFUSED, ids=lambda value: str(value)[:40])
def test_file_and_python_refuse_with_same_message(values, message):
    with pytest.raises(ValueError) as in_python:  # noqa: PT011
        Config(**values)
    assert str(in_python.value) == message
    with pytest.raises(ConfigError) as in_a_file:
        typed(values, Config, where="config.toml")
    assert str(in_a_file.value) == f"config.toml: {message}"


@pytest.mark.parametrize(("values", "message"), IN_FILES, ids=lambda value: str(value)[:40])
def test_error_names_the_dotted_key(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        typed(values, Config, where="config.toml", remedy="see the docs")
    what, remedy = str(refused.value).split("\n  ")
    assert what == f"config.toml: {message}"
    assert remedy.endswith("see the docs")
    assert refused.value.where == "config.toml"


@pytest.mark.parametrize(
    ("values", "kind", "meant"),
    [
        ({"shair": 0.5}, Config, "share"),
        ({"inner": {"shair": 0.5}}, Config, "inner.share"),
        ({"inners": [{}, {"part": []}]}, Config, "inners[1].parts"),
        ({"loss": {"discont": 0.9}}, TrainConfig, "loss.discount"),
        ({"target": {"rule": "polyak", "taw": 0.1}}, TrainConfig, "target.tau"),
        ({"strata": [{"name": "a", "wher": "true"}]}, Mixture, "strata[0].where"),
    ],
)
def test_unknown_key_suggests_nearest(values, kind, meant):
    for remedy, rest in (("see the docs", " see the docs"), (None, "")):
        with pytest.raises(ConfigError, match="unknown key") as refused:
            typed(values, kind, where="config.toml", remedy=remedy)
        assert refused.value.remedy == f"did you mean `{meant}`?{rest}"


def test_unknown_reward_lists_known_ones() -> None:
    with pytest.raises(ConfigError, match="there are action_change, bump, goal, ") as refused:
        typed({"energy": -1.0}, Rewards, where="p.toml", prefix="task.rewards")
    assert refused.value.what == "unknown key `task.rewards.energy`"


def misspelt(kind: inspect.Type) -> Iterator[tuple[Any, set[str]]]:
    """Values that are wrong where a type has names to choose from, each with all names there."""
    if isinstance(kind, inspect.UnionType):
        found: dict[str, tuple[Any, set[str]]] = {}
        for value, names in (one for option in kind.types for one in misspelt(option)):
            found.setdefault(str(value), (value, set()))[1].update(names)
        yield from found.values()
    elif isinstance(kind, inspect.LiteralType):
        yield "nonsense", set(map(str, kind.values))
    elif isinstance(kind, inspect.StructType):
        tag = {kind.tag_field: kind.tag} if kind.tag_field else {}
        if kind.tag_field:
            yield {kind.tag_field: "nonsense"}, {str(kind.tag)}
        for field in kind.fields:
            for value, names in misspelt(field.type):
                yield tag | {field.encode_name: value}, names
    elif isinstance(kind, inspect.VarTupleType | inspect.ListType):
        yield from (([value], names) for value, names in misspelt(kind.item_type))
    elif isinstance(kind, inspect.DictType):
        yield from (({"a": value}, names) for value, names in misspelt(kind.value_type))


@pytest.mark.parametrize("kind", [TrainConfig, Mixture, Profile, Study])
def test_settings_with_choices_list_them(kind: type) -> None:
    wrong = list(misspelt(inspect.type_info(kind)))
    assert wrong
    for values, names in wrong:
        with pytest.raises(ConfigError, match="nonsense") as refused:
            typed(values, kind, where="config.toml")
        listed = refused.value.what.partition("; choose from ")[2]
        assert set(re.findall(r'"(.+?)"', listed)) == names, refused.value.what


def test_renamed_key_is_refused_with_new_name() -> None:
    renamed = {"portion": "use share", "inner.portion": "use inner.share"}
    for values, old, new in (
        ({"portion": 0.1}, "portion", "share"),
        ({"inner": {"portion": 0.1}}, "inner.portion", "inner.share"),
        ({"inner": [{}, {"portion": 0.1}]}, "inner.portion", "inner.share"),
    ):
        with pytest.raises(ConfigError) as refused:
            typed(values, Config, where="config.toml", renamed=renamed)
        assert refused.value.what == f"unknown key `{old}`"
        assert refused.value.remedy == f"use {new}"
    assert typed({"share": 0.1}, Config, where="config.toml", renamed=renamed).share == 0.1


@given(st.floats(allow_nan=False), st.integers(-3, 3))
def test_python_accepts_what_a_file_accepts(share: float, count: int) -> None:
    def made(how: Any) -> Config | None:
        try:
            config: Config = how()
        except (ValueError, ConfigError):
            return None
        return config

    values = {"share": share, "count": count, "list_of": [share], "inner": {"share": share}}
    in_a_file = made(lambda: typed(values, Config, where="config.toml"))
    in_python = made(lambda: Config(share, count, list_of=[share], inner=Inner(share)))
    assert in_a_file == in_python
    assert (in_a_file is None) == (not 0 <= share < 1 or count < 1)
    if in_a_file is not None:
        assert typed(msgspec.to_builtins(in_a_file), Config, where="again") == in_a_file


def test_unreadable_file_error_gives_reason(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot be read: No such file(.|\n)*check the path"):
        read_toml(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("a = [1", encoding="utf-8")
    (tmp_path / "latin.toml").write_bytes(b"a = '\xe9'")
    for name in ("bad.toml", "latin.toml"):
        with pytest.raises(ConfigError, match="is not TOML"):
            read_toml(tmp_path / name)
    with_mark = "utf-8-sig"  # which some editors put before UTF-8
    (tmp_path / "good.toml").write_text("a = 1\n[b]\nc = 'x'", encoding=with_mark)
    assert read_toml(tmp_path / "good.toml") == {"a": 1, "b": {"c": "x"}}


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 50_000 + "]" * 50_000,
        "a = " + "{a = " * 50_000 + "1" + "}" * 50_000,
        "a." * 50_000 + "b = 1",
        "[" + "a . " * 50_000 + "b]",
        "a = " + "[" * 200 + "]" * 200,
        ".".join('"a"' for _ in range(200)) + " = 1",
    ],
)
def test_deep_nesting_is_refused(text):
    with pytest.raises(ConfigError, match=r"^a\.toml: is nested more than 64 levels deep$"):
        parse_toml(text, where="a.toml")
