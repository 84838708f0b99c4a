"""`restock mix`: makes a pinned replay panel with quotas per stratum."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from restock.cli import output
from restock.cli.words import Option, Positional
from restock.errors import MixtureError, counted

if TYPE_CHECKING:
    from restock.replay.plan.plan import PanelPlan
    from restock.replay.plan.strata import Stratum

_UNCERTAIN = {
    "drop": "they are left out",
    "keep": "their labels count as they are",
    "nominal": "it does not count as held",
}
TRAINING = 51_500, 128  # default updates of `restock train`, and rows per update
_WIDE = 110  # a terminal with at least this width gets more columns


@dataclass
class MixCommand:
    """Make a pinned replay panel: the transitions that a run samples, and their shares.

    Applies a mixture to a store and packs the chosen transitions into one memory-mapped file. The
    plan shows for each stratum its share of the store's rows (natural), the share of a batch that
    is wanted, its share of the logged rows drawn and of their gradient after importance weights,
    how often each of its rows will be replayed, and how many rows are missing. Importance weights
    that give a stratum a smaller share than it has in the logs are refused. A panel never changes;
    its id is a hash of store version, mixture, task and rows.
    """

    store: Annotated[str, Positional("STORE")]
    """The store to take rows from, or a Parquet file with rows of any task (docs/panel.md)."""
    mixture: Annotated[str, Option("NAME|FILE")] = "coverage"
    """A TOML file, or one of coverage and uniform. See docs/mixture.md."""
    out: Annotated[Path | None, Option("PANEL")] = None
    """The new panel's directory. It must not exist yet."""
    dry_run: bool = False
    """Only show the plan; write nothing."""
    force: bool = False
    """Replace an existing panel."""
    json: bool = False
    """Print the plan as one JSON document."""

    def run(self) -> None:
        """Plan the panel, and write it unless this is a dry run."""
        from restock.replay.mixture.mixture import load_mixture
        from restock.replay.panel.build import check_free, open_source, write_panel

        if self.out is None and not self.dry_run:
            raise MixtureError("no --out given", remedy="give --out PANEL, or --dry-run")
        if self.out is not None and not self.dry_run:
            check_free(self.out, self.force)
        mixture = load_mixture(self.mixture)
        folder = Path(self.mixture).parent
        with open_source(self.store, mixture, folder=folder) as source:
            with output.progress("planning", None):
                plan = source.plan(mixture)
            document = describe(plan) | {"store_version": source.version, "mixture": self.mixture}
            read_by = source.profiles(plan.task_hash)
            document["profiles"] = [{"name": p.name, "hash": p.hash} for p in read_by]
            if self.out is not None and not self.dry_run:
                with output.progress("packing", len(plan.rows)) as advance:
                    panel = write_panel(
                        source, plan, self.out, force=self.force, advance=lambda n: advance(n)
                    )
                document |= {"panel": str(self.out), "id": panel.id}
        for warning in document["warnings"]:
            output.say(f"warning: {warning}")
        if self.json:
            output.print_json(document)
            return
        wide = output.table_width() >= _WIDE
        output.print_table(
            _table(document["strata"], wide=wide),
            title=self.mixture,
        )
        for line in _summary(document):
            output.print_text(line)


def describe(plan: PanelPlan) -> dict[str, Any]:
    """Return the plan as `--json` prints it."""
    return {
        "strata": [_stratum_row(stratum) for stratum in plan.strata],
        "rows": len(plan.panel_rows),
        "left_out": plan.left_out,
        "evaluation_split": {
            "by": plan.split_by,
            "rows": int(plan.evaluation_split.sum()),
            "note": plan.split_note,
        },
        "uncertain_rows": plan.uncertain_rows,
        "uncertain": plan.mixture.uncertain,
        "logs_share": plan.logs_share,
        "logs_share_wanted": plan.logs_share_wanted,
        "effective_rows": plan.effective_rows,
        "largest_weight": float(plan.weight.max(initial=0.0)),
        "density_ratios": [asdict(fit) for fit in plan.ratios],
        "other_stores": [msgspec.structs.asdict(store) for store in plan.others],
        "represents": {
            name: rates
            for name, rates in plan.mixture.sources.represented.items()
            if plan.mixture.sources.chosen(name)
        },
        "warnings": list(plan.warnings),
        "planned_draws": plan.mixture.planned_draws,
        "max_replays_per_row": plan.mixture.max_replays_per_row,
        "task_hash": plan.task_hash,
        "n_step": plan.mixture.n_step,
        "discount": plan.mixture.discount,
    }


def _stratum_row(stratum: Stratum) -> dict[str, Any]:
    values = msgspec.structs.asdict(stratum)
    return {"stratum": values.pop("name"), **values}


