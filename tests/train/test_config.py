"""Check that invalid configuration values are reported by their key."""

from pathlib import Path
from typing import Any

import gymnasium
import pytest

from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.train.dqn.config import Hard, Polyak, TrainConfig, load_config
from restock.train.feed.practice import make_twin
from restock.train.prepare import prepare_new


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("loss.discount=1.0", r"loss\.discount must be in \[0, 1\), got 1"),
        ("network.hidden=[64, 0]", r"network\.hidden\[1\] must be at least 1, got 0"),
        ("optimizer.learning_rate=0", r"optimizer\.learning_rate must be above 0, got 0"),
        ("replay.ring_capacity=8", r"replay\.ring_capacity must hold .* a batch of 128, got 8"),
        ("epsilon.start=1.5", r"epsilon\.start must be in \[0, 1\], got 1\.5"),
        ("env.conditions={nominal = 0}", r"env\.conditions must have a share above 0"),
        ("target={rule='polyak', tau=2}", r"target\.tau must be in \(0, 1\], got 2"),
        ("target={rule='polyak', tau=0}", r"target\.tau must be in \(0, 1\], got 0"),
        ("target={rule='polyak', tau=nan}", r"target\.tau must be in \(0, 1\], got nan"),
        ("target={rule='hard', every=0}", r"target\.every must be at least 1, got 0"),
        ("seed=-1", r"seed must be in \[0, 2147483647\], got -1"),
        ("teacher.source='the planner'", "source must be none, operator, planner"),
        ("threads=0", r"threads must be in \[1, 1024\], got 0"),
        (
            "loss.n_step=1000000",
            r"ring_capacity must be at least .* = 32,000,000 rows, got 100,000",
        ),
        ("schedule.updates_per_env_step=1e9", r"must be in \(0, 1000\], got 1000000000"),
    ],
)
def test_out_of_range_value_reports_its_range(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(None, [override])


def test_target_override_keeps_the_rule(tmp_path: Path) -> None:
    assert load_config(None, ["target.tau=0.02"]).target == Polyak(tau=0.02)
    hard = tmp_path / "hard.toml"
    hard.write_text('target = {rule = "hard", every = 7}\n')
    assert load_config(hard, ["target.every=9"]).target == Hard(every=9)


def test_error_names_config_file_or_set_option(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("seed = 1\n")
    with pytest.raises(ConfigError, match=r"^--set: seed must be in"):
        load_config(file, ["seed=-1"])
    file.write_text("seed = -1\n")
    for overrides in ([], ["device=cpu"]):
        with pytest.raises(ConfigError, match=r"a\.toml: seed must be in"):
            load_config(file, overrides)
    file.write_text('[target]\nrule = "hard"\n')
    with pytest.raises(ConfigError, match=r"a\.toml and --set: `target\.tau` is a setting of"):
        load_config(file, ["target.tau=0.1"])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("replay.ring_capacity=99999999999", r"ring_capacity: needs .* GB of memory; this mach"),
        ("teacher={source='none', ratio=0.2}", r"teacher\.ratio: has no effect if .* \"none\""),
        ("teacher={source='none', mirror=true}", r"teacher\.mirror: has no effect if"),
        ("teacher={source='none', margin=0.5}", r"teacher\.margin: has no effect if"),
        ("teacher={source='operator', margin=0.5}", r"teacher\.margin: has no effect if"),
        ("teacher={source='planner', ratio=0.5}", r"teacher\.ratio: has no effect if"),
        ("teacher={source='planner', policies=['x']}", r"teacher\.policies: has no effect if"),
        ("env.missions_share=0.9", r"env\.missions_share: has no effect without missions"),
        ("teacher.source=no_such_module:foo", r"no_such_module:foo cannot be imported"),
    ],
)
def test_impossible_run_creates_no_folder(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        prepare_new(tmp_path / "run", None, None, [override])
    assert not (tmp_path / "run").exists()


def test_failed_start_leaves_no_folder(tmp_path, monkeypatch):
    def refuse(*_: Any, **__: Any) -> None:
        raise MemoryError

    prepared = prepare_new(tmp_path / "run", None, None, ["env.num_envs=1"])
    monkeypatch.setattr("restock.train.session.make_learner", refuse)
    with pytest.raises(MemoryError):
        prepared.open()
    assert not (tmp_path / "run").exists()


def test_renamed_key_is_rejected_with_remedy(tmp_path: Path) -> None:
    old = tmp_path / "old.toml"
    old.write_text("[network]\nensemble = 3\n")
    for path, overrides in ((old, []), (None, ["network.ensemble=3"])):
        with pytest.raises(ConfigError, match=r"unknown key `network\.ensemble`") as refused:
            load_config(path, overrides)
        assert "--to run" in str(refused.value)


def test_default_shares_match_gymnasium_environment() -> None:
    trained: Any = make_twin(TrainConfig(), load_profile("warehouse_amr"), 2)
    made: Any = gymnasium.make_vec("restock/Warehouse-v0", num_envs=2)
    try:
        shares = made.unwrapped.queue.conditions
        assert shares == trained.queue.conditions
        others = dict.fromkeys(("wheel_slip", "blocked_aisle", "near_collision"), 0.2)
        assert shares == {"nominal": 0.4, **others}
    finally:
        trained.close()
        made.close()
