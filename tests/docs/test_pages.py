"""Run every block of the documentation as printed, in a reader's folder."""

import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from importlib.resources import files
from itertools import chain, groupby
from pathlib import Path

import pytest
from support.pages import PAGES, RUN, Block, blocks, indented
from support.paths import ROOT
from support.reader import Reader, reader

from restock.ingest.profile.profile import load_profile
from restock.replay.mixture.mixture import parse_mixture
from restock.train.study.study import load_study
from restock.train.twin.floors.floor_files import read_floor

# py: signatures in docs/reference.md
LANGUAGES = (*RUN, "toml", "yaml", "json", "csv", "text", "xml", "py")
ALL = {page: blocks(page) for page in PAGES}
NOTEBOOKS = [ROOT / "docs/tutorial.md"]  # test_tutorial.py runs it
PARTS = {  # (page, number of its folder) -> the blocks that run there, one after the other
    (page, number): list(part)
    for page in PAGES
    for number, part in groupby(ALL[page], lambda block: block.folder)
}
PARTS_RUN = [p for p in PARTS if p[0] not in NOTEBOOKS and any(b.is_run for b in PARTS[p])]
PARTS_SLOW = [part for part in PARTS if any("slow" in block.marks for block in PARTS[part])]
TOML = [b for b in chain(*ALL.values()) if b.language == "toml" and "file" not in b.marks]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    with reader(tmp_path_factory.mktemp("reader")) as it:
        yield it


@pytest.fixture(scope="session")
def prepared(server: Reader, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a reader's folder: recordings, their store and panel, and two runs."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "sample_logs").symlink_to(ROOT / "sample_logs")
    (folder / "docs").symlink_to(ROOT / "docs")
    shutil.copytree(ROOT / "sample_logs/amr_tuesday", folder / "drives")
    (folder / "logs").mkdir()
    (folder / "logs/run.mcap").symlink_to(ROOT / "sample_logs/amr_monday.mcap")
    (folder / "run.mcap").symlink_to(ROOT / "sample_logs/amr_monday.mcap")
    commands = """
        restock ingest logs/ --store store/
        restock mix store/ --out panel/
        restock train --panel panel/ --out runs/a
        restock train --panel panel/ --out runs/b --seed 1
    """
    made = Block("prepared", 1, "sh", commands, {"exit codes": "3"})
    assert not server.run([made], folder)
    return folder


def part_name(part: tuple[Path, int]) -> str:
    return f"{name(part[0])}-{part[1]}"


def run_part(
    part: tuple[Path, int], server: Reader, prepared: Path, folder: Path, *, slow: bool
) -> None:
    shutil.copytree(prepared, folder, symlinks=True)
    for block in PARTS[part]:
        if target := block.marks.get("file"):
            (folder / target).parent.mkdir(parents=True, exist_ok=True)
            (folder / target).write_text(block.text, encoding="utf-8")
    wanted = [b for b in PARTS[part] if b.is_run and (slow or "slow" not in b.marks)]
    wrong = server.run(wanted, folder)
    assert not wrong, wrong


@pytest.mark.docs
@pytest.mark.parametrize("part", PARTS_RUN, ids=part_name)
def test_page_runs_as_printed(part, server, prepared, tmp_path):
    run_part(part, server, prepared, tmp_path / "reader", slow=False)


@pytest.mark.docs
@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS_SLOW, ids=part_name)
def test_page_runs_with_slow_blocks(part, server, prepared, tmp_path):
    run_part(part, server, prepared, tmp_path / "reader", slow=True)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_blocks_are_fenced_and_name_a_language(page: Path) -> None:
    assert indented(page) == []
    assert [b.place for b in ALL[page] if b.language not in LANGUAGES] == []


def test_unrun_blocks_are_few_and_give_reasons() -> None:
    """Limit the blocks that are not run, so that a new one is seen in review."""
    reported = [block for block in chain(*ALL.values()) if block.language in RUN]
    left_out = {b.place: b.marks["not run"] for b in reported if "not run" in b.marks}
    assert all(len(reason.split()) >= 2 for reason in left_out.values()), left_out
    assert len(left_out) <= 30
    assert len(reported) > 5 * len(left_out)


def check_mixture(block: Block, folder: Path) -> None:
    """Check a part of a mixture, with the shortest list of strata if it has none."""
    listed = {"strata", "each_condition"} & set(tomllib.loads(block.text))
    parse_mixture(block.text + ("" if listed else "\n[each_condition]\n"), where=block.place)


def check_study(block: Block, folder: Path) -> None:
    """Check a part of a study, with missing keys from the page's whole study."""
    whole = next(b for b in blocks(ROOT / block.page) if b.marks.get("file") == "study.toml")
    own = tomllib.loads(block.text)
    left_out = {
        key: value
        for key, value in tomllib.loads(whole.text).items()
        if key not in own and isinstance(value, str | list) and key not in ("baseline", "arms")
    }
    file = folder / "study.toml"
    file.write_text("".join(f"{key} = {value!r}\n" for key, value in left_out.items()) + block.text)
    load_study(file)


def check_floor(block: Block, folder: Path) -> None:
    (folder / "floor.toml").write_text(block.text, encoding="utf-8")
    read_floor(folder / "floor.toml")


WHEELS = "".join(
    f"""
[signals.{side}_wheel_radps]
topic = "/joint_states"
type = "sensor_msgs/msg/JointState"
path = "velocity[wheel_{side}_joint]"
unit = "rad/s"
max_age_s = 0.2
"""
    for side in ("left", "right")
)  # custom signals that docs/profile.md adds before its condition


def check_profile(block: Block, folder: Path) -> None:
    """Check a part of a profile in place of the shipped inputs of the same names."""
    shipped = (files("restock.ingest.profile") / "profiles/warehouse_amr.toml").read_text("utf-8")
    tables = re.split(r"^(?=\[)", shipped, flags=re.MULTILINE)
    own = [rf"\[inputs\.{name}[].]" for name in tomllib.loads(block.text).get("inputs", {})]
    kept = [table for table in tables if not any(re.match(one, table) for one in own)]
    whole = "\n".join(["".join(kept), WHEELS, block.text])
    (folder / "profile.toml").write_text(whole, encoding="utf-8")
    load_profile(folder / "profile.toml")


# Page -> check of its TOML blocks that are not files of its commands.
CHECKS: dict[str, Callable[[Block, Path], None]] = {
    "docs/mixture.md": check_mixture,
    "docs/compare.md": check_study,
    "docs/layouts.md": check_floor,
    "docs/profile.md": check_profile,
    "docs/robot.md": check_profile,
    "docs/ingest.md": check_profile,
}


@pytest.mark.parametrize("block", TOML, ids=lambda block: block.place)
def test_toml_block_is_accepted(block: Block, tmp_path: Path) -> None:
    CHECKS[block.page](block, tmp_path)
