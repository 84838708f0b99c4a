"""The twin as a robot on a graph: it publishes what it senses, and drives by /cmd_vel."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from restock.ingest.live.policy_file import FORMAT, with_digest
from restock.ingest.profile.profile import Profile, profile_toml
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.recording.bag_writer import build, stamp
from support.ros_graph import Graph


class TwinRobot:
    """One episode of a warehouse; `step` senses, lets the node decide, and drives a period."""

    def __init__(self, graph: Graph, spec: EpisodeSpec) -> None:
        self.graph = graph
        self.env = WarehouseVectorEnv(1, action="continuous")
        self.env.set_episodes([spec])
        self.env.reset(seed=0)
        self.command = np.zeros((1, 2))
        self.info: dict[str, Any] = {}
        self._plan = -1
        graph.heard.setdefault("/cmd_vel", []).append((graph_qos(), self._commanded))

    def _commanded(self, message: Any) -> None:
        self.command = np.array([[message.linear.x, message.angular.z]])

    def sense(self, **instead: Any) -> None:
        """Publish what is sensed now; `instead` of the scan's ranges, say."""
        graph, env = self.graph, self.env
        now = {name: column[0] for name, column in env.signals.items()}
        graph.now_ns = int(now["stamp_ns"])
        header = {"stamp": stamp(graph.now_ns), "frame_id": "map"}
        speed, turn = float(now["wheel_speed_mps"]), float(now["wheel_yaw_rate_radps"])
        twist = {"linear": {"x": speed}, "angular": {"z": turn}}
        self._send("/odom", "nav_msgs/msg/Odometry", header=header, twist={"twist": twist})
        gyro, accel = float(now["gyro_yaw_rate_radps"]), float(now["accel_x_mps2"])
        self._send(
            *("/imu", "sensor_msgs/msg/Imu"),
            header=header,
            angular_velocity={"z": gyro},
            linear_acceleration={"x": accel},
        )
        x, y, yaw = (float(now[f"pose_{name}"]) for name in ("x_m", "y_m", "yaw_rad"))
        turned = {"z": np.sin(yaw / 2), "w": np.cos(yaw / 2)}
        self._send(
            *("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped"),
            header=header | {"stamp": stamp(int(now["pose_stamp_ns"]))},
            pose={"pose": {"position": {"x": x, "y": y}, "orientation": turned}},
        )
        bearings = env.simulation.bearings_rad
        scan = {
            "ranges": env.sensing.ranges_m[0].astype(np.float32),
            "angle_min": float(bearings[0]),
            "angle_increment": float(bearings[1] - bearings[0]),
        }
        self._send("/scan", "sensor_msgs/msg/LaserScan", header=header, **(scan | instead))
        self._send("/bumper", "std_msgs/msg/Bool", data=bool(now["bumped"]))
        nav = {"x": float(now["nav_speed_mps"])}, {"z": float(now["nav_yaw_rate_radps"])}
        self._send("/cmd_vel_nav", "geometry_msgs/msg/Twist", linear=nav[0], angular=nav[1])
        if env.navigation.plan_number[0] != self._plan:
            self._plan = int(env.navigation.plan_number[0])
            goal_x, goal_y = env.navigation.goals_m[0].tolist()
            pose = {"position": {"x": goal_x, "y": goal_y}}
            self._send("/goal_pose", "geometry_msgs/msg/PoseStamped", header=header, pose=pose)
            points = [
                build("geometry_msgs/msg/PoseStamped", pose={"position": {"x": px, "y": py}})
                for px, py in env.navigation.plans_m[0].tolist()
            ]
            self._send("/plan", "nav_msgs/msg/Path", header=header, poses=points)

    def drive(self) -> bool:
        """Drive a control period by the last command; whether the episode has ended."""
        _, _, terminated, truncated, self.info = self.env.step(self.command)
        return bool(terminated[0] | truncated[0])

    def _send(self, topic: str, kind: str, **fields: Any) -> None:
        self.graph.send(topic, build(kind, **fields))


def graph_qos() -> Any:
    from support.ros_graph import Durability, QoS, Reliability

    return QoS(1, Reliability.BEST_EFFORT, Durability.VOLATILE)


def follower_onnx(path: Path, profile: Profile, **metadata: str) -> Path:
    """Return an exported policy that takes the task's action nearest to navigation's proposal."""
    import onnx

    task = profile.task
    scaled = task.scaled_actions
    weight = np.zeros((task.observation_size, len(task.actions)), np.float32)
    weight[-2:] = 2 * scaled.T
    bias = -(scaled**2).sum(axis=1).astype(np.float32)
    helper, kinds = onnx.helper, onnx.TensorProto
    model = helper.make_model(
        helper.make_graph(
            [
                helper.make_node("Gemm", ["observation", "weight", "bias"], ["values"]),
                helper.make_node("ArgMax", ["values"], ["action"], axis=1, keepdims=0),
            ],
            "policy",
            [helper.make_tensor_value_info("observation", kinds.FLOAT, ["N", len(weight)])],
            [
                helper.make_tensor_value_info("values", kinds.FLOAT, ["N", len(scaled)]),
                helper.make_tensor_value_info("action", kinds.INT64, ["N"]),
            ],
            [
                onnx.numpy_helper.from_array(weight, "weight"),
                onnx.numpy_helper.from_array(bias, "bias"),
            ],
        ),
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=8,
    )
    metadata |= {
        "format": FORMAT,
        "task_hash": task.hash,
        "observation": msgspec.json.encode(task.observation_names).decode(),
        "actions": msgspec.json.encode(task.actions).decode(),
        "profile": profile.name,
        "profile_toml": profile_toml(profile),
        "run": "follower",
        "version": "1",
    }
    helper.set_model_props(model, metadata)
    path.write_bytes(with_digest(model.SerializeToString()))
    return path
