"""How a robot moves and what it senses: the MuJoCo model, traffic, friction, perturbations."""

import mujoco as _mujoco

# Divergence is counted and reported: MuJoCo shall not write MUJOCO_LOG.TXT where the user stands.
_log = _mujoco.MjLogConfig.get()
_log.logto_file = False
_log.set()
