"""Perturbations: what they say, what the sensors make of them, and that rows say which held."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from support.driven_robot import Drive, columns
from support.paths import ROOT
from support.stores import one

from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.episodes import steps_of
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.schema import Perturbed, parse_perturbation
from restock.replay.store.audit import load_audits, run_audits
from restock.replay.store.store import Store
from restock.train.dqn.config import parse_config
from restock.train.feed.fresh_log import FreshPerturbations
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import (
    RANGES,
    Perturbation,
    Schedule,
    find_perturbation,
)

PAGE = ROOT / "docs" / "twin.md"
COLUMNS = ["perturbation", "perturbation_values"]


# -- what they say ----------------------------------------------------------------------------


def test_only_what_is_not_nominal_is_kept() -> None:
    assert Perturbation().changed() == {}
    assert Perturbation(name="wet", friction_scale=0.5).changed() == {"friction_scale": 0.5}


def test_every_field_has_a_range_that_holds_its_default_and_a_line_in_the_docs() -> None:
    fields = {field.name: field.default for field in msgspec.structs.fields(Perturbation)}
    assert fields.keys() - {"name"} == RANGES.keys()
    page = PAGE.read_text(encoding="utf-8")
    for name, (low, high) in RANGES.items():
        assert low <= fields[name] <= high
        (line,) = [line for line in page.splitlines() if line.startswith(f"| `{name}` |")]
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[2:4] == [f"{low:g} to {high:g}", f"{fields[name]:g}"]


def test_a_perturbation_is_a_name_a_file_or_a_table(tmp_path: Path) -> None:
    file = tmp_path / "wet.toml"
    file.write_text('name = "wet"\nfriction_scale = 0.5\n')
    wet = Perturbation(name="wet", friction_scale=0.5)
    assert find_perturbation(str(file), where="here") == wet
    assert find_perturbation({"name": "wet", "friction_scale": 0.5}, where="here") == wet
    file.write_text("[ranges]\npayload_kg = [0, 50]\n")
    drawn = find_perturbation(str(file), where="here")
    assert isinstance(drawn, Schedule)
    assert drawn.ranges == {"payload_kg": (0, 50)}
    for wrong, message in (
        ("damp", "there is no perturbation 'damp'"),
        (str(tmp_path / "no.toml"), "No such file"),
        ({"frictionscale": 1}, "frictionscale"),
        ({"gain": 7}, r"gain must be in \[0.5, 1.5\], got 7"),
        ({"ranges": {"gain": [1, 0.9]}}, "must rise"),
    ):
        with pytest.raises(ConfigError, match=message):
            find_perturbation(wrong, where="here")


def test_a_training_config_takes_one() -> None:
    assert parse_config({}, where="t").env.perturbation == "nominal"
    table = {"name": "wet", "friction_scale": 0.5}
    assert parse_config({"env": {"perturbation": table}}, where="t").env.perturbation == table
    with pytest.raises(ConfigError, match="gainn"):
        parse_config({"env": {"perturbation": {"gainn": 1}}}, where="t")


# -- in the twin ------------------------------------------------------------------------------


def drive(steps: int = 6, **changed: float) -> list[dict[str, np.ndarray]]:
    """Return the signals of one robot on a fixed drive, from its first step on."""
    env = WarehouseVectorEnv(1, perturbation=Perturbation(**changed))
    env.set_episodes([EpisodeSpec("nominal", 7)])
    env.reset(seed=0)
    seen = [env.signals]
    for _ in range(steps):
        seen.append(env.step(np.array([1]))[4]["signals"])
    return seen


def test_a_slow_lidar_shows_the_scan_before() -> None:
    scans = [signals["sector_clearance_m"] for signals in drive(lidar_period_s=0.4)]
    fresh = [not np.array_equal(*pair) for pair in pairwise(scans)]
    assert fresh == [False, True] * 3


def test_a_slow_localisation_keeps_its_pose_and_the_stamp_of_it() -> None:
    seen = drive(localisation_period_s=0.6)
    age_s = [(s["stamp_ns"] - s["pose_stamp_ns"])[0] * 1e-9 for s in seen]
    np.testing.assert_allclose(age_s, [0, 0.2, 0.4, 0, 0.2, 0.4, 0], atol=1e-9)
    x = [s["pose_x_m"][0] for s in seen]
    assert x[0] == x[1] == x[2] != x[3] == x[4] == x[5] != x[6]
    # No new pose is no evidence of motion: the wheels' speed stands in.
    assert seen[2]["localised_speed_mps"] == seen[2]["wheel_speed_mps"]


@pytest.mark.parametrize(
    ("field", "bias", "signal", "shift"),
    [
        ("encoder_bias_radps", 0.5, "wheel_speed_mps", 0.05),  # times the wheel's radius
        ("gyro_bias_radps", 0.1, "gyro_yaw_rate_radps", 0.1),
        ("accel_bias_mps2", 0.3, "accel_x_mps2", 0.3),
    ],
)
def test_a_bias_moves_its_signal_and_no_other(
    field: str, bias: float, signal: str, shift: float
) -> None:
    plain, biased = drive(2)[-1], drive(2, **{field: bias})[-1]
    assert (biased[signal] - plain[signal])[0] == pytest.approx(shift)
    for other in ("pose_x_m", "clearance_m", "gyro_yaw_rate_radps", "accel_x_mps2"):
        assert other == signal or biased[other] == plain[other]


def test_stale_sensors_go_on_bit_for_bit_from_a_saved_state() -> None:
    slow = Perturbation(lidar_period_s=0.6, localisation_period_s=0.6)
    env, other = (WarehouseVectorEnv(2, perturbation=slow, seed=3) for _ in range(2))
    env.reset(seed=3)
    env.step(np.array([1, 1]))
    other.reset(seed=9)
    other.load_state_dict(env.state_dict())
    for _ in range(3):
        np.testing.assert_array_equal(
            env.step(np.array([1, 2]))[0], other.step(np.array([1, 2]))[0]
        )


def test_info_says_what_is_in_force_in_each_environment() -> None:
    env = WarehouseVectorEnv(2, perturbation=Schedule(ranges={"payload_kg": (10, 60)}))
    env.reset(seed=1)
    info = env.step(np.array([1, 1]))[4]
    assert info["perturbation"].tolist() == ["schedule"] * 2
    values = [json.loads(text) for text in info["perturbation_values"]]
    assert values == [spec.perturbation.changed() for spec in env.specs if spec.perturbation]
    assert values[0] != values[1]


def test_fresh_episodes_are_forgotten_with_their_rows() -> None:
    fresh = FreshPerturbations()
    for key in range(9):
        fresh.note(np.array([key]), ["wet"], [json.dumps({"gain": 0.9})])
    assert fresh.names(np.array([3, 99])) == ["wet", None]
    assert fresh.values(np.array([3, 99])) == [[("gain", 0.9)], None]
    again = FreshPerturbations()
    again.load_state_dict(json.loads(json.dumps(fresh.state_dict())))
    again.forget(np.array([8, 8]))
    assert again.names(np.array([3, 8])) == [None, "wet"]


# -- in recordings and stores -----------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        *("wet", "3", '{"name": "wet"}', '{"name": 1, "values": {}}', '{"name": "a", "values": 1}'),
        *("[" * 100_000, '{"name": "a", "values": {"x": ' + "9" * 400 + "}}"),
    ],
    ids=lambda text: text[:40],
)
def test_what_is_no_perturbation_is_not_known_and_said(text: str) -> None:
    assert parse_perturbation(text) is None
    perturbed = Perturbed.read(
        [text, '{"name": "wet", "values": {"gain": 0.9}}'], np.array([0, 1, -1])
    )
    names, values = perturbed.columns(np.arange(3))
    assert names.to_pylist() == [None, "wet", None]
    assert values.to_pylist() == [None, [("gain", 0.9)], None]
    assert len(perturbed.notes) == 1


def test_a_recording_holds_what_was_said_from_then_on() -> None:
    profile, topics = load_profile("warehouse_amr"), Drive(duration_s=4.0).topics()
    texts = [
        json.dumps({"name": "wet", "values": {"friction_scale": 0.5}}),
        json.dumps({"name": "nominal", "values": {}, "patches": [[1, 2, 1, 1, 0.03]]}),
    ]
    topics["/ground_truth/perturbation"] = columns(
        np.array([0.0, 2.0]), {"data": np.array(texts, object)}, stamped=False
    )
    steps = steps_of(profile, topics)
    names, values = steps.perturbed.columns(np.arange(len(steps)))
    assert names.to_pylist() == ["wet"] * 10 + ["nominal"] * (len(steps) - 10)
    assert values[0].as_py() == [("friction_scale", 0.5)]
    assert values[len(steps) - 1].as_py() == []
    hardware = steps_of(profile, Drive(duration_s=4.0).topics())
    assert set(hardware.perturbed.columns(np.arange(5))[0].to_pylist()) == {None}


def test_the_audit_names_thin_cells_of_a_perturbation(tmp_path: Path) -> None:
    manifest, rows = one(1)
    StoreWriter(tmp_path / "s").write(manifest, rows)
    thin = [audit for audit in load_audits() if audit.name == "thin_perturbation"]
    with Store(tmp_path / "s") as store:
        (audit,) = run_audits(store.connection, thin, {"thin_perturbation": {"min_rows": 100}})
    counts = dict.fromkeys(("recovery", "wheel_slip", "blocked_aisle", "near_collision"), 0)
    for name, held in zip(
        rows["perturbation"].to_pylist(), rows["conditions"].to_pylist(), strict=True
    ):
        for condition in (held or ["nominal"]) if name == "wet" else ():
            counts[condition] = counts.get(condition, 0) + 1
    expected = {name: count for name, count in counts.items() if count < 100}
    assert {row["condition"]: row["rows"] for row in audit.sample} == expected
    assert {row["perturbation"] for row in audit.sample} == {"wet"}
    assert audit.status == "info"


def test_values_are_a_map_that_sql_can_index(tmp_path: Path) -> None:
    StoreWriter(tmp_path / "s").write(*one(1))
    with Store(tmp_path / "s") as store:
        (scale,) = store.sql(
            "SELECT DISTINCT perturbation_values['friction_scale'] FROM transitions"
            " WHERE perturbation = 'wet'"
        ).fetchall()
        table = store.sql("SELECT perturbation_values FROM transitions").to_arrow_table()
    assert scale == (0.5,)
    assert pa.types.is_map(table.schema.field(0).type)
