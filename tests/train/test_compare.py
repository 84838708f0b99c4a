"""Check `restock compare`: comparable and incomparable runs, differences and intervals."""

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.finished_runs import UPDATES, document, make_run

from restock.cli import main
from restock.train.run.run import Run

pytestmark = pytest.mark.usefixtures("few_resamples")
EXTRA = ("update_path", "next_value")


def arm(tmp_path: Path, name: str, seeds: range, **given: Any) -> list[str]:
    settings = {key: given.pop(key) for key in list(given) if "__" in key or key in EXTRA}
    return [
        str(make_run(tmp_path / f"{name}{seed}", document(seed, **settings), **given))
        for seed in seeds
    ]


def compared(
    capsys: pytest.CaptureFixture[str], first: list[str], second: list[str], *flags: str
) -> tuple[int, dict[str, Any]]:
    code = main(["compare", *first, "--against", *second, "--json", *flags])
    return code, json.loads(capsys.readouterr().out)


def test_algorithms_with_equal_feeds_are_compared(tmp_path, capsys) -> None:
    first = arm(tmp_path, "a", range(3), success=0.2, update_path="manual")
    other = {
        "config__network__layer_norm": False,
        "update_path": "autograd",
        "next_value": "lower of both networks",
    }  # next_value follows from update_path
    second = arm(tmp_path, "b", range(3, 6), success=0.7, **other)
    code, found = compared(capsys, first, second)
    assert (code, found["verdict"], found["outcomes_from"]) == (0, "comparable", "training")
    differ = {d["setting"] for d in found["differences"]}
    assert differ == {"config.network.layer_norm", "next_value"}
    slip = next(row for row in found["outcomes"] if row["condition"] == "wheel_slip")
    assert (slip["episodes"], slip["runs"]) == (40, [3, 3])
    assert slip["difference"] == pytest.approx(0.5, abs=0.12)
    assert slip["difference_low"] > 0.3
    assert slip["improvement"] > 0.7


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"panel__store_version": 4}, "panel.store_version"),
        ({"panel__store": "another"}, "panel.store"),
        ({"config__evaluation__seed": 91_000}, "config.evaluation.seed"),
        ({"config__target__tau": 0.1}, "config.target.tau"),
        ({"config__replay__ring_capacity": 5_000}, "config.replay.ring_capacity"),
        ({"task_hash": "u"}, "task_hash"),
    ],
)
def test_differences_outside_the_treatment_are_refused(tmp_path, capsys, changes, setting):
    first = arm(tmp_path, "a", range(1))
    second = [str(make_run(tmp_path / "b", document(1, **changes)))]
    code, found = compared(capsys, first, second)
    assert (code, found["verdict"], found["refused"]) == (1, "incomparable", [setting])
    assert found["outcomes"] == []


def test_different_feed_needs_mixture_treatment(tmp_path, capsys) -> None:
    first = arm(tmp_path, "a", range(3))
    second = arm(tmp_path, "b", range(3, 6), slip_share=0.15)
    code, found = compared(capsys, first, second)
    assert (code, found["verdict"], found["refused"]) == (1, "incomparable", [])
    failed = {
        c["check"] if "check" in c else c["name"]
        for c in found["checks"]
        if c["verdict"] == "incomparable"
    }
    assert "share of logs/wheel_slip" in failed
    code, found = compared(capsys, first, second, "--treatment", "mixture")
    assert (code, found["verdict"]) == (0, "comparable")


def test_data_treatment_allows_replay_and_practice(tmp_path, capsys) -> None:
    first = arm(tmp_path, "a", range(1))
    second = arm(tmp_path, "b", range(1), slip_share=0.15, config__practice__rule="even")
    for treatment in ("mixture", "practice"):
        code, _ = compared(capsys, first, second, "--treatment", treatment)
        assert code == 1
    code, found = compared(capsys, first, second, "--treatment", "data")
    assert (code, found["verdict"]) == (0, "comparable")
    third = arm(tmp_path, "c", range(1), config__loss__margin=0.5)
    assert compared(capsys, first, third, "--treatment", "data")[0] == 1


