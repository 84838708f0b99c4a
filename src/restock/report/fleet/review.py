"""The server of the review page.

It listens on loopback only. Every request must contain the token of the address and name this
machine as its host; a POST must also have the page's origin. Several browsers and servers may work
on one store: each answer to a POST contains the verdicts that others have given since.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import sys
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

import jinja2
import msgspec
from markupsafe import Markup

from restock.errors import LabelError, RestockError
from restock.ingest.store.location import TRANSITIONS, Location
from restock.replay.review.events import page_events
from restock.replay.review.journal import Entry, Journal, Written, write_verdicts
from restock.replay.review.moments import Moments
from restock.replay.review.verdicts import CONDITIONS, check
from restock.replay.store.store import Store
from restock.report.look.blocks import dark_rules, palette


def page_data(store: Store) -> dict[str, Any]:
    """Return the data of the page: a store's events, most doubtful first, and its conditions."""
    events, total = page_events(store)
    rows = store.connection.sql(CONDITIONS).fetchall()
    names = sorted({name for *_, own in rows for name in own})
    return {
        "store": str(store.path),
        "events": events,
        "total": total,
        "conditions": {recording: sorted(own) for _, recording, own in rows},
        "colours": palette(names),
    }


def review_html(data: dict[str, Any]) -> tuple[str, str]:
    """Return the page, and a Content-Security-Policy that allows only its own script and server."""
    folder = files("restock.report.look")
    script, style, own, text = (
        (folder / name).read_text(encoding="utf-8")
        for name in ("review.js", "style.css", "review.css", "review.html.jinja")
    )
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none';"
        f" form-action 'none'; connect-src 'self'; script-src 'sha256-{digest}'"
    )
    document = json.dumps(data, separators=(",", ":"), allow_nan=False)
    # Escaped, so that no name in it can end the element or begin another.
    document = document.replace("&", r"\u0026").replace("<", r"\u003c").replace(">", r"\u003e")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    html = environment.from_string(text).render(
        policy=policy,
        style=Markup(style.replace("/* dark figures */", dark_rules()) + own),
        page=Markup(document),
        script=Markup(script),
    )
    return html, policy


PORT = 7474  # used if it is free, so that an SSH tunnel can be set up in advance
HOSTS = ("127.0.0.1", "localhost")
NOTHING = "default-src 'none'"  # Content-Security-Policy of JSON answers
MAX_BODY_BYTES = 256 << 10


class Review:
    """A review of one store: its events and the verdicts on them."""

    def __init__(self, place: Location) -> None:
        self.place = place
        self.journal = Journal(place)
        self.store = Store(place)
        self.data = page_data(self.store)
        self.moments = Moments(self.store)
        self._now = self.store  # newest version: verdicts are checked against it
        self._lock = threading.RLock()  # store and journal are not thread-safe

    def close(self) -> None:
        for store in {self.store, self._now}:
            store.close()

    def moment(self, place: int) -> dict[str, Any]:
        with self._lock:
            return self.moments.show(self._event(place))

    def frames(self, place: int) -> dict[str, Any]:
        with self._lock:
            return self.moments.frames(self._event(place))

    def _event(self, place: int) -> dict[str, Any]:
        events = self.data["events"]
        if not 0 <= place < len(events):
            raise LabelError(f"there is no event {place}")
        event: dict[str, Any] = events[place]
        return event

    def state(self) -> dict[str, Any]:
        """Read the journal again and return its lines."""
        with self._lock:
            self.journal.refresh()
            return {"lines": msgspec.to_builtins(self.journal.lines)}

    def give(self, entries: list[Entry]) -> None:
        """Append verdicts to the journal: they are on disk when this returns.

        Raises:
            LabelError: one does not fit the rows of the newest version; none is appended.
        """
        with self._lock:
            given = [one for one in entries if one.verdict]
            problems = check(enumerate(given), self._newest()).problems
            if problems:
                raise LabelError("; ".join(problems[place] for place in sorted(problems)))
            self.journal.append([msgspec.structs.replace(one, at="") for one in entries])

    def write(self) -> Written:
        """Write verdicts into the store, except those replaced, taken back or already written."""
        with self._lock:
            return write_verdicts(self.journal, self.place)

    def _newest(self) -> Store:
        """Return the newest version, opened only if it changed: opening takes most of a second."""
        if self.place.open_table(TRANSITIONS).version() != self._now.version:
            if self._now is not self.store:
                self._now.close()
            self._now = Store(self.place)
        return self._now


