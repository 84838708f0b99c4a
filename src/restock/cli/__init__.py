"""The front door: `restock VERB …`. One module a verb; each is imported only when it is called.

A verb's module holds one dataclass, `IngestCommand` for `restock ingest`: its docstring is the
help, its fields are the flags, and `run()` does the work and returns an exit code. stdout is data,
stderr is progress and messages.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

from restock.cli.streams import drop, substitute_what_cannot_be_shown, work_goes_on
from restock.errors import ExitCode, RestockError
from restock.imports import hidden, when_imported
from restock.interrupts import kill_as_interrupt, was_interrupted

# verb -> what it does, in the order of the work
VERBS = {
    "record": "drive a simulated robot and write what a real one would log",
    "info": "what is in these recordings?",
    "profile": "propose a profile for an unknown robot, or check one against a recording",
    "ingest": "recordings -> labelled Parquet transitions in a store",
    "label": "label a store again after its conditions changed, without the recordings",
    "compact": "join a store's many small files into a few large ones",
    "store": "store verify: compare the checksums of all files of a store",
    "remove": "take recordings out of a store; its earlier versions keep them for 7 days",
    "sql": "query a store (or a run) in SQL",
    "coverage": "how much of each condition a store holds, and what is missing, on one page",
    "audit": "check that the coverage is good enough: exit 1 if not",
    "drift": "which robot's wheels, lidar or floor have changed?",
    "diff": "what is different between two stores, versions, panels or runs?",
    "gaps": "what is missing, and which missions would fill it?",
    "mix": "a pinned replay panel with quotas per stratum",
    "export": "write transitions as a data set for Minari, d3rlpy, LeRobot, Parquet or NumPy",
    "twin": "describe floors (layout), fit the twin to logs (fit), measure its gap to them (gap)",
    "train": "offline warm-up on the panel, then online in the twin",
    "eval": "success per condition, clean and perturbed",
    "study": "methods x mixtures x seeds, ending in one comparison",
    "compare": "compare methods; refused if their critics were fed differently",
    "trace": "trace a sampled row to its source, down to the messages",
    "diagnose": "buffer failure or target failure?",
    "report": "one HTML page with the results of a run",
    "check": "a gate for pipelines: audits, changes, regressions; exit 1 if one fails",
    "node": "run an exported policy on a robot, as a ROS 2 node, in shadow mode or driving",
    "start": "from your robot's recordings to a policy and a report, stage by stage",
    "demo": "all of the above, on sample_logs/",
    "schema": "what a TOML file may contain, as a JSON Schema for editors",
    "doctor": "what is installed here, what works, and whether a store can be read",
    "completion": "a script that completes verbs and options in bash or zsh",
}
# folder -> the verbs whose modules it holds
FOLDERS = {
    "data": (
        *("info", "profile", "ingest", "label", "sql", "audit"),
        *("drift", "diff", "gaps", "mix", "export"),
    ),
    "upkeep": ("compact", "store", "remove"),
    "learning": ("train", "eval", "study", "compare", "trace", "diagnose", "schema"),
    "pages": ("coverage", "report"),
    "twin": ("record", "twin"),
    "pipeline": ("check",),
    "robot": ("node",),
    "start": ("start", "demo"),
}
# folders of verbs that multiply no large matrices
ONE_THREAD_OF_BLAS = ("data", "upkeep", "pages", "pipeline")
PRINTS_ON_THE_WAY = ("ingest", "start", "demo")  # of work that goes on where nobody reads it
_FOLDER_OF = {verb: f"{folder}." for folder, verbs in FOLDERS.items() for verb in verbs}


def usage() -> str:
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in VERBS.items())
    return f"""usage: restock VERB [--help] …

Turns robot logs into labelled transitions, shows in SQL what is missing, mixes replay batches
with quotas for rare conditions, and fine-tunes a DQN in a MuJoCo twin.

{verbs}

