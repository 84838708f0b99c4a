"""Where an episode begins and ends, and that every tick is accounted for."""

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


def test_the_end_of_a_recording_truncates():
    assert episodes_of(Drive().topics()) == Split(
        [EpisodeSpan(0, 29, False, "end of the recording", False)], {}
    )


def test_reaching_the_goal_terminates():
    found = episodes_of(Drive(goals=[(0.0, 3.0, 1.0)]).topics())
    # x = 1 + .5 t comes within .4 m of 3 at t = 3.2 s, tick 16.
    assert found.episodes == [EpisodeSpan(0, 16, True, "goal", False)]
    assert found.dropped == {"goal already reached": 13}


def test_goal_reached_on_the_next_goals_tick_terminates():
    """The mission layer sends the next goal at once: judge the tick by the goal before it."""
    found = episodes_of(Drive(goals=[(0.0, 3.0, 1.0), (3.2, 11.0, 1.0)]).topics())
    assert found.episodes == [
        EpisodeSpan(0, 16, True, "goal", True),
        EpisodeSpan(16, 29, False, "end of the recording", False),
    ]


def test_the_same_goal_again_is_a_new_episode():
    again = Drive(goals=[(0.0, 3.0, 1.0), (5.0, 3.0, 1.0)])  # it has driven 0.5 m past by then
    found = episodes_of(again.topics())
    assert [(e.first, e.last) for e in found.episodes] == [(0, 16), (25, 29)]
    assert found.dropped == {"goal already reached": 8}


def test_a_new_goal_truncates_and_shares_the_tick():
    found = episodes_of(Drive(goals=[(0.0, 11.0, 1.0), (2.0, 10.0, 1.0)]).topics())
    assert found.episodes == [
        EpisodeSpan(0, 10, False, "new goal", True),
        EpisodeSpan(10, 29, False, "end of the recording", False),
    ]
    assert found.transitions == 29


def test_a_lost_plan_ends_the_episode_and_the_tick_is_counted():
    topics = Drive(goals=[(0.0, 11.0, 1.0), (2.0, 11.0, 9.0)]).topics()
    topics["/plan"] = without(topics["/plan"], np.array([True, False]))
    found = episodes_of(topics)
    assert found.episodes == [EpisodeSpan(0, 10, False, "no route", True)]
    assert found.dropped == {"plan: for another goal": 20}


def test_the_time_limit_truncates():
    found = episodes_of(Drive().topics(), time_limit_steps=12)
    assert [(e.first, e.last, e.ended_by) for e in found.episodes] == [
        (0, 12, "time limit"),
        (12, 24, "time limit"),
        (24, 29, "end of the recording"),
    ]
    assert not any(e.terminated for e in found.episodes)


def test_a_bump_terminates_where_the_task_says_so():
    topics = Drive().topics()
    time = np.arange(0, 6, 0.02)
    pressed = np.zeros(len(time), np.bool_)
    pressed[103] = True
    topics["/bumper"] = columns(time, {"data": pressed}, stamped=False)
    assert len(episodes_of(topics, bump_terminates=False).episodes) == 1
    found = episodes_of(topics, bump_terminates=True)
    assert found.episodes == [
        EpisodeSpan(0, 11, True, "bump", False),
        EpisodeSpan(16, 29, False, "end of the recording", False),
    ]
    assert found.dropped == {"bumper: pressed within the last 1 s": 4}


def test_scraping_along_something_is_one_bump():
    topics = Drive().topics()
    time = np.arange(0, 6, 0.02)
    pressed = (time > 2.0) & (time < 4.0) & (time % 0.5 < 0.1)  # touches it every half second
    topics["/bumper"] = columns(time, {"data": pressed}, stamped=False)
    found = episodes_of(topics, bump_terminates=True)
    assert [(e.first, e.last, e.ended_by) for e in found.episodes] == [
        (0, 11, "bump"),
        (23, 29, "end of the recording"),
    ]
    assert found.dropped == {"bumper: pressed within the last 1 s": 11}


def test_a_bump_on_a_new_goals_tick_begins_no_episode():
    topics = Drive(goals=[(0.0, 11.0, 1.0), (2.0, 10.0, 1.0)]).topics()
    time = np.arange(0, 6, 0.02)
    topics["/bumper"] = columns(time, {"data": time == 2.0}, stamped=False)
    found = episodes_of(topics, bump_terminates=True)
    assert found.episodes[0] == EpisodeSpan(0, 10, True, "bump", True)
    assert found.dropped == {"bumper: pressed within the last 1 s": 5}
    assert found.episodes[1].first == 15


def test_a_gap_truncates_on_the_tick_before():
    topics = Drive().topics()
    time = (topics["/cmd_vel"].log_time_ns - START_NS) * 1e-9
    topics["/cmd_vel"] = without(topics["/cmd_vel"], (time < 2) | (time > 3))
    found = episodes_of(topics)
    assert [(e.first, e.last, e.ended_by) for e in found.episodes] == [
        (0, 9, "gap"),
        (10, 24, "end of the recording"),
    ]


def test_stale_ticks_cut_and_are_counted_by_reason():
    topics = Drive().topics()
    time = (topics["/scan"].log_time_ns - START_NS) * 1e-9
    topics["/scan"] = without(topics["/scan"], (time < 2) | (time > 3.5))
    found = episodes_of(topics)
    assert found.dropped == {"scan: stale": 6}
    assert [e.ended_by for e in found.episodes] == ["scan: stale", "end of the recording"]


def test_a_clock_jump_truncates():
    topics = Drive().topics()
    for topic in topics.values():
        later = (topic.log_time_ns - START_NS) * 1e-9 > 3
        if "header.stamp" in topic.fields:
            topic.fields["header.stamp"][later] -= 3 * 10**9
    found = episodes_of(topics)
    assert [e.ended_by for e in found.episodes] == ["clock jump", "end of the recording"]
    assert not any(e.terminated for e in found.episodes)


@pytest.mark.parametrize("alone", [True, False])
def test_a_lone_tick_is_no_episode(alone):
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
def test_every_tick_is_a_transition_or_an_end_or_dropped_by_name(goals, lost, limit, bad):
    topics = Drive(goals=[(0.0, 4.0, 1.0), *goals]).topics()
    for name, (start, length) in lost.items():
        time = (topics[name].log_time_ns - START_NS) * 1e-9
        topics[name] = without(topics[name], (time < start) | (time > start + length))
    if len(topics["/odom"]) > max(bad, default=0):
        topics["/odom"].fields["twist.twist.linear.x"][bad] = np.nan
    found = episodes_of(topics, time_limit_steps=limit)  # which checks the sum
    for before, after in zip(found.episodes, found.episodes[1:], strict=False):
        assert after.first >= before.last if before.shared else after.first > before.last
    assert all(0 < e.last - e.first <= limit for e in found.episodes)
