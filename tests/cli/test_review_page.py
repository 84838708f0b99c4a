"""`restock review`: the page in a browser, its server, and the verdicts that it stores."""

import csv
import http.client
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.browser import Browser, Tab
from support.served_review import ServedReview
from support.stores import manifest, recording_transitions

from restock.cli import main
from restock.errors import LabelError
from restock.ingest.store.location import Location
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter
from restock.replay.review.events import doubtful_events
from restock.replay.review.journal import NAME, Entry, Journal
from restock.replay.store.store import Store
from restock.report.fleet.review import PORT, Review, Server
from restock.stats import wilson

HOSTILE = "<img src=x onerror=window.hacked=1>"
READY = "window.review && review.moment() && true"
CORRECTIONS = (
    "SELECT recording_id, condition, value, episode_index, first_ns, last_ns FROM corrections"
    " ORDER BY ALL"
)
LABELS = "SELECT transition_id, conditions FROM transitions ORDER BY ALL"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("chromium")) as opened:
        yield opened


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made") / "store"
    for recording in (1, 2):
        table = recording_transitions(recording, episodes=3)  # some 50 events in all
        StoreWriter(path).write(manifest(table), table)
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "store"))


@pytest.fixture
def in_process(store: Path) -> Iterator[tuple[Server, list[str]]]:
    messages: list[str] = []
    review = Review(Location.of(store))
    with Server(review, messages.append) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        yield server, messages
        server.shutdown()
        thread.join()
    review.close()


def rows(path: Path, query: str) -> list[tuple]:
    with Store(path) as store:
        return store.sql(query).fetchall()


def press(tab: Tab, *keys: str) -> None:
    """Press keys, and wait until the page has dealt with them."""
    for key in keys:
        tab.press(key)
    tab.run("review.settled()")


def opened(browser: Browser, address: str, **size: int) -> Tab:
    tab = browser.open(address, **size)
    tab.wait(READY)
    return tab


def test_verdicts_by_keys_equal_verdicts_by_csv(browser, store, made, tmp_path):
    same = Path(shutil.copytree(made, tmp_path / "same"))
    with Store(store) as read:
        known = {event.event: event for event in doubtful_events(read)}
    verdicts = []
    with ServedReview(store) as server:
        tab = opened(browser, server.address)
        for number in range(10):
            event = known[tab.run("review.here()")]
            place = (event.episode_id, event.condition, event.first_step, event.last_step)
            if number % 5 == 4:  # the event ends at the slider, a step after it begins
                press(tab, ".", "]", "y")
                ends = sorted((event.first_step, event.first_step + 1))
                whole = ends == [event.first_step, event.last_step]
                verdict = "yes" if whole else f"{ends[0]}..{ends[1]}"
            else:
                verdict = "no" if number % 2 else "yes"
                press(tab, verdict[0])
            verdicts.append((*place, verdict))
        assert "10 judged" in tab.text("#progress")
        tab.close()
        code, _ = server.end()
    assert code == 0
    with (file := tmp_path / "same.csv").open("w", newline="") as out:
        lines = csv.writer(out)
        lines.writerow(["episode_id", "condition", "first_step", "last_step", "verdict"])
        lines.writerows(verdicts)
    assert main(["review", str(same), str(file)]) == 0
    assert rows(store, CORRECTIONS) == rows(same, CORRECTIONS)
    assert rows(store, LABELS) == rows(same, LABELS)
    assert rows(store, LABELS) != rows(made, LABELS)


def test_other_condition_note_mark_and_undo(browser, in_process, store):
    server, _ = in_process
    tab = opened(browser, server.address)
    first = tab.run("review.here()")
    condition = first.rpartition("/")[2]
    press(tab, "c")
    other = tab.text("#pick-names button").split(maxsplit=1)[1].replace(" ", "_")
    press(tab, "1")
    tab.wait(f"review.here() !== {json.dumps(first)} && review.moment()")
    counting = Journal(Location.of(store)).counting()
    verdicts = {(entry.condition, entry.verdict) for entry in counting}
    assert verdicts == {(condition, "no"), (other, "yes")}
    press(tab, "u")
    assert tab.run("review.here()") == first
    assert Journal(Location.of(store)).counting() == []
    tab.run("document.getElementById('note').value = 'a child with a ball'")
    press(tab, "y")
    (entry,) = Journal(Location.of(store)).counting()
    assert (entry.note, entry.event, entry.verdict) == ("a child with a ball", first, "yes")
    press(tab, "m", "1")
    tab.wait("document.getElementById('kind').innerText === 'marked by you'")
    press(tab, "y")
    (mark,) = Journal(Location.of(store)).counting()[1:]
    assert mark.verdict == "yes"
    assert mark.last_step >= mark.first_step
    tab.close()
    server.review.write()
    found = rows(store, "SELECT condition, value FROM corrections")
    assert (mark.condition, True) in found
    assert (condition, True) in found


