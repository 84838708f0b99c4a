"""The command line: `restock VERB …`. A verb's module is imported only when the verb is called.

A verb or job is a dataclass, such as `IngestCommand` for `restock ingest`: its docstring is the
help text, its fields are the options, and `run()` does the work and returns the exit code. Data go
to stdout, progress and messages to stderr. Both may be in an encoding other than UTF-8, on a full
disk, or closed by their reader.
"""

from __future__ import annotations

import codecs
import importlib
import io
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, NoReturn, TextIO, cast

from restock.errors import ConfigError, ExitCode, RestockError
from restock.process import hidden, kill_as_interrupt, was_interrupted, when_imported

# Verb -> summary for `restock --help`, in the order in which one uses them.
VERBS = {
    "demo": "all of the below, on sample_logs/",
    "start": "from your robot's recordings to a policy and a report, stage by stage",
    "info": "what is in these recordings or stores; without a path: is this machine ready?",
    "profile": "propose a profile for an unknown robot, or check one against a recording",
    "ingest": "recordings -> labelled Parquet transitions in a store",
    "sql": "query a store (or a run) in SQL",
    "review": "look at labels one by one, on a page, and say whether they are right",
    "coverage": "how much of each condition a store holds; what is missing, different or changed",
    "audit": "check that the coverage is good enough and nothing got worse: exit 1 if not",
    "mix": "a pinned replay panel with quotas per stratum",
    "export": "write transitions as a data set for Minari, d3rlpy, LeRobot or Parquet",
    "train": "offline warm-up on the panel, then online in the twin; or a study of many runs",
    "eval": "success per condition, clean and perturbed",
    "gate": "is a policy shown not to be worse than what drives today? exit 1 if not",
    "compare": "compare methods; refused if their critics were fed differently",
    "diagnose": "buffer failure or target failure?",
    "trace": "trace a sampled row to its source, down to the messages",
    "report": "one HTML page with the results of a run",
    "store": "label a store again, remove recordings, join its files, or verify them",
    "twin": "drive a simulated robot and log it, or fit the twin to a robot's logs",
}
# Verb -> its jobs (subcommands with options of their own) and their summaries.
JOBS = {
    "coverage": {
        "gaps": "what is missing, and which missions would fill it?",
        "drift": "which robot's wheels, lidar or floor have changed?",
        "diff": "what is different between two stores, versions or panels?",
    },
    "profile": {"schema": "what a TOML file may contain, as a JSON Schema for editors"},
    "store": {
        "label": "label a store again after its conditions changed, without the recordings",
        "compact": "join a store's many small files into a few large ones",
        "remove": "take recordings out; earlier versions of the store keep them for 7 days",
        "verify": "compare the checksums of all files of a store",
    },
    "twin": {
        "record": "drive a simulated robot and write what a real one would log",
        "layout": "describe a floor",
        "robot": "drive your robot's MuJoCo model, and say how well it follows commands",
        "fit": "fit the twin to logs",
        "gap": "measure how far the twin is from the logs",
    },
}
# Folder -> the verbs and jobs whose modules are in it.
FOLDERS = {
    "data": ("info", "profile", "ingest", "sql", "audit", "mix", "export"),
    "fleet": (
        *("coverage", *(f"coverage {job}" for job in JOBS["coverage"])),
        *(f"store {job}" for job in JOBS["store"]),
        "review",
    ),
    "learning": (
        *("train", "study", "eval", "gate", "compare", "diagnose", "trace", "report"),
        "profile schema",
    ),
    "twin": tuple(f"twin {job}" for job in JOBS["twin"]),
    "start": ("start", "demo"),
}
# Folders of verbs that do not multiply large matrices: BLAS gets one thread.
ONE_THREAD_OF_BLAS = ("data", "fleet")
# Jobs that are defined in the module of their verb; other jobs have their own module.
WITH_THEIR_VERB = {
    *("coverage gaps", "coverage drift"),
    *("store compact", "store remove", "store verify"),
}
PRINTS_ON_THE_WAY = ("ingest", "start", "demo")  # verbs that finish even if stdout is closed
FOLDER_OF = {name: folder for folder, names in FOLDERS.items() for name in names}


