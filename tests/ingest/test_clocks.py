"""Clocks compared: offset, jumps, backsteps, repeated and zero stamps, by hand and as shown."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.driven_robot import Drive, write_bag

from restock.cli import main
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.steps.align import NS
from restock.ingest.steps.clocks import STAMP, topic_clock


def topic(stamps: list[int], logs: list[int] | None = None) -> TopicColumns:
    stamp = np.array(stamps, np.int64)
    log = stamp + 5 if logs is None else np.array(logs, np.int64)
    return TopicColumns(log, log - 2, {STAMP: stamp})


def test_a_clock_that_is_set_jumps_and_one_bad_stamp_is_no_jump():
    logs = [NS * n for n in range(1, 41)]
    stamps = [log - (0 if log <= 20 * NS else 30 * NS) for log in logs]
    assert topic_clock("/t", topic(stamps, logs)).jumps == 1
    once = [*logs[:10], logs[10] - 30 * NS, *logs[11:]]
    assert topic_clock("/t", topic(once, logs)).jumps == 0


@given(st.lists(st.integers(0, 20), min_size=1, max_size=30), st.integers(-(10**18), 10**18))
def test_counts_are_those_of_python(stamps, offset):
    logs = [stamp + offset for stamp in stamps]
    found = topic_clock("/t", topic(stamps, logs))
    assert found.backsteps == sum(b < a for a, b in itertools.pairwise(stamps))
    reported = [stamp for stamp in stamps if stamp]
    assert found.duplicates == len(reported) - len(set(reported))
    assert found.zero_stamps == len(stamps) - len(reported)


class Odd(Drive):
    """Odometry that repeats a stamp, steps back once and says zero once."""

    def topics(self) -> dict[str, TopicColumns]:
        found = super().topics()
        stamp = found["/odom"].fields[STAMP]
        stamp[10] = stamp[9]
        stamp[20] = stamp[19] - 1
        stamp[30] = 0
        return found


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(Odd(), tmp_path_factory.mktemp("clocks") / "bag")


def test_the_manifest_keeps_them_and_ingest_shows_them(bag, tmp_path, capsys):
    store = tmp_path / "store"
    assert main(["ingest", str(bag), "--store", str(store)]) == 3  # the zero stamp is lost
    shown = capsys.readouterr().out
    line = " ".join(shown[shown.index(" /odom ") :].split())  # long cells are wrapped
    # 19 -> 20 and 29 -> 30 go back; and the zero stamp is off the clock, so it is left out.
    assert "2 backsteps, 1 repeated stamp, 1 zero stamp, 1 left out" in line
    assert "0.002" in line[: line.index("backsteps")]
    question = "SELECT unnest(clocks, recursive := true) FROM recordings"
    assert main(["sql", str(store), question, "--json"]) == 0
    rows = {row["topic"]: row for row in json.loads(capsys.readouterr().out)}
    odom = rows["/odom"]
    assert (odom["messages"], odom["offset_ns"], odom["stamped"]) == (300, 2_000_000, True)
    assert (odom["backsteps"], odom["duplicates"], odom["zero_stamps"]) == (2, 1, 1)
    assert (odom["off_clock"], odom["restamped"], odom["log_backsteps"]) == (1, 0, 0)
    assert rows["/cmd_vel"]["stamped"] is False
    assert rows["/cmd_vel"]["offset_ns"] is None


def test_messages_logged_out_of_order_are_counted(tmp_path, capsys):
    from support.bag_samples import write_mcap

    # Its messages step back in log time once; see bag_samples.
    assert main(["info", str(write_mcap(tmp_path / "a.mcap")), "--clocks", "--json"]) == 0
    topics = json.loads(capsys.readouterr().out)["recordings"][0]["topics"]
    assert topics["/odom"]["clock"]["log_backsteps"] == 1
