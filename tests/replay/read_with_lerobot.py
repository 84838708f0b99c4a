"""Read an export with the real lerobot and print what it finds: run by test_export.py."""

import importlib.machinery
import json
import os
import sys
import types
from typing import ClassVar

import numpy as np
import PIL.Image
import torch

os.environ["HF_HUB_OFFLINE"] = "1"


class Absent(types.ModuleType):
    """Stub for torchvision, which only transforms images here, if it cannot be loaded."""

    __path__: ClassVar[list[str]] = []

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__module__": self.__name__})


class ToTensor:
    """Stub for torchvision's ToTensor: an image as (C, H, W), scaled to 0..1."""

    def __call__(self, picture: "PIL.Image.Image") -> "torch.Tensor":
        values = torch.from_numpy(np.array(picture))
        values = values[None] if values.ndim == 2 else values.permute(2, 0, 1)
        return values.float() / 255


try:
    import torchvision  # noqa: F401
except (ImportError, RuntimeError):  # its wheels want a torch with CUDA
    for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
        del sys.modules[name]
    for name in ("", ".transforms", ".transforms.v2", ".transforms.v2.functional", ".io"):
        sys.modules["torchvision" + name] = module = Absent("torchvision" + name)
        module.__spec__ = importlib.machinery.ModuleSpec(module.__name__, None)
    transforms = sys.modules["torchvision.transforms"]
    transforms.ToTensor = ToTensor  # type: ignore[attr-defined]
    sys.modules["torchvision"].transforms = transforms  # type: ignore[attr-defined]

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

dataset = LeRobotDataset("restock/logs", root=sys.argv[1])
frames = [dataset[index] for index in range(len(dataset))]
few = LeRobotDataset(
    "restock/logs",
    root=sys.argv[1],
    episodes=[min(1, dataset.num_episodes - 1)],
    delta_timestamps={"action": [0.0, 1 / dataset.fps]},
)
found = {
    "episodes": dataset.num_episodes,
    "fps": dataset.fps,
    "mean_reward": float(dataset.meta.stats["next.reward"]["mean"][0]),
    "lengths": [int(length) for length in dataset.meta.episodes["length"]],
    "episode": [int(frame["episode_index"]) for frame in frames],
    "action": [frame["action"].tolist() for frame in frames],
    "reward": [float(frame["next.reward"]) for frame in frames],
    "first": [float(frame["observation.state"][0]) for frame in frames],
    "next_first": [float(frame["next.observation.state"][0]) for frame in frames],
    "terminated": [bool(frame["next.terminated"]) for frame in frames],
    "truncated": [bool(frame["next.truncated"]) for frame in frames],
    "transition_id": [int(frame["restock.transition_id"]) for frame in frames],
    "condition": [frame["restock.condition"] for frame in frames],
    "chunk": few[0]["action"].tolist(),
    "images": {
        key: {
            "shape": list(frames[0][key].shape),
            "corner": [frame[key][:, 0, -1].tolist() for frame in frames],
            "mean": dataset.meta.stats[key]["mean"].reshape(-1).tolist(),
        }
        for key in dataset.meta.camera_keys
    },
}
sys.stdout.write("\n" + json.dumps(found) + "\n")
