"""Check of a condition's SQL, which may only be an expression over the steps of its episode.

Profiles are passed between strangers, so the SQL of a condition is parsed and checked before it
runs. It may contain no query and no other table, and no function that reads anything but the steps
(files, settings, the time, random numbers) or whose result grows without bound. Its windows must
stay in the episode, and those of a `pre` condition must not look at later steps. In addition,
DuckDB runs it without access to files and with locked settings.
"""

from __future__ import annotations

import atexit
import json
from collections.abc import Iterator
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # slow to import, and not needed for conditions that are in the store already
    import duckdb

WINDOW = "WINDOW episode AS (PARTITION BY episode_index ORDER BY step_index)"
SANDBOX: dict[str, str | bool | int | float | list[str]] = {
    "threads": 1,
    "enable_external_access": False,
    "autoload_known_extensions": False,
    "autoinstall_known_extensions": False,
    "allow_community_extensions": False,
    "memory_limit": "1GB",
}
_REFUSED = {
    "SUBQUERY": "it contains a query: a condition must be one expression over the steps",
    "STAR": "it contains *: name the columns",
    "PARAMETER": "it contains a parameter",
    "POSITIONAL_REFERENCE": "it refers to a column by position: use its name",
}
_BRACKETS = "its brackets do not match"
_UNBALANCED = f"{_BRACKETS}: a condition must be one expression over the steps"
# DuckDB's macros that depend only on their arguments, by prefix and by name; others are refused.
_MACROS = ("list_", "array_")
_MORE_MACROS = {
    *("nullif", "if", "fmod", "fdiv", "split_part", "date_add", "days_in_month"),
    *("geomean", "geometric_mean", "wavg", "weighted_avg"),
}
# Functions that make values of any size from two numbers: a short text could fill the memory.
_GROWING = {
    *("repeat", "list_repeat", "array_repeat", "range", "generate_series", "generate_subscripts"),
    *("lpad", "rpad", "bar", "list_resize", "array_resize", "printf", "format", "factorial"),
    "bitstring",
}
_MORE_ROWS = {"unnest", "unlist"}
_UNARY = {"lag", "lead", "first_value", "last_value", "nth_value", "ntile"}
_WINDOWED = {*_UNARY, "row_number", "rank", "dense_rank", "rank_dense", "percent_rank", "cume_dist"}
# Functions that use a time zone but are repeatable: the zone is an argument, or fixed here.
_ZONES = {"timezone", "make_timestamptz"}
_ZONED = {"TIMESTAMP WITH TIME ZONE", "TIMESTAMPTZ_NS"}
# Aggregates whose result depends on the order of rows. That of window functions always does.
_ORDERED = {
    *("any_value", "arbitrary", "list", "array_agg"),
    *("string_agg", "group_concat", "listagg"),
}
_FRAMED = {
    *("WINDOW_AGGREGATE", "WINDOW_FIRST_VALUE", "WINDOW_LAST_VALUE", "WINDOW_NTH_VALUE"),
}
_BACKWARD = {
    *_FRAMED,
    *("WINDOW_LAG", "WINDOW_ROW_NUMBER", "WINDOW_RANK", "WINDOW_RANK_DENSE"),
}


# Query that computes columns over the table `steps`, or over a subquery of it.
SELECT = "SELECT {columns} FROM {source} " + WINDOW + " ORDER BY row_"


@cache
def sandbox() -> duckdb.DuckDBPyConnection:
    """Return the one database in which all conditions run; each use opens a `cursor`.

    It stays open, as opening a database takes longer than labelling an episode.
    """
    import duckdb

    atexit.register(sandbox.cache_clear)  # else nanobind warns that databases outlive the module
    connection = duckdb.connect(config=SANDBOX)
    connection.execute("SET TimeZone = 'UTC'").fetchall()  # not the machine's time zone
    connection.execute("SET lock_configuration = true").fetchall()
    return connection


@lru_cache(maxsize=1024)
def refusal(sql: str, timing: Literal["pre", "post"]) -> str | None:
    """Return why a condition may not have this SQL, or None; unknown names are left to DuckDB."""
    # SQL that closes our bracket and opens another one parses in one kind of brackets only.
    both = (SELECT.format(columns=f"{a}{sql}\n{b}", source="steps") for a, b in ("()", "[]"))
    try:
        parsed, in_square = map(_parse, both)
        return _read(parsed, timing) or (_UNBALANCED if in_square["error"] else None)
    except RecursionError:
        return "it nests too deeply"