def _table(strata: list[dict[str, Any]], *, wide: bool) -> list[dict[str, Any]]:
    """Return the rows of the table with as many columns as fit; shares are in percent."""
    rows = []
    missing = any(line["missing_rows"] for line in strata)
    for line in strata:
        row = {"stratum": line["stratum"], "rows": line["rows"]}
        if wide:
            row["episodes"] = line["episodes"]
        row |= {
            "natural: %\nof rows": _percent(line["natural_share"]),
            "wanted: %\nof a batch": _percent(line["wanted_share"]),
            "drawn: % of\nlogged rows": _percent(line["share"]),
            "% of their\ngradient": _percent(line["effective_share"]),
            "replays\na row": line["replays_per_row"],
        }
        if missing:
            row["missing\nrows"] = line["missing_rows"]
        if wide:
            row |= {
                "effective\nrows": round(line["effective_rows"]),
                "largest\nweight": line["largest_weight"],
                "weights": f"{line['correction']} ({line['timing']})",
            }
        rows.append(row)
    return rows


def _percent(share: float) -> float:
    return round(100 * share, 2)


def _describe_missing(line: dict[str, Any]) -> str:
    """Say how many more rows would fill a stratum; empty if it is full."""
    if not line["missing_rows"]:
        return ""
    return f"; {counted(line['missing_rows'], 'more row')} would fill it"


def _describe_training(document: dict[str, Any], most: float) -> list[str]:
    """Warn of strata whose logged rows cannot fill their quota at the default training budget."""
    updates, batch_size = TRAINING
    short = []
    for line in document["strata"]:
        requested = line["wanted_share"] * document["logs_share_wanted"]
        bears = most * line["rows"] / (updates * batch_size)
        if bears < 0.98 * requested:
            short.append(f"{line['stratum']} {bears:.1%} of {requested:.1%}")
    lines = [f"no row is drawn more than {most:g} times (max_replays_per_row)"]
    if short:
        lines.append(
            f"warning: at the default training budget ({updates:,} updates of {batch_size:,} rows),"
            f" logged rows cannot fill their share of a batch: {', '.join(short)};"
            " the twin's fresh rows fill the rest of each quota, and a learner without a twin falls"
            " short (`restock train --dry-run`)"
        )
    return lines


def _summary(document: dict[str, Any]) -> list[str]:
    strata = document["strata"]
    lines = [
        f"{line['stratum']}: {line['note']}{_describe_missing(line)}"
        for line in strata
        if line["note"]
    ]
    if any(line["missing_rows"] for line in strata):
        lines.append("`restock coverage gaps` shows how much driving that takes")
    if document["logs_share"] < document["logs_share_wanted"] - 1e-9:
        lines.append(
            f"logged rows fill {document['logs_share']:.1%} of a batch, not"
            f" {document['logs_share_wanted']:.1%} ([sources]): there are not enough; drawn shares"
            " are of the logged rows drawn"
        )
    for fit in document["density_ratios"]:
        lines.append(
            f"density ratio of {', '.join(fit['strata'])} ({fit['source']}): fitted on"
            f" {fit['rows']:,} rows, log loss {fit['log_loss']:.3f} against"
            f" {fit['base_log_loss']:.3f} of a constant prediction"
        )
    others = "".join(
        f", and of {store['name']} ({store['path']}) version {store['version']}"
        for store in document["other_stores"]
    )
    left_out = ", ".join(f"{count:,} {reason}" for reason, count in document["left_out"].items())
    draws = [
        f"these numbers are for {document['planned_draws']:,} draws of logged rows (set "
        "planned_draws to those of your training); a run plans with its own number"
    ]
    if (most := document["max_replays_per_row"]) is not None:
        draws += _describe_training(document, most)
    version = document["store_version"]
    source = "the table" if version < 0 else f"store version {version}"
    lines += [
        *draws,
        f"{document['rows']:,} rows of {source}{others}; not in the panel: {left_out or 'none'}",
        f"{document['logs_share']:.1%} of a batch from the logs, worth"
        f" {document['effective_rows']:,.0f} equally weighted rows; largest weight"
        f" {document['largest_weight']:.3g}",
    ]
    if (held := document["evaluation_split"])["note"]:
        rows = f" ({held['rows']:,} rows)" if held["rows"] else ""
        lines.append(f"held out: {held['note']}{rows}")
    for name, rates in document["represents"].items():
        of = "the main store's" if rates == "archive" else "given"
        lines.append(f"the rows of {name} are a selection: their natural shares are {of}")
    if len(read_by := [f"{p['name']} {p['hash']}" for p in document["profiles"]]) > 1:
        lines.append(
            f"profiles of this task: {', '.join(read_by)}; the panel carries {read_by[0]}, that "
            "of the newest ingest"
        )
    if document["uncertain_rows"]:
        lines.append(
            f"{document['uncertain_rows']:,} rows have an uncertain condition: "
            f"{_UNCERTAIN[document['uncertain']]}"
        )
    rules = dict.fromkeys(line["within"] for line in document["strata"])
    of_rule = {
        rule: [line["stratum"] for line in document["strata"] if line["within"] == rule]
        for rule in rules
    }
    drawn = [rule if len(rules) == 1 else f"{rule} ({', '.join(of_rule[rule])})" for rule in rules]
    lines.append(f"within a stratum: {'; '.join(drawn)}")
    if "id" in document:
        lines.append(f"panel {document['id']} -> {document['panel']}")
    else:
        lines.append("dry run: nothing was written")
    return lines
