"""Start and end of episodes, and the accounting of every tick."""

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.driven_robot import START_NS, Drive, columns, without

from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.episodes import EpisodeSpan, Split, split, steps_of

PROFILE = load_profile("warehouse_amr")
TASK = PROFILE.task


def episodes_of(topics: dict[str, TopicColumns], **task: object) -> Split:
    profile = msgspec.structs.replace(PROFILE, task=msgspec.structs.replace(TASK, **task))
    steps = steps_of(profile, topics)
    found = split(profile.task, steps)
    assert len(steps) == found.transitions + found.ends + sum(found.dropped.values())
    return found


END = "end of the recording"
FAR, NEAR = (0.0, 11.0, 1.0), (0.0, 3.0, 1.0)
# goals as (time, x, y), task changes, expected episodes, ticks outside episodes
ENDINGS = {
    "end of recording": ([FAR], {}, [(0, 29, False, END, False)], {}),
    # x = 1 + 0.5 t comes within 0.4 m of 3 at t = 3.2 s, tick 16.
    "goal": ([NEAR], {}, [(0, 16, True, "goal", False)], {"goal already reached": 13}),
    # The mission layer sends the next goal at once, so the tick is judged by the previous goal.
    "goal and next goal at once": (
        [NEAR, (3.2, 11.0, 1.0)],
        {},
        [(0, 16, True, "goal", True), (16, 29, False, END, False)],
        {},
    ),
    # The robot has passed the goal by 0.5 m at that time.
    "repeated goal": (
        [NEAR, (5.0, 3.0, 1.0)],
        {},
        [(0, 16, True, "goal", False), (25, 29, False, END, False)],
        {"goal already reached": 8},
    ),
    "new goal": (
        [FAR, (2.0, 10.0, 1.0)],
        {},
        [(0, 10, False, "new goal", True), (10, 29, False, END, False)],
        {},
    ),
    "time limit": (
        [FAR],
        {"time_limit_steps": 12},
        [
            (0, 12, False, "time limit", True),
            (12, 24, False, "time limit", True),
            (24, 29, False, END, False),
        ],
        {},
    ),
}


@pytest.mark.parametrize("name", ENDINGS)
def test_episode_ending(name: str) -> None:
    goals, task, spans, dropped = ENDINGS[name]
    found = episodes_of(Drive(goals=goals).topics(), **task)
    assert found == Split([EpisodeSpan(*span) for span in spans], dropped)


def test_lost_plan_ends_episode_and_drops_ticks():
    topics = Drive(goals=[(0.0, 11.0, 1.0), (2.0, 11.0, 9.0)]).topics()
    topics["/plan"] = without(topics["/plan"], np.array([True, False]))
    found = episodes_of(topics)
    assert found.episodes == [EpisodeSpan(0, 10, False, "no route", True)]
    assert found.dropped == {"plan: for another goal": 20}


@pytest.mark.parametrize(
    ("goals", "pressed", "spans", "dropped"),
    [
        (
            [FAR],
            lambda time: np.isclose(time, 2.06),
            [(0, 11, True, "bump", False), (16, 29, False, END, False)],
            4,
        ),
        (  # The robot scrapes along an obstacle and touches it every half second.
            [FAR],
            lambda time: (time > 2.0) & (time < 4.0) & (time % 0.5 < 0.1),
            [(0, 11, True, "bump", False), (23, 29, False, END, False)],
            11,
        ),
        (  # A bump on the tick of a new goal begins no episode.
            [FAR, (2.0, 10.0, 1.0)],
            lambda time: time == 2.0,
            [(0, 10, True, "bump", True), (15, 29, False, END, False)],
            5,
        ),
    ],
)
def test_bump_terminates_episode_if_configured(goals, pressed, spans, dropped):
    topics, time = Drive(goals=goals).topics(), np.arange(0, 6, 0.02)
    topics["/bumper"] = columns(time, {"data": pressed(time)}, stamped=False)
    assert len(episodes_of(topics, bump_terminates=False).episodes) == len(goals)
    found = episodes_of(topics, bump_terminates=True)
    assert found.episodes == [EpisodeSpan(*span) for span in spans]
    assert found.dropped == {"bumper: pressed within the last 1 s": dropped}


def test_command_gap_truncates_at_previous_tick():
    topics = Drive().topics()
    time = (topics["/cmd_vel"].log_time_ns - START_NS) * 1e-9
    topics["/cmd_vel"] = without(topics["/cmd_vel"], (time < 2) | (time > 3))
    found = episodes_of(topics)
    assert [(e.first, e.last, e.ended_by) for e in found.episodes] == [
        (0, 9, "gap"),
        (10, 24, "end of the recording"),
    ]


def test_stale_ticks_split_episodes_and_are_counted():
    topics = Drive().topics()
    time = (topics["/scan"].log_time_ns - START_NS) * 1e-9
    topics["/scan"] = without(topics["/scan"], (time < 2) | (time > 3.5))
    found = episodes_of(topics)
    assert found.dropped == {"scan: stale": 6}
    assert [e.ended_by for e in found.episodes] == ["scan: stale", "end of the recording"]


def test_clock_jump_truncates_episode():
    topics = Drive().topics()
    for topic in topics.values():
        later = (topic.log_time_ns - START_NS) * 1e-9 > 3
        if "header.stamp" in topic.fields:
            topic.fields["header.stamp"][later] -= 3 * 10**9
    found = episodes_of(topics)
    assert [e.ended_by for e in found.episodes] == ["clock jump", "end of the recording"]
    assert not any(e.terminated for e in found.episodes)


@pytest.mark.parametrize("alone", [True, False])
def test_single_tick_between_gaps_is_dropped(alone):
    topics = Drive().topics()
    ticks = 0.005 + np.array([0.0, 0.2, 2.0, 2.2 if not alone else 4.0])
    topics["/cmd_vel"] = columns(
        ticks, {"linear.x": np.zeros(4), "angular.z": np.zeros(4)}, stamped=False
    )
    found = episodes_of(topics)
    assert found.dropped == ({"a single step between two cuts": 2} if alone else {})


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(
    goals=st.lists(st.tuples(st.floats(0, 6), st.floats(1.5, 5), st.just(1.0)), max_size=4).map(
        sorted
    ),
    lost=st.dictionaries(
        st.sampled_from(["/cmd_vel", "/scan", "/odom", "/amcl_pose", "/plan", "/bumper"]),
        st.tuples(st.floats(0, 6), st.floats(0, 2)),
        max_size=3,
    ),
    limit=st.integers(2, 40),
    bad=st.lists(st.integers(0, 299), max_size=3),
)
def test_every_tick_is_accounted_for(goals, lost, limit, bad):
    topics = Drive(goals=[(0.0, 4.0, 1.0), *goals]).topics()
    for name, (start, length) in lost.items():
        time = (topics[name].log_time_ns - START_NS) * 1e-9
        topics[name] = without(topics[name], (time < start) | (time > start + length))
    if len(topics["/odom"]) > max(bad, default=0):
        topics["/odom"].fields["twist.twist.linear.x"][bad] = np.nan
    found = episodes_of(topics, time_limit_steps=limit)  # episodes_of() checks the sum
    for before, after in zip(found.episodes, found.episodes[1:], strict=False):
        assert after.first >= before.last if before.shared else after.first > before.last
    assert all(0 < e.last - e.first <= limit for e in found.episodes)