def _parse(query: str) -> dict[str, Any]:
    """Return DuckDB's tree of a query, or its `error_message`."""
    with sandbox().cursor() as connection:
        ((text,),) = connection.execute("SELECT json_serialize_sql(?::VARCHAR)", [query]).fetchall()
    parsed: dict[str, Any] = json.loads(text)
    return parsed


def _read(parsed: dict[str, Any], timing: str) -> str | None:
    if parsed["error"]:
        return _unreadable(parsed)
    statements = parsed["statements"]
    node = statements[0]["node"]
    if len(statements) != 1 or node["type"] != "SELECT_NODE" or len(node["select_list"]) != 1:
        return "it is more than one expression"
    if not _is_own_query(node):
        return _UNBALANCED
    for part in _walk(node["select_list"][0]):
        if reason := _refuse(part, timing):
            return reason
    return None


def _unreadable(parsed: dict[str, Any]) -> str:
    return "its SQL cannot be read: " + str(parsed["error_message"]).splitlines()[0]


def _is_own_query(node: dict[str, Any]) -> bool:
    """Return whether the parsed query is still `SELECT`: the expression added no clause to it."""
    source = node["from_table"]
    return (
        source["type"] == "BASE_TABLE"
        and source["table_name"] == "steps"
        and not node["cte_map"]["map"]
        and all(not node[key] for key in ("where_clause", "group_expressions", "having"))
        and all(not node[key] for key in ("qualify", "sample"))
        and [item["type"] for item in node["modifiers"]] == ["ORDER_MODIFIER"]
    )


def _walk(part: Any) -> Iterator[dict[str, Any]]:
    """Yield every node of an expression."""
    if isinstance(part, dict):
        if "class" in part:
            yield part
        for inner in part.values():
            yield from _walk(inner)
    elif isinstance(part, list):
        for inner in part:
            yield from _walk(inner)


def _refuse(part: dict[str, Any], timing: str) -> str | None:
    kind = part["class"]
    if kind == "STAR" and not part["columns"]:
        return None  # the * of count(*); DuckDB refuses this kind anywhere else
    if kind in _REFUSED:
        return _REFUSED[kind]
    if kind == "FUNCTION" and part["function_name"].lower() in _GROWING:
        return f"{part['function_name']}() can use unlimited memory: it is not allowed here"
    if kind == "FUNCTION" and part["function_name"].lower() in _MORE_ROWS:
        return f"{part['function_name']}() makes several rows of one: it is not allowed here"
    if kind == "FUNCTION" and part["function_name"].lower() in _WINDOWED:
        name = part["function_name"].lower()
        return f"{name}() needs a window: write `{name}({'x' * (name in _UNARY)}) OVER episode`"
    if kind in ("FUNCTION", "WINDOW") and part["function_name"].lower() in _impure():
        return f"{part['function_name']}() reads data other than the steps: it is not allowed here"
    if kind == "COLUMN_REF" and part["column_names"][-1].lower() in _impure():
        return f"{part['column_names'][-1]} reads data other than the steps: it is not allowed here"
    return _refuse_window(part, timing) if kind == "WINDOW" else None


def _refuse_window(part: dict[str, Any], timing: str) -> str | None:
    name = part["function_name"]
    if not any(_column(item) == "episode_index" for item in part["partitions"]):
        return f"{name}() would see other episodes: write OVER episode, or OVER (episode ROWS …)"
    if timing == "post":
        return None
    ahead = f"{name}() may look at later steps: "
    if part["type"] not in _BACKWARD:
        return ahead + 'use lag(), or in a condition set timing = "post"'
    orders = [(item["type"], _column(item["expression"])) for item in part["orders"]]
    if not orders or orders[0] not in [
        (kind, column)
        for kind in ("ORDER_DEFAULT", "ASCENDING")
        for column in ("step_index", "stamp_ns")
    ]:
        return ahead + "write OVER episode"
    backward = part["end"] in ("CURRENT_ROW_ROWS", "CURRENT_ROW_RANGE") or (
        part["end"].startswith("EXPR_PRECEDING") and _constant(part["end_expr"])
    )
    if not backward:
        return ahead + "end its frame at CURRENT ROW"
    offset = part["arguments"][1:2] if part["type"] == "WINDOW_LAG" else []
    if not all(_constant(item["expression"]) for item in offset):
        return ahead + "give lag() a constant number"
    return None


@lru_cache(maxsize=1024)
def names_in(sql: str) -> frozenset[str]:
    """Return the columns that an expression names, in lower case; `refusal` must accept it."""
    columns = (part for part in _parsed(sql) if part["class"] == "COLUMN_REF")
    return frozenset(part["column_names"][-1].lower() for part in columns)


