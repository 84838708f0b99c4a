"""The review page: its HTML, with a server behind it or as one file that holds all it shows."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from restock.errors import RestockError
from restock.files import write_text
from restock.replay.review.events import page_events
from restock.replay.review.moments import Moments
from restock.replay.review.verdicts import CONDITIONS
from restock.replay.store.store import Store
from restock.report.look.theme import dark_rules, palette

IN_A_FILE = 300  # events of a page without a server: the first of each order, half and half


def page_data(store: Store) -> dict[str, Any]:
    """Return what a page knows of the events of a store, the most doubtful first."""
    events, total, novelty = page_events(store)
    rows = store.connection.sql(CONDITIONS).fetchall()
    names = sorted({name for *_, own in rows for name in own})
    return {
        "store": str(store.path),
        "events": events,
        "total": total,
        "novelty": novelty,
        "conditions": {recording: sorted(own) for _, recording, own in rows},
        "colours": palette(names),
        "online": True,
        "id": hashlib.blake2b(
            json.dumps([str(store.path), [event["event"] for event in events]]).encode(),
            digest_size=6,
        ).hexdigest(),
    }


def review_html(data: dict[str, Any]) -> tuple[str, str]:
    """Return the page, and the policy that lets it run its own script and ask its own server."""
    folder = files("restock.report.look")
    script, style, own, text = (
        (folder / name).read_text(encoding="utf-8")
        for name in ("review.js", "style.css", "review.css", "review.html.jinja")
    )
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    own_server = "'self'" if data["online"] else "'none'"
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none';"
        f" form-action 'none'; connect-src {own_server}; script-src 'sha256-{digest}'"
    )
    document = json.dumps(data, separators=(",", ":"), allow_nan=False)
    # No name in it ends the element, or begins another.
    document = document.replace("&", r"\u0026").replace("<", r"\u003c").replace(">", r"\u003e")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    html = environment.from_string(text).render(
        policy=policy,
        style=Markup(style.replace("/* dark figures */", dark_rules()) + own),
        page=Markup(document),
        script=Markup(script),
    )
    return html, policy


def write_review_page(store: Store, out: Path) -> dict[str, Any]:
    """Write a page that opens without a server; return how many events it has, and notes."""
    data = page_data(store)
    chosen = first_of_orders(data["events"], IN_A_FILE)
    moments, notes = {}, []
    show = Moments(store)
    for event in sorted(chosen, key=lambda one: (one["recording"], one["doubt"])):
        try:
            moments[event["event"]] = show.show(event) | {"frames": show.frames(event)}
        except RestockError as error:
            notes.append(f"{event['event']} is left out: {error}")
    kept = [event for event in chosen if event["event"] in moments]
    html, _ = review_html(data | {"events": kept, "moments": moments, "online": False})
    write_text(out, html)
    notes += sorted({note for one in moments.values() for note in one["notes"]})
    return {"page": str(out), "events": len(kept), "of": data["total"], "notes": notes}


def first_of_orders(events: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """Return the most doubtful events, and as many of the random order, by doubt."""
    labelled = sorted(
        (event for event in events if event["random"] is not None), key=lambda e: e["random"]
    )
    half = {event["event"] for event in (*events[: count // 2], *labelled[: count // 2])}
    return [event for event in events if event["event"] in half or len(events) <= count]
