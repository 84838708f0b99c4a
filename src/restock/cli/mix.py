"""`restock mix`: a pinned replay panel with quotas per stratum."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from restock.errors import MixtureError

if TYPE_CHECKING:
    from restock.replay.plan import Plan


@dataclass
class Mix:
    """A pinned replay panel: which transitions a run is fed, in which shares.

    Works a mixture out against a store and packs the chosen transitions into one memory-mapped
    file. The plan says for each stratum what is there, what was wanted and what it got, how often
    each of its rows will be replayed, and what is left of its share after importance weights. A
    panel never changes; its id names the store version, the mixture, the task and the rows.
    """

    store: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store to take transitions from."""
    mixture: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "coverage"
    """A TOML file, or a shipped mixture: coverage or uniform. See docs/mixture.md."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PANEL")] = None
    """The panel's directory, which must not exist yet."""
    dry_run: bool = False
    """Only show the plan; write nothing."""
    force: bool = False
    """Replace a panel that is already there."""
    version: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Version of the store to take (the newest)."""
    json: bool = False
    """Print the plan as one JSON document."""

    def run(self) -> None:
        """Plan, and unless it is a dry run, pack."""
        from restock.cli import output
        from restock.replay.build import open_source, write_panel
        from restock.replay.mixture import load_mixture
        from restock.replay.plan import plan_panel
        from restock.replay.store import Store

        if self.out is None and not self.dry_run:
            raise MixtureError("no --out given", remedy="say where the panel goes, or --dry-run")
        mixture = load_mixture(self.mixture)
        folder = Path(self.mixture).parent
        with (
            Store(self.store, version=self.version) as store,
            open_source(store, mixture, folder=folder) as source,
        ):
            plan = plan_panel(source.connection, mixture, source.conditions, source.others)
            document = describe(plan) | {"store_version": store.version, "mixture": self.mixture}
            if self.out is not None and not self.dry_run:
                with output.progress("packing", len(plan.rows)) as advance:
                    panel = write_panel(
                        source, plan, self.out, force=self.force, advance=lambda n: advance(n)
                    )
                document |= {"panel": str(self.out), "id": panel.id}
        if self.json:
            output.print_json(document)
            return
        output.print_table(document["strata"], title=f"{self.mixture}: the logs' part of a batch")
        for line in _summary(document):
            output.stdout().print(line)


def describe(plan: Plan) -> dict[str, Any]:
    """The plan as a document: what `--json` prints."""
    return {
        "strata": [asdict(line) for line in plan.strata],
        "rows": len(plan.panel_rows),
        "left_out": plan.left_out,
        "logs_share": plan.logs_share,
        "effective_rows": plan.effective_rows,
        "task_hash": plan.task_hash,
        "n_step": plan.mixture.n_step,
        "discount": plan.mixture.discount,
    }


def _summary(document: dict[str, Any]) -> list[str]:
    left_out = ", ".join(f"{count:,} {reason}" for reason, count in document["left_out"].items())
    lines = [
        f"{document['rows']:,} rows of store version {document['store_version']}; not in the panel:"
        f" {left_out or 'none'}",
        f"{document['logs_share']:.1%} of a batch from the logs, which after shares and weights are"
        f" worth {document['effective_rows']:,.0f} rows drawn equally often",
    ]
    if "id" in document:
        lines.append(f"panel {document['id']} -> {document['panel']}")
    else:
        lines.append("dry run: nothing was written")
    return lines
