"""Label review: doubtful events are listed in a CSV file, and verdicts are read back."""

import csv
import io
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
from support.paths import ROOT
from support.stores import one, recording_transitions, write_store

from restock.cli import main
from restock.errors import LabelError
from restock.ingest.relabel import correct_store
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.schema import true_names
from restock.replay.review.events import DoubtfulEvent, doubtful_events, review_csv, review_rows
from restock.replay.review.verdicts import read_verdicts
from restock.replay.store.store import Store

HEADER = "episode_id,condition,first_step,last_step,verdict\n"
MONDAY = ROOT / "sample_logs" / "amr_monday.mcap"


@pytest.fixture(scope="module")
def monday(tmp_path_factory) -> Path:
    store = tmp_path_factory.mktemp("review") / "store"
    assert main(["ingest", str(MONDAY), "--store", str(store)]) == 0
    return store


@pytest.fixture(scope="module")
def reviewed(tmp_path_factory) -> tuple[Path, list[DoubtfulEvent]]:
    """Return a store of two recordings with probabilities of `recovery`, and doubtful events."""
    path = tmp_path_factory.mktemp("small") / "store"
    for recording in (1, 2):
        StoreWriter(path).write(*one(recording))
    with Store(path) as store:
        return path, doubtful_events(store, 1000)


def true_conditions(store: Store) -> dict[str, dict[int, frozenset[str]]]:
    """Return the true conditions by episode and step."""
    found: dict[str, dict[int, frozenset[str]]] = {}
    query = "SELECT episode_id, step_index, true_condition FROM transitions"
    for episode, step, text in store.sql(query).fetchall():
        found.setdefault(episode, {})[step] = true_names(text)
    return found


def true_steps(
    event: DoubtfulEvent, truth: dict[str, dict[int, frozenset[str]]], reach: int = 0
) -> list[int]:
    """Return the steps of an event, and `reach` around it, at which its condition is true."""
    steps = range(event.first_step - reach, event.last_step + reach + 1)
    return [s for s in steps if event.condition in truth[event.episode_id].get(s, ())]


def is_wrong(event: DoubtfulEvent, truth: dict[str, dict[int, frozenset[str]]]) -> bool:
    """Return whether a label lacks a true step within 0.4 s, or a true step has no label."""
    return bool(true_steps(event, truth, 2 if event.labelled else 0)) != event.labelled


def true_verdict(event: DoubtfulEvent, truth: dict[str, dict[int, frozenset[str]]]) -> str:
    inside = true_steps(event, truth)
    return f"{inside[0]}..{inside[-1]}" if inside else "no"


@pytest.mark.long
def test_doubtful_events_are_wrong_more_often(monday, tmp_path):
    with Store(monday) as store:
        truth, events = true_conditions(store), doubtful_events(store, 100_000)
    wrong = [is_wrong(event, truth) for event in events]
    assert sum(wrong[:30]) / 30 >= 1.2 * sum(wrong) / len(wrong)

    def wrong_steps() -> int:
        with Store(monday) as store:
            query = "SELECT sum(labelled - agreed + support - agreed) FROM label_scores"
            return int(store.sql(query).fetchall()[0][0])

    before, file = wrong_steps(), tmp_path / "verdicts.csv"
    with file.open("w", newline="") as out:
        lines = csv.writer(out)
        lines.writerow(["episode_id", "condition", "first_step", "last_step", "verdict"])
        for event in events[:30]:
            steps = (event.first_step, event.last_step)
            lines.writerow([event.episode_id, event.condition, *steps, true_verdict(event, truth)])
    with Store(monday) as store:
        verdicts = read_verdicts(file, store)
    correct_store(StoreWriter(monday), verdicts.given)
    assert wrong_steps() < before
    with Store(monday) as store:  # events with a verdict are not listed again
        left = {event.event for event in doubtful_events(store, 100_000)}
    assert not left & {event.event for event in events[:30]}


