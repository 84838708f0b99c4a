"""`restock node`: an exported policy as a ROS 2 lifecycle node, or played a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from restock.ingest.profile.profile import Profile


@dataclass
class NodeCommand:
    """Run an exported policy on a robot, as a ROS 2 lifecycle node.

    It starts unconfigured, and in shadow mode: it says what it would drive and commands nothing.
    `ros2 lifecycle set /restock_policy configure`, then `activate`; or --activate. Parameters of
    ROS follow --ros-args. With --on it needs no ROS: a recording is played to it, and what it would
    have done is counted. See docs/deploy.md.

    Example: `restock node policy.onnx --activate --ros-args -p use_sim_time:=true`
    """

    policy: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY.onnx")]
    """What `restock export RUN --to onnx` wrote."""
    drive: bool = False
    """Publish commands: the parameter shadow is then false."""
    activate: bool = False
    """Configure and activate at once, without a lifecycle manager."""
    on: Annotated[Path | None, tyro.conf.arg(metavar="RECORDING")] = None
    """Play this recording to the policy instead, behind its limiter, and print what came of it."""
    profile: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """With --on: a profile in place of the one that the policy carries."""
    write_profile: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Write the policy's profile, with what the node publishes as columns: for ingesting
    recordings in which it ran."""

    def run(self) -> int:
        from restock.errors import ConfigError
        from restock.ingest.live.policy_file import PolicyFile

        if self.on is not None:
            return self._play(self.on)
        if self.profile is not None and self.write_profile is None:
            raise ConfigError(
                "only goes with --on and --write-profile",
                where="--profile",
                remedy="to the node give it as a parameter: --ros-args -p profile:=FILE",
            )
        if self.write_profile is not None:
            return self._write(PolicyFile(self.policy, self.profile).profile, self.write_profile)
        from restock.ingest.live.node import run_node
        from restock.ingest.live.ros import load_ros

        ros = load_ros()
        PolicyFile(self.policy)  # refused before anything is on the graph
        return run_node(ros, self.policy, drive=self.drive, activate=self.activate)

    def _play(self, recording: Path) -> int:
        from restock.cli.output import print_json
        from restock.ingest.live.pilot import Pilot
        from restock.ingest.live.played import play, summary
        from restock.ingest.live.policy_file import PolicyFile
        from restock.ingest.task.limiter import Limits

        policy = PolicyFile(self.policy, self.profile)
        profile = policy.profile
        pilot = Pilot(policy, Limits.of(profile.task, profile.robot, profile.limiter))
        print_json(summary(pilot, list(play(pilot, recording))))
        return 0

    def _write(self, profile: Profile, out: Path) -> int:
        from restock.cli.output import say
        from restock.errors import ConfigError
        from restock.files import write_bytes
        from restock.ingest.live.node_topics import with_node_topics
        from restock.ingest.profile.profile_text import profile_toml

        if out.exists():
            raise ConfigError("already exists", where=str(out), remedy="choose another file")
        write_bytes(out, profile_toml(with_node_topics(profile)).encode())
        say(f"{out}: restock ingest RECORDINGS --profile {out} --store STORE")
        return 0
