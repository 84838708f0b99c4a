"""Add a kind of mission in one file: it is staged, driven, scored and drawn."""

import shutil
import subprocess
import sys
from pathlib import Path

from support.paths import ROOT

KIND = '''
from restock.train.twin.floors.layout import Walk
from restock.train.twin.missions.mission import Mission, Staged
import numpy as np

def stage(rng, warehouse, plan):
    """Stage somebody who stands beside the start of the plan."""
    way = plan[:1] + rng.uniform(0.9, 1.0) + np.linspace(0.0, 0.5, 24)[:, None]
    trigger = (float(plan[0, 0]), float(plan[0, 1]), 5.0)
    return Staged(walks=(Walk(way, 0.5, trigger, True), None, None))

MISSION = Mission("bystander_close_by", stage, share=0.1, natural=0.05, colour="#009e73",
                  place=9, is_true=lambda now: now.traffic_gap_m.min(axis=1) < 3.0)
'''
DRIVE = """
import sys
from restock.train import twin
twin.__path__.insert(0, sys.argv[1])
import numpy as np
from restock.report.look.blocks import CONDITION_COLOURS
from restock.train.dqn.config import TrainConfig
from restock.train.study.contrasts import CELLS, RARE
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.missions import NATURAL
from restock.train.twin.recording.fleet import meets
kind = "bystander_close_by"
env = WarehouseVectorEnv(4, conditions={kind: 1.0}, seed=1)
env.reset(seed=1)
truths = [str(env.step(np.zeros(4, np.int64))[-1]["true_condition"][0]) for _ in range(3)]
assert set(env.episode_condition) == {kind}, env.episode_condition
assert meets(kind, truths) and not meets(kind, ["nominal"]), truths
assert kind in CELLS and kind in RARE and kind in TrainConfig().env.conditions
assert NATURAL[kind] == 0.05 and CONDITION_COLOURS[kind] == "#009e73"
assert [arm.name for arm in env.mission_arms()] == [kind]
"""


def test_new_mission_kind_needs_one_file(tmp_path: Path) -> None:
    kinds = shutil.copytree(ROOT / "train/twin/missions", tmp_path / "missions")
    (kinds / "bystander.py").write_text(KIND)
    done = subprocess.run(  # a process of its own: the registry is read once
        [sys.executable, "-c", DRIVE, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
