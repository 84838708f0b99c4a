"""`restock completion`: a script that completes verbs, options and choices in bash and zsh.

It is made of the verbs' own argument structs, once, so that a Tab starts no Python.
"""

from __future__ import annotations

import sys
import typing
from dataclasses import dataclass
from importlib.resources import files
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from restock.cli.command_line import Names, jobs_of

# option -> the folder of the TOML files whose names it takes; it takes files, too
SHIPPED = {
    "--mixture": ("restock.replay.mixture", "mixtures"),
    "--profile": ("restock.ingest.profile", "profiles"),
}


class Words(NamedTuple):
    """What may follow a verb (or a job of it): options, the choices of some, and jobs."""

    options: tuple[str, ...]
    choices: dict[str, tuple[str, ...]]  # "" for the first positional
    jobs: dict[str, Words]


@dataclass
class CompletionCommand:
    """Print a script that completes verbs, options and their choices in a shell.

        source <(restock completion bash)                  # this shell; or in ~/.bashrc
        restock completion zsh > ~/.zfunc/_restock         # a folder of your fpath

    Everything else is completed as a file name. Generate the script again after an update.
    """

    shell: Annotated[Literal["bash", "zsh"], tyro.conf.Positional]
    """The shell that will run the script."""

    def run(self) -> None:
        """Print the script."""
        sys.stdout.write(bash() if self.shell == "bash" else zsh())


def words_of(command: type[Any]) -> Words:
    """The command line of a verb's dataclass."""
    options, choices = ["--help"], dict[str, tuple[str, ...]]()
    jobs = {job: words_of(kind) for job, kind in jobs_of(command).items()}
    for name, hint in typing.get_type_hints(command, include_extras=True).items():
        bare, *extras = typing.get_args(hint) if _is(hint, Annotated) else (hint,)
        kinds = [one for one in typing.get_args(bare) if one is not type(None)] or [bare]
        if jobs and any(_is(one, Annotated) for one in kinds):
            continue
        literal = next((one for one in (bare, *kinds) if _is(one, Literal)), None)
        told_name = next((e.name for e in extras if getattr(e, "name", None)), None)
        flag = "--" + (told_name or name).replace("_", "-")
        if tyro.conf.Positional in extras:
            flag = ""
        elif bare is bool and getattr(command, name, False) is True:
            flag = "--no-" + flag[2:]
        if flag:
            options.append(flag)
        names = next((extra.names for extra in extras if isinstance(extra, Names)), ())
        if literal is not None:
            names = tuple(map(str, typing.get_args(literal)))
        if names := names or _shipped(flag):
            choices.setdefault(flag, names)
    return Words(tuple(options), choices, jobs)


def _shipped(flag: str) -> tuple[str, ...]:
    """The names of the files that come with Restock and that an option takes."""
    if flag not in SHIPPED:
        return ()
    package, folder = SHIPPED[flag]
    names = (entry.name for entry in (files(package) / folder).iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml")))


def _is(hint: Any, origin: Any) -> bool:
    return typing.get_origin(hint) is origin


def every_verb() -> dict[str, Words]:
    """Each verb's words, in the order of the help."""
    from restock.cli import VERBS, command_of

    return {verb: words_of(command_of(verb)) for verb in VERBS}


def _cases(verbs: dict[str, Words]) -> list[str]:
    """Lines of a `case` on "verb" or "verb job": `words` for a Tab, and choices of options."""
    lines = []
    for verb, words in verbs.items():
        for job, of_job in words.jobs.items():
            lines += _case(f"{verb} {job}", of_job)
        lines += _case(verb, words)
    return lines


def _case(name: str, words: Words) -> list[str]:
    first = [*words.jobs, *words.choices.get("", ())]
    after = "".join(
        f' {flag}) choices="{" ".join(of)}" ;;' for flag, of in words.choices.items() if flag
    )
    return [
        f'    "{name}") options="{" ".join(words.options)}"; first="{" ".join(first)}"',
        *([f"      case $previous in{after} esac"] if after else []),
        "      ;;",
    ]


def bash() -> str:
    """The script for bash."""
    verbs = every_verb()
    twofold = "|".join(verb for verb, words in verbs.items() if words.jobs)
    return "\n".join(
        [
            "# restock's completion for bash, made by `restock completion bash`",
            "_restock() {",
            "  local current=${COMP_WORDS[COMP_CWORD]} previous=${COMP_WORDS[COMP_CWORD-1]}",
            "  local verb=${COMP_WORDS[1]} place=2 options='' first='' choices=''",
            "  COMPREPLY=()",
            "  if ((COMP_CWORD == 1)); then",
            f'    COMPREPLY=($(compgen -W "{" ".join(verbs)} --help --version" -- "$current"))',
            "    return",
            "  fi",
            f"  if [[ $verb == @({twofold}) ]] && ((COMP_CWORD > 2)); then",
            '    verb="$verb ${COMP_WORDS[2]}" place=3',
            "  fi",
            "  case $verb in",
            *_cases(verbs),
            "  esac",
            "  if [[ -n $choices ]]; then",
            '    COMPREPLY=($(compgen -W "$choices" -- "$current"))',
            "  elif [[ $current == -* ]]; then",
            '    COMPREPLY=($(compgen -W "$options" -- "$current"))',
            "  elif ((COMP_CWORD == place)) && [[ -n $first ]]; then",
            '    COMPREPLY=($(compgen -W "$first" -- "$current"))',
            "  fi",
            "}",
            "complete -o bashdefault -o default -F _restock restock",
            "",
        ]
    )


def zsh() -> str:
    """The script for zsh."""
    from restock.cli import VERBS

    verbs = every_verb()
    twofold = "|".join(verb for verb, words in verbs.items() if words.jobs)
    reported = [
        f"      '{verb}:{summary.replace(chr(39), chr(8217))}'" for verb, summary in VERBS.items()
    ]
    return "\n".join(
        [
            "#compdef restock",
            "# restock's completion for zsh, made by `restock completion zsh`",
            "_restock() {",
            "  local current=$words[CURRENT] previous=$words[CURRENT-1] verb=$words[2]",
            "  local options='' first='' choices=''",
            "  local -i place=3",
            "  if ((CURRENT == 2)); then",
            "    local -a verbs=(",
            *reported,
            "    )",
            "    _describe verb verbs",
            "    return",
            "  fi",
            f"  if [[ $verb == ({twofold}) ]] && ((CURRENT > 3)); then",
            '    verb="$verb $words[3]" place=4',
            "  fi",
            "  case $verb in",
            *_cases(verbs),
            "  esac",
            "  if [[ -n $choices ]]; then",
            "    compadd -- ${=choices} || _files",  # a name, or a file
            "  elif [[ $current == -* ]]; then",
            "    compadd -- ${=options}",
            "  elif ((CURRENT == place)) && [[ -n $first ]]; then",
            "    compadd -- ${=first}",
            "  else",
            "    _files",
            "  fi",
            "}",
            "if [[ $funcstack[1] == _restock ]]; then",  # of fpath, at the first Tab; else sourced
            '  _restock "$@"',
            "else",
            "  compdef _restock restock",
            "fi",
            "",
        ]
    )
