"""Check perturbations: their files, their effect on sensors, and their record in rows."""

import json
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.signal import lfilter
from support.driven_robot import Drive, columns
from support.paths import ROOT

from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.episodes import steps_of
from restock.ingest.task.schema import Perturbed, parse_perturbation
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import default_warehouse
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import (
    RANGES,
    Perturbation,
    Schedule,
    find_perturbation,
)
from restock.train.twin.physics.sensing import DRIFT_TIME_S, Sensing
from restock.train.twin.physics.simulation import Simulation

PAGE = ROOT / "docs" / "twin.md"


def test_every_field_has_a_documented_range() -> None:
    fields = {field.name: field.default for field in msgspec.structs.fields(Perturbation)}
    assert fields.keys() - {"name"} == RANGES.keys()
    page = PAGE.read_text(encoding="utf-8")
    for name, (low, high) in RANGES.items():
        assert low <= fields[name] <= high
        (line,) = [line for line in page.splitlines() if line.startswith(f"| `{name}` |")]
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[2:4] == [f"{low:g} to {high:g}", f"{fields[name]:g}"]


def test_perturbation_from_name_file_or_table(tmp_path: Path) -> None:
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


def drive(steps: int = 6, **changed: float) -> list[dict[str, np.ndarray]]:
    """Return the signals of one robot on a fixed drive, step by step."""
    env = WarehouseVectorEnv(1, perturbation=Perturbation(**changed))
    env.set_episodes([EpisodeSpec("nominal", 7)])
    env.reset(seed=0)
    seen = [env.signals]
    for _ in range(steps):
        seen.append(env.step(np.array([1]))[4]["signals"])
    return seen


def test_slow_lidar_repeats_previous_scan() -> None:
    scans = [signals["sector_clearance_m"] for signals in drive(lidar_period_s=0.4)]
    fresh = [not np.array_equal(*pair) for pair in pairwise(scans)]
    assert fresh == [False, True] * 3


def test_slow_localisation_keeps_pose_and_stamp() -> None:
    seen = drive(localisation_period_s=0.6)
    age_s = [(s["stamp_ns"] - s["pose_stamp_ns"])[0] * 1e-9 for s in seen]
    np.testing.assert_allclose(age_s, [0, 0.2, 0.4, 0, 0.2, 0.4, 0], atol=1e-9)
    x = [s["pose_x_m"][0] for s in seen]
    assert x[0] == x[1] == x[2] != x[3] == x[4] == x[5] != x[6]
    # Without a new pose, the wheel speed is used.
    assert seen[2]["localised_speed_mps"] == seen[2]["wheel_speed_mps"]


@pytest.mark.parametrize(
    ("field", "bias", "signal", "shift"),
    [
        ("encoder_bias_radps", 0.5, "wheel_speed_mps", 0.05),  # times the wheel's radius
        ("gyro_bias_radps", 0.1, "gyro_yaw_rate_radps", 0.1),
        ("accel_bias_mps2", 0.3, "accel_x_mps2", 0.3),
    ],
)
def test_bias_shifts_only_its_signal(field, bias, signal, shift):
    plain, biased = drive(2)[-1], drive(2, **{field: bias})[-1]
    assert (biased[signal] - plain[signal])[0] == pytest.approx(shift)
    for other in ("pose_x_m", "clearance_m", "gyro_yaw_rate_radps", "accel_x_mps2"):
        assert other == signal or biased[other] == plain[other]


def test_localisation_drift_is_autoregressive() -> None:
    task = load_profile("warehouse_amr").task
    sensing = Sensing(Simulation(4, task, default_warehouse(), 0.01, nthread=1), task)
    keep = np.exp(-task.control_period_s / DRIFT_TIME_S)
    walks = []
    for env in range(4):
        sensing.reset(env, np.random.SeedSequence(env), Perturbation())
        sensing._draw(env, task.time_limit_steps)
        walk = sensing._noise[env, :, 3:5]
        drawn = np.random.Generator(np.random.SFC64(np.random.SeedSequence(env))).standard_normal(
            dtype=np.float32, size=sensing._noise[env].shape
        )[:, 3:5]
        drawn[1:] *= np.sqrt(1 - keep**2)
        drawn[:] = lfilter([1.0], [1.0, -keep], drawn, axis=0)
        assert np.array_equal(walk, drawn)  # bit-identical, as in earlier runs
        walks.append(walk)
    assert 0.5 < np.var(walks) < 1.5


@pytest.mark.parametrize(
    "text",
    [
        *("wet", "3", '{"name": "wet"}', '{"name": 1, "values": {}}', '{"name": "a", "values": 1}'),
        *("[" * 100_000, '{"name": "a", "values": {"x": ' + "9" * 400 + "}}"),
    ],
    ids=lambda text: text[:40],
)
def test_invalid_perturbation_is_unknown_and_noted(text: str) -> None:
    assert parse_perturbation(text) is None
    perturbed = Perturbed.read(
        [text, '{"name": "wet", "values": {"gain": 0.9}}'], np.array([0, 1, -1])
    )
    names, values = perturbed.columns(np.arange(3))
    assert names.to_pylist() == [None, "wet", None]
    assert values.to_pylist() == [None, [("gain", 0.9)], None]
    assert len(perturbed.notes) == 1


def test_perturbation_message_applies_from_its_time() -> None:
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