def usage() -> str:
    """Return the text of `restock --help`."""
    return f"""usage: restock VERB [--help] …

Turns robot logs into labelled transitions, shows in SQL what is missing, mixes replay batches
with quotas for rare conditions, and fine-tunes a DQN in a MuJoCo twin.

{_listed(VERBS)}

`restock VERB --help` explains a verb. `restock-node` runs an exported policy on a robot;
`restock-mcp` answers an assistant's questions.

Exit codes: 0 done, 1 an audit failed or a comparison was refused, 2 any other failure: wrong
usage, bad input, a file that cannot be read or written, 3 written but data was lost or skipped,
130 interrupted. RESTOCK_TRACEBACK=1 prints tracebacks."""


def _usage_of_jobs(verb: str) -> str:
    """Return the text of `restock VERB --help` for a verb that always needs a job."""
    return f"""usage: restock {verb} JOB [--help] …

{VERBS[verb][0].upper()}{VERBS[verb][1:]}.

{_listed(JOBS[verb])}

`restock {verb} JOB --help` explains a job."""


def _listed(names: Mapping[str, str]) -> str:
    width = max(map(len, names))
    return "\n".join(f"  {name:<{width}}  {summary}" for name, summary in names.items())


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line of `restock`; return the exit code."""
    return _guarded(_dispatch, list(sys.argv[1:] if argv is None else argv))


def run_node(argv: Sequence[str] | None = None) -> int:
    """Run one command line of `restock-node`; return the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    return _guarded(lambda given: _run("node", "restock-node", _without_ros(given)), args)


def run_mcp(argv: Sequence[str] | None = None) -> int:
    """Run one command line of `restock-mcp`; return the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    return _guarded(lambda given: _run("mcp", "restock-mcp", given), args)


def _guarded(run: Callable[[list[str]], int], args: list[str]) -> int:
    """Run a command line; print an error as one message and return its exit code."""
    substitute_what_cannot_be_shown()
    try:
        with kill_as_interrupt():
            code = run(args)
        sys.stdout.flush()  # flush inside `try`, to catch BrokenPipeError
        return code
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        # The reader of stdout has closed it (`| head`). `drop` prevents Python's message at exit.
        drop(sys.stdout)
        return int(ExitCode.OK)
    except Exception as error:  # noqa: BLE001  (the one place that maps unforeseen errors)
        if was_interrupted():  # a library may turn an interrupt into another error
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
    name, prog, rest = _named(args)
    if name in JOBS and name not in FOLDER_OF:  # a verb that needs a job
        return _say_jobs(name, rest)
    return _run(name, prog, rest)


def _named(args: list[str]) -> tuple[str, str, list[str]]:
    """Return the name of the command, its name in help texts, and its arguments."""
    verb, rest = args[0], args[1:]
    if verb not in VERBS:
        _refuse_verb(verb)
    if rest and rest[0] in JOBS.get(verb, ()):
        name = f"{verb} {rest[0]}"
        return name, f"restock {name}", rest[1:]
    if verb == "train" and rest and not rest[0].startswith("-"):
        return "study", "restock train", rest
    return verb, f"restock {verb}", rest


def _refuse_verb(verb: str) -> NoReturn:
    from difflib import get_close_matches

    from restock.renamed import VERBS as RENAMED

    if verb in RENAMED:
        raise RestockError(f"there is no verb {verb!r} any more", remedy=RENAMED[verb])
    near = get_close_matches(verb, VERBS, n=1)
    hint = f"did you mean `restock {near[0]}`?" if near else "see `restock --help`"
    raise RestockError(f"no verb named {verb!r}", remedy=hint)


def _say_jobs(verb: str, rest: list[str]) -> int:
    if rest and rest[0] not in ("-h", "--help"):
        raise RestockError(
            f"no job named {rest[0]!r}",
            where=f"restock {verb}",
            remedy=f"choose one of {', '.join(JOBS[verb])}",
        )
    sys.stdout.write(_usage_of_jobs(verb) + "\n")
    return int(ExitCode.OK if rest else ExitCode.USAGE)


def _run(name: str, prog: str, rest: list[str]) -> int:
    """Parse the arguments of a command, and run it."""
    _refuse_removed_options(name, prog, rest)
    when_imported("pyarrow", _settle_pandas)
    if FOLDER_OF.get(name) in ONE_THREAD_OF_BLAS:
        _start_no_blas_threads()

    from restock.cli.words import parse

    try:
        parsed = parse(command_of(name), prog, rest)
    except SystemExit:  # the help was printed
        return int(ExitCode.OK)
    with work_goes_on() if name in PRINTS_ON_THE_WAY else nullcontext():
        code: int | None = parsed.run()
    return int(code or ExitCode.OK)


def _refuse_removed_options(name: str, prog: str, rest: list[str]) -> None:
    options = [word.partition("=")[0] for word in rest if word.startswith("--")]
    if not options:
        return
    from restock.renamed import OPTIONS

    for option in options:
        if instead := OPTIONS.get(f"{name} {option}") or OPTIONS.get(option):
            raise RestockError(f"there is no option {option} any more", where=prog, remedy=instead)


def command_of(name: str) -> type[Any]:
    """Return the dataclass that defines a verb or a job, such as `store label`."""
    words = name.split()
    verb, last = words[0], words[-1]
    folder = f"{FOLDER_OF[name]}." if name in FOLDER_OF else ""
    file = verb if name in WITH_THEIR_VERB else last
    module = importlib.import_module(f"restock.cli.{folder}{file}")
    command: type[Any] = getattr(module, f"{last.capitalize()}Command")
    return command


def _settle_pandas() -> None:
    """Keep Arrow from importing pandas, which would take half the time of a short command.

    Arrow tries to import pandas once, when it first converts a list. That first conversion is done
    here, with pandas hidden, because no command makes pandas objects. Libraries that need pandas
    (Stable-Baselines3) can still import it.
    """
    import pyarrow as pa

    with hidden("pandas"):
        pa.array([])


def _start_no_blas_threads() -> None:
    """Let NumPy's OpenBLAS start only one thread, unless the environment sets a number.

    By default it starts one thread for each core when it is imported, and the threads busy-wait:
    that is a tenth of the CPU time of a short command on two cores. With one thread, results do not
    depend on the number of cores.
    """
    if "numpy" not in sys.modules:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _without_ros(args: list[str]) -> list[str]:
    """Return the arguments before `--ros-args`; rclpy parses the rest."""
    return args[: args.index("--ros-args")] if "--ros-args" in args else args


def _interrupted() -> int:
    _complain("interrupted; no partial files were left")
    return int(ExitCode.INTERRUPTED)


def _complain(message: str) -> None:
    red = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    name = "\x1b[1;31mrestock:\x1b[0m" if red else "restock:"
    sys.stderr.write(f"{name} {message}\n")


def substitute_what_cannot_be_shown() -> None:
    """Replace characters that the encoding of stdout or stderr lacks, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with suppress(OSError):  # tell() fails if a pipe has replaced the file
                stream.reconfigure(errors=SUBSTITUTED)