`restock VERB --help` explains a verb. Exit codes: 0 done, 1 an audit failed or a comparison was
refused, 2 any other failure: wrong usage, bad input, a file that cannot be read or written,
3 written but data was lost or skipped, 130 interrupted. RESTOCK_TRACEBACK=1 prints tracebacks."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line; returns the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    substitute_what_cannot_be_shown()
    try:
        with kill_as_interrupt():
            code = _dispatch(args)
        sys.stdout.flush()  # here, where a reader that went away is no error
        return code
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        # The reader of our stdout went away (`| head`): no complaint, and none at exit either.
        drop(sys.stdout)
        return int(ExitCode.OK)
    except Exception as error:  # noqa: BLE001  (the one place that maps what nobody foresaw)
        if was_interrupted():  # a library reports it as an error of its own
            return _interrupted()
        from restock.cli.failures import as_restock_error

        known = as_restock_error(error, args)
        _complain(str(known))
        return int(known.exit_code)


def _dispatch(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage() + "\n")
        return int(ExitCode.OK if args else ExitCode.USAGE)
    if args[0] in ("-V", "--version"):
        from restock import __version__, native

        sys.stdout.write(f"restock {__version__}\nnative code {native.state()}\n")
        return int(ExitCode.OK)
    verb = args[0]
    if verb not in VERBS:
        from difflib import get_close_matches

        near = get_close_matches(verb, VERBS, n=1)
        hint = f"did you mean `restock {near[0]}`?" if near else "see `restock --help`"
        raise RestockError(f"no verb named {verb!r}", remedy=hint)

    when_imported("pyarrow", _settle_pandas)
    if any(verb in FOLDERS[folder] for folder in ONE_THREAD_OF_BLAS):
        _start_no_blas_threads()

    import tyro

    from restock.cli.command_line import jobs_of, prepared, refuse_empty_paths
    from restock.cli.help import printed

    requested = bool({"-h", "--help"} & set(args))
    command, name, rest = command_of(verb), f"restock {verb}", args[1:]
    if rest and (job := jobs_of(command).get(rest[0])):  # as a job, tyro's hints leave the verb out
        command, name, rest = job, f"{name} {rest[0]}", rest[1:]
    try:
        command = prepared(command, explained=requested)
        with printed(help_asked=requested):
            parsed = tyro.cli(
                command,
                prog=name,
                description=command.__doc__ if requested else None,
                args=_without_ros(rest) if verb == "node" else rest,
                use_underscores=False,
                config=(tyro.conf.FlagCreatePairsOff,),  # --json, without a --no-json beside it
            )
    except SystemExit as stop:  # tyro has printed its help (0) or its complaint (2)
        return int(stop.code or 0) if isinstance(stop.code, int | None) else int(ExitCode.USAGE)
    if any(not arg or (arg.startswith("--") and arg.endswith("=")) for arg in args):
        refuse_empty_paths(parsed)
    with work_goes_on() if verb in PRINTS_ON_THE_WAY else nullcontext():
        code: int | None = parsed.run()
    return int(code or ExitCode.OK)


def command_of(verb: str) -> type[Any]:
    """The dataclass that is a verb's command line."""
    module = importlib.import_module(f"restock.cli.{_FOLDER_OF.get(verb, '')}{verb}")
    command: type[Any] = getattr(module, f"{verb.capitalize()}Command")
    return command


def _settle_pandas() -> None:
    """Arrow asks at the first list that it gets whether it is a pandas object, and to know that
    imports pandas wherever it is installed: half of what a short command takes. No command makes
    any, so it asks now, and finds none. Who needs pandas itself (Stable-Baselines3) imports it."""
    import pyarrow as pa

    with hidden("pandas"):
        pa.array([])


def _start_no_blas_threads() -> None:
    """NumPy's OpenBLAS starts a thread a core while it is imported, and they wait for work in a
    loop: a tenth of the CPU time of a short command on two cores, more on more. What it computes
    then depends on the number of cores no more. A number that the environment gives stands."""
    if "numpy" not in sys.modules:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _without_ros(args: list[str]) -> list[str]:
    """The flags before `--ros-args`; rclpy reads the rest from the command line itself."""
    return args[: args.index("--ros-args")] if "--ros-args" in args else args


def _interrupted() -> int:
    _complain("interrupted; nothing is left half-written")
    return int(ExitCode.INTERRUPTED)


def _complain(message: str) -> None:
    red = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    name = "\x1b[1;31mrestock:\x1b[0m" if red else "restock:"
    sys.stderr.write(f"{name} {message}\n")