class _Post(msgspec.Struct):
    """The body of a POST."""

    entries: list[Entry] = []  # new verdicts


class Server(ThreadingHTTPServer):
    """The server of a review. `address` is the URL to open in a browser."""

    daemon_threads = True

    def __init__(self, review: Review, say: Callable[[str], None]) -> None:
        self.review, self.say = review, say
        self.token = secrets.token_urlsafe(18)
        try:
            super().__init__(("127.0.0.1", PORT), Handler)
        except OSError:
            super().__init__(("127.0.0.1", 0), Handler)
            say(f"port {PORT} is in use: this review has port {self.server_port}")

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore lost connections to a browser; report any other error."""
        error = sys.exc_info()[1]
        if not isinstance(error, ConnectionError | TimeoutError):
            self.say(f"a request failed: {error!r}")


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of the review page."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "restock", ""
    timeout = 30

    def log_message(self, *_: object) -> None:
        """Log nothing: every line would contain the token."""

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _answer(self, answer: Callable[[str], None]) -> None:
        """Answer a request from the review page; refuse any other."""
        parts = urlsplit(self.path)
        token, _, path = parts.path.removeprefix("/").partition("/")
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        if host.rpartition(":")[0] not in HOSTS:
            self._refuse("the review answers this machine only")
        elif not hmac.compare_digest(token.encode("utf-8", "replace"), self.server.token.encode()):
            self._refuse("the address lacks the token that `restock review` printed")
        elif (origin is None and self.command == "POST") or origin not in (None, f"http://{host}"):
            self._refuse("the request is not from the review page")
        else:
            try:
                answer(path)
            except (RestockError, OSError) as error:
                if isinstance(error, ConnectionError):
                    raise
                self._send(409, json.dumps({"error": str(error)}))

    def _refuse(self, why: str) -> None:
        self.close_connection = True  # the unread body would be taken for the next request
        self._send(403, json.dumps({"error": why}))

    def _get(self, path: str) -> None:
        review = self.server.review
        kind, _, place = path.partition("/")
        if path == "":
            html, policy = review_html(review.data)
            self._send(200, html, "text/html", policy)
        elif kind in ("moment", "frames") and place.isdecimal() and len(place) < 9:
            shown = review.moment if kind == "moment" else review.frames
            self._send(200, json.dumps(shown(int(place)), allow_nan=False))
        else:
            self._send(404, json.dumps({"error": "there is nothing here"}))

    def _post(self, path: str) -> None:
        review, size = self.server.review, self.headers.get("Content-Length", "")
        if not size.isdecimal() or int(size) > MAX_BODY_BYTES:
            self.close_connection = True
            self._send(413, json.dumps({"error": "the request is too large"}))
            return
        body = self.rfile.read(int(size))
        try:
            posted = msgspec.json.decode(body, type=_Post)
        except msgspec.MsgspecError as error:
            self._send(400, json.dumps({"error": f"the request is malformed: {error}"}))
            return
        if path == "verdicts":
            review.give(posted.entries)
        elif path == "write":
            written = review.write()
            self._send(200, json.dumps(written.document | review.state(), default=str))
            return
        elif path != "state":
            self._send(404, json.dumps({"error": "there is nothing here"}))
            return
        self._send(200, json.dumps(review.state()))

    def _send(
        self, status: int, text: str, kind: str = "application/json", policy: str | None = None
    ) -> None:
        body = text.encode()
        self.send_response(status)
        for name, value in {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": f"{policy or NOTHING}; frame-ancestors 'none'",
            "Cache-Control": "no-store",
            "Referrer-Policy": "same-origin",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
        }.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
