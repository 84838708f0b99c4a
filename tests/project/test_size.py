"""The house does not grow: the counts of CONTRIBUTING.md's table are not exceeded."""

import ast
import contextlib
import importlib
import io
import re
from collections.abc import Iterable
from pathlib import Path

from support.paths import ROOT

from restock.cli import JOBS, VERBS, main
from restock.public import FACES

PRODUCT = [
    path
    for room in ("ingest", "replay", "train", "src")
    for path in sorted((ROOT / room).rglob("*"))
    if path.suffix in {".py", ".sql", ".c", ".h", ".pyi"} and "egg-info" not in str(path)
]
TABLE = re.findall(r"^\| ([\w ]+) \| ([\d,]+) \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.M)
LIMITS = {name: int(limit.replace(",", "")) for name, limit in TABLE}


def count_lines(paths: Iterable[Path]) -> int:
    return sum(path.read_text(encoding="utf-8").count("\n") for path in paths)


def count_options() -> int:
    """Count the options in the help of all verbs and their jobs, without `--help` itself."""
    jobs = [(verb, job) for verb, names in JOBS.items() for job in names]
    text = "\n".join(help_of(*words) for words in [*((verb,) for verb in VERBS), *jobs])
    options = re.findall(r"^  (?:-\w, )?(--[\w-]+)", text, re.M)
    return len(options) - options.count("--help")


def help_of(*words: str) -> str:
    with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), "utf-8")) as text:
        main([*words, "--help"])
    text.seek(0)
    return text.read()


def count_keys() -> int:
    """Count the keys of all structs that are read from TOML: fields of `Checked` and its heirs.

    Those that leave unknown keys alone are other programs' files, such as ROS's map.yaml.
    """
    bases, keys = {}, {}
    for path in PRODUCT:
        if path.suffix != ".py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                bases[node.name] = [ast.unparse(base) for base in node.bases]
                fields = [item for item in node.body if isinstance(item, ast.AnnAssign)]
                if "forbid_unknown_fields=False" in map(ast.unparse, node.keywords):
                    fields = []
                keys[node.name] = sum("ClassVar" not in ast.unparse(f.annotation) for f in fields)

    def is_read(name: str) -> bool:
        return name == "Checked" or any(map(is_read, bases.get(name, ())))

    return sum(count for name, count in keys.items() if is_read(name))


def count_all() -> dict[str, int]:
    pages = [path for kind in ("*.md", "*.ipynb") for path in (ROOT / "docs").glob(kind)]
    names = [importlib.import_module(face).__all__ for face in FACES if face != "restock"]
    return {
        "product lines": count_lines(PRODUCT),
        "product modules": sum(path.suffix == ".py" for path in PRODUCT),
        "test lines": count_lines((ROOT / "tests").rglob("*.py")),
        "documentation pages": len(pages),
        "verbs": len(VERBS),
        "options": count_options(),
        "config keys": count_keys(),
        "public names": sum(map(len, names)),
        "README lines": count_lines([ROOT / "README.md"]),
        "changelog lines": count_lines([ROOT / "CHANGELOG.md"]),
    }


def test_counts_are_within_limits() -> None:
    counts = count_all()
    assert counts.keys() == LIMITS.keys()
    assert not {name: count for name, count in counts.items() if count > LIMITS[name]}
