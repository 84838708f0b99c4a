"""`restock-node`: runs an exported policy as a ROS 2 lifecycle node, or plays it a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from restock.cli.output import print_json, say
from restock.cli.words import Option, Positional
from restock.errors import ConfigError, quoted

if TYPE_CHECKING:
    from restock.ingest.profile.profile import Profile


@dataclass
class NodeCommand:
    """Run an exported policy on a robot, as a ROS 2 lifecycle node.

    It starts unconfigured and in shadow mode: it reports the commands it would send, and sends
    none. To start it, run `ros2 lifecycle set /restock_policy configure` and then `activate`, or
    give --activate. ROS parameters follow --ros-args. With --on, ROS is not needed: a recording is
    played to the policy, and its decisions are counted. See docs/deploy.md.

    Example: `restock-node policy.onnx --activate --ros-args -p use_sim_time:=true`
    """

    policy: Annotated[Path, Positional("POLICY.onnx")]
    """The policy file that `restock export RUN --to onnx` wrote."""
    drive: bool = False
    """Publish commands: sets the parameter shadow to false."""
    activate: bool = False
    """Configure and activate at once, without a lifecycle manager."""
    on: Annotated[Path | None, Option("RECORDING")] = None
    """Instead of starting a node, play this recording to the policy with its limiter, and print the
    results."""
    profile: Annotated[str | None, Option("NAME|FILE")] = None
    """With --on: use this profile instead of the one in the policy file."""
    write_profile: Annotated[Path | None, Option("FILE.toml")] = None
    """Write the policy's profile with extra columns for the topics that the node publishes, to
    ingest recordings of drives with this policy."""

    def run(self) -> int:
        from restock.ingest.live.policy_file import PolicyFile

        if self.on is not None:
            return self._play(self.on)
        if self.profile is not None and self.write_profile is None:
            raise ConfigError(
                "applies only to --on and --write-profile",
                where="--profile",
                remedy="for the node, give it as a parameter: --ros-args -p profile:=FILE",
            )
        if self.write_profile is not None:
            return self._write(PolicyFile(self.policy, self.profile).profile, self.write_profile)
        from restock.ingest.live.node import load_ros, run_node

        ros = load_ros()
        PolicyFile(self.policy)  # refuse a bad file before the node joins the graph
        return run_node(ros, self.policy, drive=self.drive, activate=self.activate)

    def _play(self, recording: Path) -> int:
        from restock.ingest.live.pilot import Pilot, play, summary
        from restock.ingest.live.policy_file import PolicyFile
        from restock.ingest.task.robot import Limits

        policy = PolicyFile(self.policy, self.profile)
        profile = policy.profile
        pilot = Pilot(policy, Limits.of(profile.task, profile.robot, profile.limiter))
        print_json(summary(pilot, list(play(pilot, recording))))
        return 0

    def _write(self, profile: Profile, out: Path) -> int:
        from restock.files import expect_file_place, write_bytes
        from restock.ingest.live.node import with_node_topics
        from restock.ingest.profile.profile import profile_toml

        if out.exists():
            raise ConfigError("already exists", where=str(out), remedy="choose another file")
        expect_file_place(out, "--write-profile")
        write_bytes(out, profile_toml(with_node_topics(profile)).encode())
        say(f"{out}: restock ingest RECORDINGS --profile {quoted(out)} --store STORE")
        return 0
