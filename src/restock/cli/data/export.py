"""`restock export`: writes transitions as a data set of another library, or a policy as ONNX."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from restock.cli import output
from restock.cli.words import Option, Positional, refuse
from restock.errors import RunError, counted
from restock.replay.export import FORMATS

TO = (*FORMATS, "onnx", "run")


@dataclass
class ExportCommand:
    """Write transitions as another library's data set, or a run's policy as an ONNX file.

    The rows of a query to a store, or of a panel, are put together into episodes: in order, with
    how each ended and the observation after its last step. If a query leaves out rows, an episode
    is cut where rows are missing and becomes several. The data set records its provenance: store
    version, query or panel, task, counts. See docs/libraries.md. The policy of a run is the best
    one that it kept; the task is in the file's metadata. See docs/deploy.md. A folder of runs
    becomes a run whose policy acts by the mean of their action values. See docs/train.md.
    """

    source: Annotated[Path, Positional("SOURCE")]
    """A store, or a panel whose store is there; for onnx, a run; for run, a folder of runs."""
    to: Annotated[str, Option(choices=TO)]
    """The format. minari and lerobot write directories, the others files (d3rlpy: .h5)."""
    out: Annotated[Path, Option("OUT")]
    """The file or directory to write, which must not exist yet."""
    panel: Annotated[Path | None, Positional("PANEL")] = None
    """Beside a store: a panel whose tables the query may use, as panel.rows and panel.strata."""
    query: Annotated[str | None, Option("SQL")] = None
    """An SQL query that selects transitions of a store, with all columns; for lerobot it may add
    a struct "observation.state" of chosen signals. Default: all transitions."""
    action: Literal["discrete", "continuous"] = "discrete"
    """The index of the task's action, or the logged command (m/s, rad/s)."""
    cameras: Annotated[str, Option("NAMES")] = "all"
    """From a store to lerobot: the cameras whose frames are exported, comma-separated, or all, or
    none. A step that lacks a frame of one of them is left out and counted."""
    json: bool = False
    """Print what was written as one JSON document."""

    def run(self) -> None:
        """Write the data set, policy or run, and print a summary."""
        if self.to == "onnx":
            refuse(
                self,
                ["query", "action", "cameras", "panel"],
                "applies only to a data set",
                remedy="leave it out: a policy has no rows",
            )
            from restock.train.evaluation.onnx_policy import export_onnx

            made = export_onnx(self.source, self.out)
            if self.json:
                output.print_json(made)
            else:
                output.print_text(
                    f"policy {made['version']} ({made['trained']}) of task {made['task_hash']}"
                    f" -> {made['path']}"
                    f" ({made['bytes']:,} bytes)"
                )
            return
        if self.to == "run":
            of_rows = ["query", "action", "cameras", "panel"]
            refuse(self, of_rows, "applies only to a data set", remedy="leave it out")
            self._write_mean()
            return
        from restock.replay.export.dataset import export_dataset

        with output.progress(f"writing {self.to}", None) as advance:
            document = export_dataset(
                self.source,
                self.to,
                self.out,
                query=self.query,
                panel=self.panel,
                continuous=self.action == "continuous",
                cameras=self._cameras(),
                advance=lambda steps: advance(steps),
            )
        if self.json:
            output.print_json(document)
            return
        for line in _summary(document):
            output.print_text(line)

    def _write_mean(self) -> None:
        from restock.replay.places import kind_beside
        from restock.train.evaluation.policies import write_mean

        runs = sorted(place for place in self.source.glob("*") if kind_beside(place) == "run")
        if len(runs) < 2:
            raise RunError(
                f"holds {counted(len(runs), 'run')}",
                where=str(self.source),
                remedy="give a folder of two runs or more that differ in their seeds",
            )
        made = write_mean(runs, self.out)
        if self.json:
            output.print_json({"path": str(self.out), "runs": [str(run) for run in runs]})
        else:
            output.print_text(f"{made.origin.text if made.origin else ''} -> {self.out}")

    def _cameras(self) -> list[str] | None:
        """Return the names of cameras, as `export_dataset` takes them; None: all cameras."""
        if self.cameras == "all":
            return None
        names = output.names_in(self.cameras)
        return [] if names == ["none"] else names


def _summary(document: dict[str, Any]) -> list[str]:
    left_out = ", ".join(f"{count:,} {reason}" for reason, count in document["left_out"].items())
    return [
        f"{document['transitions']:,} transitions of {document['rows']:,} rows -> "
        f"{document['path']} ({document['format']})"
        + (f"; left out: {left_out}" if left_out else ""),
        f"{document['trajectories']:,} trajectories of {document['episodes']:,} episodes:"
        f" {document['terminated']:,} terminated, {document['truncated']:,} truncated,"
        f" {document['cut']:,} cut where rows are missing",
        *document["notes"],
    ]
