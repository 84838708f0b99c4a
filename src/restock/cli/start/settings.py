"""What the stages share: the user's files, where what comes of them goes, and how it is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Settings:
    """What the stages share."""

    logs: tuple[str, ...]
    out: Path
    profile: Path | str | None = None  # None: the one of the robot that comes with Restock
    seconds: float = 150.0  # of training
    episodes: int = 20  # of evaluation, per kind, policy and perturbation
    kinds: tuple[str, ...] = ()  # of its missions; none: all that the floor has room for
    device: str = "cpu"
    mixture: str = "coverage"
    typestore: str | None = None
    definitions: Path | None = None
    salvage: bool = False
    tags: tuple[str, ...] = ()  # each KEY=VALUE
    map: Path | None = None
    further_floors: tuple[Path, ...] = ()  # of recordings in other frames than the first floor's
    train: tuple[str, ...] = ()  # further settings, each key=value

    @property
    def store(self) -> Path:
        return self.out / "store"

    @property
    def panel(self) -> Path:
        return self.out / "panel"

    @property
    def run(self) -> Path:
        return self.out / "run"

    @property
    def logs_alone(self) -> Path:
        """The run that never drives: what fine-tuning is compared with."""
        return self.out / "logs-alone"

    @property
    def uniform_panel(self) -> Path:
        return self.out / "panel-uniform"

    @property
    def uniform(self) -> Path:
        """The run that is fed the logs as they come."""
        return self.out / "fed-uniformly"

    @property
    def fitted(self) -> Path:
        return self.out / "fitted.toml"

    @property
    def floor(self) -> Path:
        return self.out / "floor.toml"

    @property
    def layouts(self) -> str:
        """All floors, as a run's config and evaluations take them."""
        return ",".join(map(str, (self.floor, *self.further_floors)))

    @property
    def of_each_kind(self) -> str:
        """How many episodes to evaluate on, as `restock eval --episodes` takes it."""
        counts = ",".join(f"{kind}={self.episodes}" for kind in self.kinds)
        return counts or str(self.episodes)

    @property
    def recordings(self) -> tuple[Path, ...]:
        """The user's files and folders."""
        return tuple(Path(path) for path in self.logs)

    @property
    def with_profile(self) -> list[str]:
        return [] if self.profile is None else ["--profile", str(self.profile)]

    @property
    def with_definitions(self) -> list[str]:
        """Where the definitions of a recording's types are that it does not carry itself."""
        distribution = [] if self.typestore is None else ["--typestore", self.typestore]
        folder = [] if self.definitions is None else ["--definitions", str(self.definitions)]
        return distribution + folder

    @property
    def reading(self) -> list[str]:
        """How recordings are read."""
        return self.with_definitions + ["--salvage"] * self.salvage

    @property
    def read(self) -> tuple[Path, ...]:
        """What is read of the user's wherever a recording is."""
        return (*self.recordings, *([] if self.definitions is None else [self.definitions]))

    @property
    def profile_file(self) -> tuple[Path, ...]:
        return own_file(self.profile)

    @property
    def mixture_file(self) -> tuple[Path, ...]:
        return own_file(self.mixture)


def own_file(name: Path | str | None) -> tuple[Path, ...]:
    """The file of this name, unless it is that of a shipped one."""
    return () if name is None or not Path(name).is_file() else (Path(name),)