def test_ends_of_event_can_be_dragged(browser, in_process, store):
    tab = opened(browser, in_process[0].address)
    tab.run("document.querySelector('.handle').scrollIntoView({block: 'center'})")
    box = "document.querySelector('.handle[data-end=\"1\"]').getBoundingClientRect()"
    x, y = tab.run(f"[{box}.x + {box}.width / 2, {box}.y + {box}.height / 2]")
    before = tab.text("#yes")
    tab.drag((x, y), (x + 80, y))
    assert before.split() == ["Yes", "y"]
    assert ".." in tab.text("#yes")
    press(tab, "y")
    (entry,) = Journal(Location.of(store)).counting()
    assert int(entry.verdict.split("..")[1]) > entry.last_step
    tab.close()


def test_names_are_escaped(browser, tmp_path):
    table = replaced(recording_transitions(1, episodes=1), {"source_file": f"{HOSTILE}.mcap"})
    path = tmp_path / "store"
    StoreWriter(path).write(manifest(table, tags={"robot": HOSTILE}), table)
    with ServedReview(path) as server:
        tab = opened(browser, server.address)
        assert HOSTILE in tab.text("#facts")
        assert tab.run("window.hacked === undefined && !document.querySelector('img')")
        tab.close()


def test_killed_server_loses_no_verdict(browser, store):
    server = ServedReview(store)
    tab = opened(browser, server.address)
    press(tab, *"yynyn")
    server.kill()
    with (store / NAME).open("ab") as journal:
        journal.write(b'{"kind": "verdict", "id": "ha')  # a write that a crash cut short
    press(tab, "y")
    assert "The server does not answer: nothing was saved" in tab.text("#said")
    tab.close()
    with ServedReview(store) as again:
        tab = opened(browser, again.address)
        assert "5 judged" in tab.text("#progress")
        press(tab, "n")
        tab.close()
        _, printed = again.end()
    assert "5 verdicts of an earlier review wait in" in printed
    assert "6 verdicts are written, 0 held back" in printed
    assert len(Journal(Location.of(store)).lines) == 7
    assert Journal(Location.of(store)).counting() == []


def test_two_servers_lose_no_verdict(browser, store):
    with ServedReview(store) as one_server, ServedReview(store) as other_server:
        anna, ben = opened(browser, one_server.address), opened(browser, other_server.address)
        event = anna.run("review.here()")
        assert ben.run("review.here()") == event  # as it has no verdict yet
        press(anna, "y")
        press(ben, "n")
        both = Journal(Location.of(store)).counting()
        assert [one.verdict for one in both if one.event == event] == ["yes", "no"]
        anna.run("document.getElementById('write').click()")
        anna.wait("document.getElementById('said').innerText.includes('in the store')")
        assert {row[2] for row in rows(store, CORRECTIONS)} >= {False}
        anna.close()
        ben.close()
    condition = event.rpartition("/")[2]
    steps = event.split("/")[2].split("-")
    held = rows(
        store,
        f"SELECT DISTINCT list_contains(conditions, '{condition}') FROM transitions"
        f" WHERE episode_id = '{event.rsplit('/', 2)[0]}'"
        f" AND step_index BETWEEN {steps[0]} AND {steps[1]}",
    )
    assert held == [(False,)]  # the later verdict counts


def test_precision_is_estimated_in_random_order(browser, in_process):
    tab = opened(browser, in_process[0].address)
    assert tab.text("#estimate") == ""
    tab.run(
        "document.getElementById('order').value = 'random';"
        "document.getElementById('order').dispatchEvent(new Event('change'))"
    )
    tab.wait(READY)
    press(tab, *"yynyyyny")
    low, high = wilson(6, 8)
    estimate = f"6 of 8 labels are right: 0.75 (95 %: {low:.2f} to {high:.2f})"
    assert estimate in tab.text("#estimate")
    press(tab, "ArrowRight", "n")  # skips an event: later verdicts are reported, but not counted
    assert "6 of 8 labels" in tab.text("#estimate")
    assert "1 after a skipped one" in tab.text("#estimate")
    tab.close()


def test_page_fits_phones_and_touch(browser, in_process):
    for width, height in ((390, 844), (768, 1024), (1440, 900)):
        tab = opened(browser, in_process[0].address, width=width, height=height)
        assert tab.run("document.documentElement.scrollWidth") <= width
        sizes = tab.run(
            "[...document.querySelectorAll('nav button')].map((b) => b.getBoundingClientRect())"
            ".map((box) => [box.width, box.height, box.bottom])"
        )
        assert all(wide >= 44 and high >= 44 and low <= height for wide, high, low in sizes)
        first = tab.run("review.here()")
        tab.run("document.getElementById('no').click()")
        tab.wait(f"review.here() !== {json.dumps(first)}")
        tab.close()