def test_run_with_half_the_updates_is_incomparable(tmp_path, capsys) -> None:
    first = arm(tmp_path, "a", range(1))
    second = [str(make_run(tmp_path / "b", document(1), updates=UPDATES // 2))]
    code, found = compared(capsys, first, second, "--treatment", "mixture")
    assert (code, found["verdict"]) == (1, "incomparable")
    (check,) = [c for c in found["checks"] if c["name"] == "updates"]
    assert (check["value"], check["verdict"]) == (2.0, "incomparable")


def test_task_without_goal_has_no_success(tmp_path, capsys) -> None:
    first, second = (
        arm(tmp_path, n, range(k, k + 3), success=None) for n, k in (("a", 0), ("b", 3))
    )
    code, found = compared(capsys, first, second)
    assert (code, found["verdict"]) == (0, "comparable")
    assert found["outcomes"]
    for row in found["outcomes"]:
        assert (row["success"], row["difference"]) == ([None, None], None)
        assert row["no_interval"] == "the task has no goal: compare the returns"
    assert main(["compare", *first, "--against", *second]) == 0
    assert "no goal" in capsys.readouterr().out


def test_few_episodes_are_inconclusive(tmp_path, capsys) -> None:
    few = {"fresh_episodes": 400}
    first, second = arm(tmp_path, "a", range(2, 3), **few), arm(tmp_path, "b", range(3, 4), **few)
    assert main(["compare", *first, *second]) == 1
    assert "REFUSED, inconclusive" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("seeds", "episodes", "why"),
    [
        (1, 40, "1 run an arm, at least 3 are needed"),
        (2, 40, "2 runs an arm, at least 3 are needed"),
        (3, 1, "1 episode, at least 10 are needed"),
        (3, 40, "every run ended every episode in the same way: nothing varies"),
    ],
)
def test_few_runs_or_episodes_give_no_interval(tmp_path, capsys, seeds, episodes, why) -> None:
    given = {"episodes": episodes, "fresh_episodes": 400}  # feeds may differ under this treatment
    first = arm(tmp_path, "a", range(seeds), success=2.0, **given)
    second = arm(tmp_path, "b", range(3, 3 + seeds), success=-1.0, **given)
    code, found = compared(capsys, first, second, "--treatment", "mixture")
    assert code == 0
    for row in found["outcomes"]:
        assert row["difference"] == -1.0
        assert (row["difference_low"], row["difference_high"]) == (None, None)
        assert row["no_interval"] == why


def test_invalid_arm_is_rejected(tmp_path, capsys) -> None:
    first = arm(tmp_path, "a", range(3))
    other = str(make_run(tmp_path / "o", document(9, config__target__tau=0.1)))
    young = str(Run.create(tmp_path / "young", document(1)).path)
    older = shutil.copytree(first[1], tmp_path / "older")
    fed = pq.read_table(older / "sampled_episodes.parquet").drop_columns("condition")
    pq.write_table(fed, older / "sampled_episodes.parquet")
    older = str(older)
    for words, message in (
        ([*first], "needs two runs, got 3"),
        (["--against", *first], "needs the runs of the first method, too"),
        ([first[0], other, "--against", first[1]], "differs from"),
        ([first[0], first[0], "--against", first[1]], "is given twice"),
        ([first[0], young], "has no record of the episodes it sampled by condition"),
        ([first[0], older], "has no record of the episodes it sampled by condition"),
        ([first[0], str(tmp_path)], "is not a run directory"),
    ):
        assert main(["compare", *words]) == 2
        assert message in " ".join(capsys.readouterr().err.split())


def test_dependent_seeds_are_rejected(tmp_path, capsys) -> None:
    first = arm(tmp_path, "a", range(2))
    second = arm(tmp_path, "b", range(2, 4), config__network__layer_norm=False)
    copied = str(shutil.copytree(first[0], tmp_path / "copied"))
    again = str(make_run(tmp_path / "again", document(1, created_ns=1)))
    for words, message in (
        ([*first, copied, "--against", *second], f"copied: is a copy of {first[0]}"),
        ([*first, again, "--against", *second], f"again: has the seed of {first[1]}, 1"),
        ([*first, "--against", first[1], again], f"again: has the seed of {first[1]}, 1"),
        ([*first, "--against", copied], f"copied: is in both arms as a copy of {first[0]}"),
        ([*first, "--against", first[1]], f"{first[1]}: is in both arms"),
        ([first[0], first[0]], f"{first[0]}: is in both arms"),
    ):
        assert main(["compare", *words]) == 2
        assert "".join(message.split()) in "".join(capsys.readouterr().err.split())
