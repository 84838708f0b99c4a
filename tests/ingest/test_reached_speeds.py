"""What a robot did of its fastest commands: a limit where it stays far below them, else none."""

from __future__ import annotations

import numpy as np
import pytest
from support.driven_robot import SPEED_MPS, Drive, columns, write_bag

from restock.cli import main
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.propose.commands import limit_of, settled_speeds

TICKS_S = np.arange(0, 20, 0.1)
TOLD = np.where(TICKS_S % 5 < 3, 0.5, 0.1)  # 3 s fast, 2 s slowly


def late(reported: np.ndarray, at_s: np.ndarray, most: float) -> np.ndarray:
    """Return a base that follows after .3 s, as fast as it can."""
    index = np.searchsorted(TICKS_S, at_s - 0.3, "right") - 1
    return np.clip(reported[np.maximum(index, 0)], -most, most)


@pytest.mark.parametrize("way", [1, -1])
def test_a_base_that_cuts_off_shows_its_limit(way):
    at_s = np.arange(0, 20, 0.05)
    reported = way * TOLD
    for most, limit in ((0.3, 0.3), (0.2, 0.2), (0.45, None), (1.0, None)):
        settled = settled_speeds(TICKS_S, reported, at_s, late(reported, at_s, most), 0.5)
        assert limit_of(settled, 0.5) == limit


def test_what_has_not_settled_says_nothing():
    at_s = np.arange(0, 20, 0.05)
    reported = np.where(TICKS_S % 1.6 < 0.8, 0.5, -0.5)  # another way before it could follow
    settled = settled_speeds(TICKS_S, reported, at_s, late(reported, at_s, 0.3), 0.5)
    assert len(settled) == 0
    assert limit_of(settled, 0.5) is None


class Hurried(Drive):
    """Told to drive at three times the speed that it has."""

    def topics(self):
        ticks = np.arange(0, self.duration_s, 0.2)
        reported = {"linear.x": np.full(len(ticks), 3 * SPEED_MPS), "angular.z": 0 * ticks}
        return super().topics() | {"/cmd_vel": columns(ticks + 0.005, reported, stamped=False)}


def test_a_proposal_has_the_limit_in_its_actions_and_in_the_twin(tmp_path):
    file = tmp_path / "robot.toml"
    bag = write_bag(Hurried(duration_s=12.0), tmp_path / "bag")
    assert main(["profile", "new", str(bag), "--out", str(file)]) == 0
    profile = load_profile(str(file))
    assert profile.robot is not None
    assert profile.robot.max_speed_mps == SPEED_MPS
    assert profile.robot.origin_of("max_speed_mps") == "logs"
    assert max(speed for speed, _ in profile.task.actions) == SPEED_MPS
    assert "beyond 0.5 m/s were commanded" in file.read_text()
    assert parse_profile(file.read_text(), where="again").hash == profile.hash