def send_request(address: str, method: str, path: str, **headers: str) -> tuple[int, str]:
    """Send a request outside the page, and return its status and body."""
    parts = urlsplit(address)
    link = http.client.HTTPConnection("127.0.0.1", parts.port)
    body = b"{}" if method == "POST" else None
    link.request(method, path, body, {"Host": parts.netloc, **headers})
    answer = link.getresponse()
    text = answer.read().decode()
    link.close()
    return answer.status, text


def test_only_requests_of_page_are_answered(in_process):
    server, _ = in_process
    path, own = f"/{server.token}/", {"Origin": server.address.split("/" + server.token)[0]}
    for method, at, headers, why in (
        ("GET", "/", {}, "lacks the token"),
        ("GET", "/" + "x" * len(server.token) + "/", {}, "lacks the token"),
        ("POST", "/wrong/verdicts", own, "lacks the token"),
        ("GET", path, {"Host": "evil.example:80"}, "this machine only"),
        ("GET", path, {"Origin": "http://evil.example"}, "not from the review page"),
        ("POST", path + "state", {}, "not from the review page"),
        ("POST", path + "state", {"Origin": "null"}, "not from the review page"),
    ):
        status, text = send_request(server.address, method, at, **headers)
        assert (status, why in text) == (403, True), (method, at, headers)
    assert send_request(server.address, "GET", path)[0] == 200
    assert send_request(server.address, "POST", path + "state", **own)[0] == 200
    for at in ("../etc/passwd", "moment/-1", "moment/x", "style.css"):
        assert send_request(server.address, "GET", path + at)[0] == 404
    assert send_request(server.address, "GET", path + "moment/99999")[0] == 409
    link = http.client.HTTPConnection("127.0.0.1", server.server_port)
    link.request("GET", path)
    answer = link.getresponse()
    policy = answer.getheader("Content-Security-Policy") or ""
    assert policy.startswith("default-src 'none'")
    assert "connect-src 'self'; script-src 'sha256-" in policy
    html = answer.read().decode()
    assert "http://" not in html.replace("http://www.w3.org/2000/svg", "")
    link.close()


def test_other_port_is_taken_if_in_use(in_process, store):
    _, messages = in_process
    review = Review(Location.of(store))
    with Server(review, messages.append) as second:
        assert second.server_port != PORT
    review.close()
    assert f"port {PORT} is in use: this review has port" in messages[-1]


def entry_for(review: Review, place: int = 0, **changed: object) -> Entry:
    event = review.data["events"][place]
    values = {
        name: event[name]
        for name in ("event", "episode_id", "condition", "first_step", "last_step", "start_s")
    }
    return Entry(**({"id": f"v{place}", "by": "anna", "verdict": "no"} | values | changed))


def test_store_can_be_compacted_during_review(in_process, store):
    review = in_process[0].review
    assert main(["store", "compact", str(store)]) == 0
    review.give([entry_for(review)])
    assert review.moment(1)["steps"]
    assert review.write().version is not None
    review.give([entry_for(review, 1)])  # no conflict with the labels just written
    assert review.write().taken == 1
    assert len(rows(store, "FROM corrections")) == 2


def test_verdict_on_replaced_rows_is_refused(in_process, store):
    review = in_process[0].review
    review.give([entry_for(review)])
    recording = review.data["events"][0]["recording"]
    table = recording_transitions(int(recording, 16), ingest="b", episodes=3)
    stamps = table["stamp_ns"].to_numpy().copy()
    stamps[1:] += 7 * 10**9
    table = replaced(table, {"stamp_ns": stamps})
    StoreWriter(store).write(manifest(table), table)
    with pytest.raises(LabelError, match="the recording was ingested again in the meantime"):
        review.give([entry_for(review, id="later")])
    written = review.write()
    assert written.version is None
    (why,) = written.held_back
    assert "the recording was ingested again in the meantime" in why
    assert [one.id for one in review.journal.counting()] == ["v0"]  # it is kept


def test_invalid_verdicts_are_refused(in_process):
    review = in_process[0].review
    for changed, why in (
        ({"condition": "wheelslip"}, "no condition 'wheelslip'"),
        ({"verdict": "0..99999999"}, "do not all exist"),
        ({"episode_id": "gone/3"}, "no episode"),
    ):
        with pytest.raises(LabelError, match=why):
            review.give([entry_for(review, **changed)])
    assert review.journal.lines == []
