"""Check films: only episodes that are reproduced exactly are shown."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pyarrow.parquet as pq
import pytest
from PIL import Image
from support.kept_run import kept_run

from restock.report.run.page import films_section
from restock.train.evaluation.eval_run import drive_evaluation, plan_evaluation
from restock.train.evaluation.film import RESCUE, WORST, differing_fields, drive_again, scenes
from restock.train.run.kept_evaluations import FILE, read_evaluations

KINDS = "wheel_slip=2,blocked_aisle=1"


def row(condition: str, seed: int, policy: str, success: bool, returned: float) -> dict[str, Any]:
    return {
        **{"condition": condition, "episode_seed": seed, "policy": policy, "success": success},
        **{"return": returned, "perturbation": "none", "layouts": "default"},
    }


def test_scenes_are_worst_failures_and_best_rescues() -> None:
    rows = [
        row("wheel_slip", 1, "agent", False, -1.0),
        row("wheel_slip", 2, "agent", False, -3.0),
        row("wheel_slip", 3, "agent", True, 4.0),
        row("wheel_slip", 4, "agent", True, 5.0),  # not a rescue: the planner arrived too
        row("wheel_slip", 3, "planner", False, 0.0),
        row("wheel_slip", 4, "planner", True, 5.0),
        row("blocked_aisle", 5, "agent", True, 1.0),
        row("blocked_aisle", 6, "agent", True, 9.0),
        row("blocked_aisle", 6, "planner", False, 0.0),
        row("blocked_aisle", 5, "run:out/logs_alone", False, 0.0),  # an earlier run
        row("nominal", 1, "agent", True, 1.0),
        {**row("nominal", 9, "agent", False, -9.0), "perturbation": "friction"},
    ]
    found = {(s.row["condition"], s.kind): s.row["episode_seed"] for s in scenes(rows)}
    rescues = {("wheel_slip", RESCUE): 3, ("blocked_aisle", RESCUE): 5}
    assert found == {("wheel_slip", WORST): 2, **rescues}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an evaluated run with an untrained policy, which fails its episodes."""
    path = kept_run(tmp_path_factory.mktemp("film") / "run")
    plan = plan_evaluation(path, policies=("agent",), episodes=KINDS)
    drive_evaluation(plan)
    return path


def test_repeated_episode_matches_record(run: Path) -> None:
    plan = plan_evaluation(run, policies=("agent",), episodes=KINDS)
    for recorded in read_evaluations(run).to_pylist()[:2]:
        result, frames = drive_again(plan, recorded)
        assert differing_fields(recorded, result) == []
        assert result.undiscounted_return == pytest.approx(recorded["return"], abs=1e-4)
        assert len(frames) == round(recorded["time_s"] / 0.2) + 1


def test_films_show_only_reproduced_episodes(run, shell):
    table = read_evaluations(run)
    rows = table.to_pylist()
    for one in rows:  # as if a different episode had been recorded
        if one["condition"] == "blocked_aisle":
            one["time_s"] += 1.0
    pq.write_table(table.from_pylist(rows, schema=table.schema), run / FILE)
    argv = ["eval", str(run), "--episodes", "0", "--video", "--policies", "agent", "--json"]
    document = json.loads(shell.out(*argv))
    assert [Path(path).name for path in document["films"]] == ["wheel_slip-worst.webp"]
    assert document["not_filmed"] == ["blocked_aisle-worst: driven again it has another time_s"]
    with Image.open(document["films"][0]) as film:
        assert getattr(film, "n_frames", 1) > 3
    facts = SimpleNamespace(run=run, missing=[])
    section = films_section(cast(Any, facts))
    assert section is not None
    (figure,) = section.figures
    assert figure.title == "wheel slip: worst failure"
    assert figure.moving.startswith("data:image/webp;base64,")
    (run / "eval" / "films" / "films.json").write_text("{}")
    assert films_section(cast(Any, facts)) is None
    assert "could not be read" in facts.missing[0]