@lru_cache(maxsize=1024)
def steps_back(sql: str) -> int | None:
    """Return how many steps an expression looks back; None: to the first step of the episode.

    `refusal` must accept the expression.
    """
    windows = [part for part in _parsed(sql) if part["class"] == "WINDOW"]
    back = [_window_back(part) for part in windows]
    return None if None in back else max((steps for steps in back if steps is not None), default=0)


def _window_back(part: dict[str, Any]) -> int | None:
    if part["type"] == "WINDOW_LAG" and not part["ignore_nulls"]:
        offset = part["arguments"][1:2]
        return int(offset[0]["expression"]["literal"]["text"]) if offset else 1
    if part["type"] in _FRAMED and not part["ignore_nulls"]:
        if part["start"] == "CURRENT_ROW_ROWS":
            return 0
        if part["start"] == "EXPR_PRECEDING_ROWS" and _constant(part["start_expr"]):
            return int(part["start_expr"]["literal"]["text"])
    return None


def _parsed(sql: str) -> Iterator[dict[str, Any]]:
    """Yield every node of an expression that `refusal` accepts."""
    parsed = _parse(SELECT.format(columns=f"({sql}\n)", source="steps"))
    return _walk(parsed["statements"][0]["node"]["select_list"])


def _column(part: dict[str, Any]) -> str:
    return str(part["column_names"][-1]) if part["class"] == "COLUMN_REF" else ""


def _constant(part: dict[str, Any] | None) -> bool:
    """Return whether a node is a constant integer of 0 or more."""
    if part is None or part["class"] != "CONSTANT":
        return False
    return str(part["literal"]["text"]).isdigit()


@cache
def _impure() -> frozenset[str]:
    """Return the names of functions whose result depends on more than their arguments.

    `+` and `date_trunc` of a time with a zone depend on the session's zone. It is fixed here, so
    these functions are not among the names.
    """
    with sandbox().cursor() as connection:
        macros = connection.sql(
            "SELECT function_name FROM duckdb_functions() WHERE function_type = 'macro'"
        ).fetchall()
    return (
        _volatile()
        | {"age", "error"}  # age() of a single time depends on today
        | {name for (name,) in macros if not name.startswith(_MACROS) and name not in _MORE_MACROS}
    )


@cache
def _volatile() -> frozenset[str]:
    """Return the names of functions that may return another value when called again."""
    with sandbox().cursor() as connection:
        rows = connection.sql(
            "SELECT DISTINCT function_name, stability, parameter_types::VARCHAR[]"
            " FROM duckdb_functions() WHERE function_type <> 'macro'"
        ).fetchall()
    return frozenset(
        name
        for name, stability, takes in rows
        if (stability == "VOLATILE")
        or (stability == "CONSISTENT_WITHIN_QUERY" and not _ZONED.intersection(takes))
    ) - {"error"}


@lru_cache(maxsize=1024)
def expression_problem(sql: str) -> str | None:
    """Return why this SQL is not one expression that can be put into brackets, or None."""
    # Two kinds of brackets, as in `refusal`.
    parsed, in_square = _parse(f"SELECT ({sql}\n)"), _parse(f"SELECT [{sql}\n]")
    if not in_square["error"]:
        return None
    return _unreadable(parsed) if parsed["error"] else f"{_BRACKETS}: it must be one expression"


@lru_cache(maxsize=1024)
def repeatability_problem(sql: str) -> str | None:
    """Return what makes an expression differ between runs on the same rows, or None.

    Also None for SQL that cannot be parsed: `expression_problem` refuses that.
    """
    for part in _walk(_parse(f"SELECT ({sql}\n)").get("statements", [])):
        kind = part["class"]
        name = part.get("function_name", "").lower()
        if kind == "COLUMN_REF" and len(part["column_names"]) == 1:  # e.g. current_date without ()
            name = part["column_names"][0].lower()
            if not name.startswith("current_"):
                continue
        if name in _volatile() - _ZONES or (name == "age" and len(part["arguments"]) == 1):
            return f"{name}() may differ from one call to the next"
        if kind == "WINDOW" and not part["orders"] and _depends_on_order(part):
            return f"{name}() OVER (…) without ORDER BY depends on the order in which rows are read"
    return None


def _depends_on_order(window: dict[str, Any]) -> bool:
    """Return whether a window without ORDER BY depends on the order of the rows."""
    if any(window[edge].endswith("_ROWS") for edge in ("start", "end")):
        return True
    ordered = window["type"] != "WINDOW_AGGREGATE" or window["function_name"].lower() in _ORDERED
    return ordered and not window["arg_orders"]  # first(x ORDER BY y) has an order of its own
