"""The oldest releases that pyproject.toml allows, as constraints for pip: `make test-lowest`."""

import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement


def lowest(requirement: str) -> str:
    """`numpy>=2.1,<3` -> `numpy==2.1`."""
    parsed = Requirement(requirement)
    oldest = [one.version for one in parsed.specifier if one.operator == ">="]
    if len(oldest) != 1:
        raise ValueError(f"{requirement}: names no oldest release")
    return f"{parsed.name}=={oldest[0]}"


if __name__ == "__main__":
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *extras["pages"], *extras["train"]]
    own = (one for one in needed if not one.startswith("restock"))
    sys.stdout.writelines(f"{lowest(one)}\n" for one in own)