def test_review_file_has_commands_that_open_events(monday, tmp_path, shell):
    file = tmp_path / "my review.csv"
    out, err = shell.printed("review", monday, "--out", file)
    then = ["review", str(monday), str(file)]
    assert shlex.split(err.split("then run: restock ")[1]) == then
    with file.open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert f"{len(rows)} events" in out
    assert {row["verdict"] for row in rows} == {""}
    command = shlex.split(rows[0]["open"])
    assert command[0] == "restock"
    assert command[-2:] == ["--recording", str(MONDAY)]
    traced = shell.json(*command[1:])
    assert traced["transition"]["episode_id"] == rows[0]["episode_id"]
    assert traced["transition"]["step_index"] == int(rows[0]["first_step"])
    assert traced["messages"]
    # The file may contain verdicts, so it is not overwritten.
    assert "may contain verdicts" in shell.err("review", monday, "--out", file)


def test_review_without_events_is_reported(tmp_path, shell):
    rows = recording_transitions(1, episodes=2)
    nothing = {"condition": "nominal", "conditions": [], "probabilities": []}
    rows = replaced(rows, {name: [value] * len(rows) for name, value in nothing.items()})
    store, file = write_store(tmp_path / "store", [rows]), tmp_path / "review.csv"
    for more in ([], ["--json"]):
        shown = shell.out("review", store, "--out", file, *more)
        if more:
            assert json.loads(shown)["events"] == 0
        else:
            assert "no uncertain event is left to review" in " ".join(shown.split())
        # A file without verdicts changes nothing.
        assert "no verdict is new" in shell.out("review", store, file)
        file.unlink()
    # There is no page to serve either.
    assert "no uncertain event is left to review" in shell.out("review", store)


def fill(
    store: Path, events: list[DoubtfulEvent], file: Path, verdicts: dict[int, str], **changed: str
) -> Path:
    """Return a review file with verdicts on some lines, and other values in the first of them."""
    rows = review_rows(events, str(store))
    for place, verdict in verdicts.items():
        rows[place]["verdict"] = verdict
    rows[min(verdicts)].update(changed)
    file.write_text(review_csv(rows))
    return file


def test_verdicts_change_labels_except_in_dry_run(reviewed, tmp_path, shell):
    small, events = tmp_path / "store", reviewed[1]
    shutil.copytree(reviewed[0], small)
    assert events == sorted(events, key=lambda event: event.margin)
    for event in events:
        assert (event.probability is not None) == (event.condition == "recovery")
    no = next(i for i, e in enumerate(events) if e.labelled and e.condition == "wheel_slip")
    longer = (i for i, e in enumerate(events) if e.last_step > e.first_step)
    long = next(i for i in longer if events[i].condition == "recovery")
    first = events[long].first_step
    file = fill(small, events, tmp_path / "review.csv", {no: "No", long: f"{first}..{first}"})
    for dry in (["--dry-run"], []):
        document = shell.json("review", small, file, *dry)
        assert (document["verdicts"], document["without_verdict"]) == (2, len(events) - 2)
        assert (document["version"] is None) == bool(dry)
        with Store(small) as store:
            assert len(store.sql("FROM corrections").fetchall()) == (0 if dry else 3)
    with Store(small) as store:
        for place, begins in ((no, [False]), (long, [True, False])):
            event = events[place]
            held = store.sql(
                f"SELECT list_contains(conditions, '{event.condition}') FROM transitions"
                f" WHERE episode_id = '{event.episode_id}'"
                f" AND step_index BETWEEN {event.first_step} AND {event.last_step}"
                " ORDER BY step_index"
            ).fetchall()
            length = event.last_step - event.first_step + 1
            assert [one for (one,) in held] == (begins + [False] * length)[:length]
    assert "unchanged" in shell.out("review", small, file)  # the same again


