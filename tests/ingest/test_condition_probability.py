"""Probabilities of conditions, named parts of their rules, and the noise that a profile states."""

import numpy as np
import pytest
from support.profile_texts import WAREHOUSE
from support.step_tables import steps
from support.stores import recording_transitions, write_store

from restock.errors import ConfigError
from restock.ingest.profile.profile import parse_profile, profile_toml
from restock.ingest.store.transitions import replaced
from restock.ingest.task.conditions import (
    Condition,
    label,
    labels_version,
    probabilities,
    settings_of,
    shipped,
    too_near_to_call,
)
from restock.ingest.task.task import Noise
from restock.replay.store.store import Store

FILE = """-- Fast, for a while.
-- timing: pre
-- priority: 35
-- uncertain: 0.1 to 0.6
-- let over_mps:
wheel_speed_mps - 0.5 -- of half a metre a second
-- let smooth_mps:
avg(over_mps) OVER (episode ROWS BETWEEN 1 PRECEDING AND CURRENT ROW)
-- label:
smooth_mps > 0
-- probability:
CASE WHEN step_index > 0 THEN 1 / (1 + exp(-smooth_mps / lidar_noise_m)) END
"""


def condition(text: str = FILE, noise_m: float = 0.1) -> Condition:
    made = Condition(name="fast", **settings_of(text))
    return made.with_constants(Noise(lidar_m=noise_m).constants)


def test_parts_of_a_condition_file():
    fast = condition()
    assert (fast.doc, fast.timing, fast.priority) == ("Fast, for a while.", "pre", 35)
    assert list(fast.let) == ["over_mps", "smooth_mps"]
    assert fast.constants == {"lidar_noise_m": 0.1}  # what it names, and no more
    table = steps(5, wheel_speed_mps=np.array([0.5, 0.7, 0.1, 0.9, 0.9]))
    assert label(table, [fast])["fast"].tolist() == [False, True, False, False, True]
    given = probabilities(table, [fast])["fast"]
    assert np.isnan(given[0])
    np.testing.assert_allclose(given[1:], 1 / (1 + np.exp([-1, 1, 0, -4])), rtol=1e-5)
    near = too_near_to_call({"fast": given}, [fast])["fast"]
    assert near.tolist() == [False, False, True, True, False]


def test_more_noise_makes_a_probability_less_sure():
    table = steps(3, wheel_speed_mps=np.array([0.5, 0.7, 0.9]))
    sure, unsure = (probabilities(table, [condition(noise_m=n)])["fast"][2] for n in (0.05, 0.5))
    assert sure > 0.95 > unsure > 0.5


def test_the_version_of_labels_follows_what_can_change_them():
    plain = Condition("fast", "pre", "wheel_speed_mps > 1")
    assert labels_version([plain]) == labels_version([plain.with_constants(Noise().constants)])
    versions = {
        labels_version([condition(text, noise)])
        for text in (FILE, FILE.replace("0.1 to", "0.3 to"), FILE.replace("0.5 --", "0.6 --"))
        for noise in (0.1, 0.2)
    }
    assert len(versions) == 6


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FILE.replace("wheel_speed_mps - 0.5", "lead(wheel_speed_mps) OVER episode"), "'over_mps"),
        (FILE.replace("let smooth_mps", "let pose_x_m"), "'pose_x_m' is already used"),
        (FILE.replace("1 / (1 + exp(-smooth_mps / lidar_noise_m))", "1.5"), "in \\[0, 1\\]"),
        (FILE.replace("1 / (1 + exp(-smooth_mps / lidar_noise_m))", "'much'"), "not a number"),
        (FILE.replace("1 / (1 +", "1 / (unheard_of +"), "probability of condition 'fast'"),
        (FILE.replace("1 / (1 +", "1 / ((SELECT 1) +"), "contains a query"),
    ],
)
def test_a_probability_keeps_the_rules_of_a_label(text, said):
    with pytest.raises(ConfigError, match=said):
        probabilities(steps(3), [condition(text)])


def test_noise_of_a_profile_does_not_change_rows():
    usual = parse_profile(WAREHOUSE, where="a")
    noisy = parse_profile(WAREHOUSE + "\n[noise]\nlidar_m = 0.05\n", where="b")
    assert usual.hash == noisy.hash
    assert usual.labels_version != noisy.labels_version
    near = next(one for one in noisy.conditions if one.name == "near_collision")
    assert near.constants == {"lidar_noise_m": 0.05, "tight_clearance_m": 0.15}
    carried = parse_profile(profile_toml(noisy), where="its text")
    assert carried.labels_version == noisy.labels_version
    assert shipped(noisy.constants)["near_collision"] == near
    with pytest.raises(ConfigError, match="lidar_m"):
        parse_profile(WAREHOUSE + "\n[noise]\nlidar_m = 0\n", where="c")


OWN = '''
[[condition]]
name = "tight"
timing = "pre"
sql = """
min(clearance_m) OVER (episode ROWS BETWEEN {{{0}}} PRECEDING AND CURRENT ROW)
< tight_clearance_m"""
'''


def test_a_condition_of_ones_own_may_name_limits_and_write_times() -> None:
    profile = parse_profile(WAREHOUSE + OWN.format("1 s"), where="here")
    tight = profile.conditions[-1]
    assert "ROWS BETWEEN 5 PRECEDING" in tight.sql
    assert tight.constants == {"tight_clearance_m": 0.15}
    carried = parse_profile(profile_toml(profile), where="its text")
    assert carried.labels_version == profile.labels_version
    with pytest.raises(ConfigError, match=r"(?s)tight.*\{1\.6 s\}"):
        parse_profile(WAREHOUSE + OWN.format("1 min"), where="here")


def test_probabilities_stand_beside_how_often_they_are_true(tmp_path):
    table = recording_transitions(1)
    truth = ["recovery" if row % 3 else "nominal" for row in range(len(table))]
    path = write_store(tmp_path / "store", [replaced(table, {"true_condition": truth})])
    rows = [dict(row).get("recovery") for row in table["probabilities"].to_pylist()]
    want: dict[float, list[bool]] = {}
    for told, true in zip(rows, truth, strict=True):
        if told is not None:
            want.setdefault(min(int(told * 10), 9) / 10, []).append(true == "recovery")
    with Store(path) as store:
        found = store.sql("SELECT from_probability, known, true_share FROM label_reliability")
        for tenth, known, share in found.fetchall():
            held = want.pop(tenth)
            assert (known, share) == (len(held), pytest.approx(np.mean(held)))
    assert not want
