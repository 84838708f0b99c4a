"""Convert exceptions that nobody foresaw to a message and exit code 2, without a traceback.

Damaged files, full disks and missing folders cause more errors than the readers can check for. This
module converts exceptions of libraries to messages that say what is wrong, where, and what to do.
`RESTOCK_TRACEBACK=1` also prints the traceback.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Sequence

from restock.cli import FOLDER_OF
from restock.errors import TRACEBACK, RestockError, StoreError, print_traceback
from restock.files import first_line, is_undecoded
from restock.process import EXTRAS, not_installed

_CHECK = "a file is damaged, or is of another kind than the command expects"
_OF_A_STORE = (
    f"{_CHECK}; `restock store compact STORE --drop-damaged --dry-run` looks for one in a store"
)
# Folders of verbs that need the extra `train`. It includes `pages`, which other verbs need.
NEEDS_TRAIN = ("learning", "twin", "start")
_GL = "MUJOCO_GL"
_NO_GL = "unset it, or set it to egl, osmesa or glfw, whose library must be installed"
# Package in which an exception is defined -> remedy for the message.
_REMEDIES = {
    "duckdb": _OF_A_STORE,
    "_duckdb": _OF_A_STORE,
    "pyarrow": _OF_A_STORE,
    "json": _CHECK,
    "msgspec": f"{_CHECK}; or a newer Restock wrote it",
    "deltalake": "the store's log or files are damaged: restore them, or ingest again",
    "safetensors_rust": "the checkpoint is damaged: restore it, or train the run again",
}


def as_restock_error(error: Exception, args: Sequence[str]) -> RestockError:
    """Convert an exception to a RestockError; print its traceback if RESTOCK_TRACEBACK is set."""
    print_traceback(error)
    where = f"restock {' '.join(args)}"

    def known(what: str, remedy: str, place: str = where) -> RestockError:
        return RestockError(what, where=place, remedy=remedy)

    if full := _out_of_memory(error):
        return known(
            f"DuckDB's memory limit is too small: {full}",
            "free some memory, or use a machine with more: DuckDB may take 80 % of it, or as much"
            " as RESTOCK_MEMORY_LIMIT in the environment says",
        )
    if isinstance(error, StoreError) and error.where is None:  # the code that raised it has no path
        return StoreError(error.what, where=where, remedy=error.remedy)
    if isinstance(error, RestockError):
        return error
    if isinstance(error, MemoryError):
        remedy = "free some memory, or use fewer workers or less data at once"
        return known("there is not enough memory", remedy)
    if isinstance(error, OSError) and error.strerror:
        files = [str(name) for name in (error.filename, error.filename2) if name is not None]
        what, remedy = error.strerror, "check the path, the permissions and the free space"
        return known(f"cannot be read or written: {what}", remedy, " -> ".join(files) or where)
    if isinstance(error, UnicodeEncodeError) and _undecoded(error):
        return known(
            "a path is not UTF-8, as it must be for a store, a panel or a run: "
            + repr(os.fsencode(error.object))[2:-1],
            "rename the folder; or set a locale of UTF-8, if the shell has none: LC_ALL=C.UTF-8",
        )
    if isinstance(error, ModuleNotFoundError):
        missing = str(error.name).partition(".")[0]
        if missing in EXTRAS:
            names = (" ".join(args[:2]), *args[:1])
            learns = any(FOLDER_OF.get(name) in NEEDS_TRAIN for name in names)
            return not_installed(missing, where, "train" if learns else EXTRAS[missing])
    if _in_gl(error):  # importing MuJoCo fails if the library of MUJOCO_GL is missing
        what = f"MuJoCo cannot use {os.environ[_GL]!r}: {first_line(error)}"
        return known(what, _NO_GL, f"{_GL} in the environment")
    kind = type(error)
    package = kind.__module__.split(".")[0]
    if package == "torch" and kind.__name__ == "OutOfMemoryError":
        return known(
            f"out of GPU memory: {first_line(error)}",
            "use --device cpu, a smaller replay.ring_capacity, or a panel of fewer rows",
        )
    if package in _REMEDIES or isinstance(error, OSError | UnicodeDecodeError):
        return known(first_line(error), _REMEDIES.get(package, _CHECK))
    return known(  # a bug in Restock or in a library
        f"an unexpected {kind.__name__}: {first_line(error)}",
        f"{_at(error)}{TRACEBACK}=1 shows the traceback; if the files are whole, this is a bug:"
        " please report it",
    )


def _out_of_memory(error: BaseException | None) -> str:
    """Return DuckDB's message if the error or one of its causes is out of memory; else ""."""
    while error is not None:
        if type(error).__name__ == "OutOfMemoryException":  # by name: no need to import duckdb
            return first_line(error)
        error = error.__cause__
    return ""


def _undecoded(error: UnicodeEncodeError) -> bool:
    """Return whether all characters that cannot be encoded are undecoded bytes of a path."""
    return all(map(is_undecoded, error.object[error.start : error.end]))


def _in_gl(error: Exception) -> bool:
    """Return whether the error comes from the library that MUJOCO_GL names."""
    names = (frame.f_globals.get("__name__") for frame, _ in traceback.walk_tb(error.__traceback__))
    return _GL in os.environ and any(
        str(name).startswith("mujoco.") and str(name).endswith("gl_context") for name in names
    )


def _at(error: Exception) -> str:
    """Return the innermost module and line of Restock in the error's traceback, for a message."""
    lines = [
        f"in {frame.f_globals.get('__name__')}:{number}; "
        for frame, number in traceback.walk_tb(error.__traceback__)
        if str(frame.f_globals.get("__name__", "")).startswith("restock.")
    ]
    return lines[-1] if lines else ""