def _substituted(error: UnicodeError) -> tuple[str, int]:
    """Replace dashes, dots and arrows by ASCII, and other characters by escapes as in JSON."""
    import json

    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(_IN_ASCII.get(one) or json.dumps(one)[1:-1] for one in text), error.end


SUBSTITUTED = "restock.substituted"
_IN_ASCII = {"─": "-", "…": "...", "–": "-", "—": "-", "×": "x", "→": "->"}
codecs.register_error(SUBSTITUTED, _substituted)


@contextmanager
def work_goes_on() -> Iterator[None]:
    """Let the block finish its work even if the reader of stdout closes it (`| head`).

    Raises:
        ConfigError: after the block, if stdout could not be written for another reason.
    """
    patient = _Patient(sys.stdout)
    sys.stdout = cast(TextIO, patient)
    try:
        yield
        patient.flush()
    finally:
        sys.stdout = patient.stream
    if patient.failed is not None and not isinstance(patient.failed, BrokenPipeError):
        raise ConfigError(
            f"cannot be written: {patient.failed.strerror}; everything else is done",
            where="what it prints (stdout)",
        ) from patient.failed


class _Patient:
    """A stream that discards all output after the first error."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.failed: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        self._do(lambda: self.stream.write(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self._do(self.stream.flush)

    def _do(self, print_: Callable[[], object]) -> None:
        if self.failed is None:
            try:
                print_()
            except OSError as error:
                self.failed = error
                drop(self.stream)


def drop(stream: TextIO) -> None:
    """Redirect a stream to the null device, so that its buffer and later output are discarded."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