@pytest.mark.parametrize(
    ("verdict", "changed", "problem"),
    [
        ("perhaps", {}, "line 2: the verdict 'perhaps' is not yes, no or FIRST..LAST"),
        ("5..2", {}, "5..2: end before they begin"),
        ("0..99999999", {}, "line 2: steps 0 to 99999999 do not all exist"),
        ("yes", {"condition": "wheelslip"}, "line 2: no condition 'wheelslip' labelled that"),
        ("yes", {"episode_id": "gone/3"}, "line 2: no episode 'gone/3'"),
        ("yes", {"start_s": "3600"}, "the recording was ingested again in the meantime"),
        ("yes", {"first_step": "x"}, "Expected `int`, got `str` - at `$.first_step`"),
        ("yes", {"last_step": "9" * 5000}, "at `$.last_step`"),
    ],
)
def test_invalid_review_line_is_reported(reviewed, tmp_path, verdict, changed, problem):
    small, events = reviewed
    file = fill(small, events, tmp_path / "review.csv", {0: verdict, 3: "yes"}, **changed)
    with Store(small) as store, pytest.raises(LabelError, match=re.escape(problem)) as error:
        read_verdicts(file, store)
    assert error.value.remedy is not None
    assert "--out FILE.csv` lists events" in error.value.remedy


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "it has no column episode_id"),
        ("condition,episode_id,first_step,last_step\n", "no column verdict"),
        ("a\n\xff", "cannot be read"),
        (HEADER + '"{episode},wheel_slip', "is not CSV"),
    ],
)
def test_invalid_review_file_is_refused(reviewed, tmp_path, text, problem):
    file = tmp_path / "file.csv"
    text = text.format(episode=f"{1:016x}/0")
    file.write_bytes(text.encode("latin-1"))
    with Store(reviewed[0]) as store, pytest.raises(LabelError, match=problem):
        read_verdicts(file, store)


def test_later_verdict_counts(reviewed, tmp_path):
    small, file, place = tmp_path / "store", tmp_path / "file.csv", f"{1:016x}/0"
    shutil.copytree(reviewed[0], small)
    file.write_text(f"{HEADER}{place},wheel_slip,0,3,yes\n{place},wheel_slip,3,5,no\n")
    with Store(small) as store:
        verdicts = read_verdicts(file, store)
    correct_store(StoreWriter(small), verdicts.given)
    with Store(small) as store:
        held = store.sql(
            "SELECT list_contains(conditions, 'wheel_slip') FROM transitions"
            f" WHERE episode_id = '{place}' AND step_index < 6 ORDER BY step_index"
        ).fetchall()
    assert [one for (one,) in held] == [True] * 3 + [False] * 3


def test_wrong_usage_writes_nothing(reviewed, shell):
    before = sorted(reviewed[0].rglob("*"))
    page = ["review", str(reviewed[0])]
    label = ["store", "label", str(reviewed[0])]
    for words, problem in (
        ([*page, "x.csv", "--out", "y.csv"], "FILE cannot be combined with --out"),
        ([*page, "--dry-run"], "--dry-run needs FILE"),
        ([*page, "--out", "y.html"], "'y.html' must end in .csv"),
        ([*page, "gone.csv"], "gone.csv: cannot be read: No such file"),
        ([*label, "--review", "3"], "`restock review STORE` shows the events on a page"),
        ([*label, "--corrections", "x.csv"], "give the file to `restock review STORE FILE`"),
    ):
        assert problem in " ".join(shell.err(*words).split())
    assert sorted(reviewed[0].rglob("*")) == before


def test_names_are_escaped_against_spreadsheet_formulas(reviewed):
    rows = review_rows(reviewed[1][:1], "store")
    hostile = "=cmd|' /C calc'!A0.mcap"
    line = next(csv.DictReader(io.StringIO(review_csv([rows[0] | {"source_file": hostile}]))))
    assert line["source_file"] == f"'{hostile}"
    assert float(line["margin"]) == rows[0]["margin"]  # a number, even a negative one, stays
