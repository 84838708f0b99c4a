"""docs/cli.md: each verb's usage, description and options, from what makes its `--help`.

`python -m restock.cli.reference docs/cli.md` writes the page's list again.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
import textwrap
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from restock.cli import VERBS, command_of, usage
from restock.cli.command_line import _bare, _metavar, jobs_of, prepared
from restock.words import between

BEGIN = "<!-- verbs: written by `python -m restock.cli.reference docs/cli.md` -->"
END = "<!-- end of verbs -->"


class Argument(NamedTuple):
    """A positional or an option of a verb, as its help shows it."""

    form: str  # "STORE", "--seed N", "--json"
    text: str
    is_option: bool
    is_required: bool

    @property
    def usage(self) -> str:
        """How a line of usage has it."""
        bare = self.is_required or self.form.startswith("[")
        return self.form if bare else f"[{self.form}]"


def markdown() -> str:
    """The list of docs/cli.md: what `restock --help` says, then each verb and its jobs."""
    called, does, _, ends = usage().split("\n\n")
    verbs = "\n".join(f"- [`{name}`](#restock-{name}): {text}" for name, text in VERBS.items())
    parts = [_code(called.removeprefix("usage: ")), does, verbs, ends]
    for verb in VERBS:
        parts += _entry(f"restock {verb}", command_of(verb), "##")
    return "\n\n".join(parts) + "\n"


def _entry(name: str, command: type[Any], level: str) -> Iterator[str]:
    """A verb's section; then one for each of its jobs, a level deeper."""
    prepared(command, explained=True)
    jobs = jobs_of(command)
    arguments = [] if jobs else [_argument(field) for field in dataclasses.fields(command)]
    arguments.sort(key=lambda one: one.is_option)
    words = [one.usage for one in arguments if not one.is_option or one.is_required]
    if any(one.is_option and not one.is_required for one in arguments):
        words.append("[options]")
    if jobs:
        words.append("{" + ",".join(jobs) + "}")
    yield f"{level} {name}"
    yield _code(" ".join([name, *words]))
    yield from _paragraphs(inspect.getdoc(command) or "")
    if arguments:
        yield "\n".join(f"- `{one.form}`: {_linked(one.text)}" for one in arguments)
    for job, kind in jobs.items():
        yield from _entry(f"{name} {job}", kind, f"{level}#")


def _argument(field: dataclasses.Field[Any]) -> Argument:
    """A field of a prepared dataclass."""
    extras = getattr(field.type, "__metadata__", ())

    def told(what: str) -> Any:
        given = [getattr(one, what, None) for one in extras]
        return next((one for one in reversed(given) if one is not None), None)

    bare = _bare(field.type)
    values = [kind for kind in typing.get_args(bare) if kind not in (type(None), ...)]
    is_list = typing.get_origin(bare) in (tuple, list)
    takes = told("metavar") or _metavar(values[0] if is_list else bare)
    if is_list and tyro.conf.UseAppendAction not in extras:
        takes += "…"
    is_option = tyro.conf.Positional not in extras
    has_default = field.default is not dataclasses.MISSING
    is_required = not has_default and field.default_factory is dataclasses.MISSING
    text = str(told("help"))
    if has_default and told("help_behavior_hint") is None:
        text += f" Default: `{field.default}`."
    if is_option:
        flag = "--" + (told("name") or field.name).replace("_", "-")
        if bare is bool:
            flag = f"--no-{flag[2:]}" if field.default is True else flag
            takes = ""
        takes = f"{flag} {takes}".strip()
        text += " Required." * is_required
    return Argument(takes, text, is_option, is_required)


def _paragraphs(text: str) -> Iterator[str]:
    """A docstring's paragraphs, one line each; what it indents stays as it is."""
    for paragraph in text.split("\n\n"):
        if paragraph.startswith("    "):
            yield _code(textwrap.dedent(paragraph))
        else:
            yield _linked(" ".join(paragraph.split()))


def _linked(text: str) -> str:
    return re.sub(r"\bdocs/([\w-]+\.md)", r"[\1](\1)", text)


def _code(text: str) -> str:
    return f"```text\n{text}\n```"


def rewrite(text: str) -> str:
    """A page with the list between its two markers written again."""
    return between(text, BEGIN, END, markdown())


if __name__ == "__main__":
    page = Path(sys.argv[1])
    page.write_text(rewrite(page.read_text(encoding="utf-8")), encoding="utf-8")
