"""A page: its text, that it fetches nothing and runs its own scripts alone, and its charts."""

import base64
import gzip
import hashlib
import json
import re
from html.parser import HTMLParser
from typing import Any


class _Scripts(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[dict[str, str | None], str]] = []
        self.policy = ""
        self.inside = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = dict(attributes)
        assert not [name for name in given if name.startswith("on")]
        self.inside = tag == "script"
        if self.inside:
            self.found.append((given, ""))
        if given.get("http-equiv") == "Content-Security-Policy":
            self.policy = given["content"] or ""

    def handle_endtag(self, tag: str) -> None:
        self.inside = False

    def handle_data(self, data: str) -> None:
        if self.inside:
            attributes, text = self.found[-1]
            self.found[-1] = attributes, text + data


def charts_of(html: str) -> dict[str, Any]:
    """Return a page's config, rows and charts; its policy lets only these scripts run."""
    page = _Scripts()
    page.feed(html)
    data, runtime, drawing = page.found
    assert data[0] == {"type": "application/json", "id": "charts"}
    assert runtime[0] == {"type": "text/plain", "id": "runtime"}
    assert drawing[0] == {}
    unpacked = gzip.decompress(base64.b64decode(runtime[1])).decode()
    digests = [hashlib.sha256(text.encode()).digest() for text in (drawing[1], unpacked)]
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    assert page.policy.endswith(f"script-src {hashes}")
    assert page.policy.startswith("default-src 'none'")
    found: dict[str, Any] = json.loads(data[1])
    numbers = [int(number) for number in re.findall(r'data-chart="(\d+)"', html)]
    assert numbers == list(range(len(found["charts"])))
    return found


class Page(HTMLParser):
    """A page's tags, what is fetched, and the text that is shown; its scripts are checked."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.fetched: list[str] = []
        self.text = ""
        self._hidden = False
        self.feed(html)
        assert "link" not in self.tags
        assert self.fetched == []
        assert "@import" not in html
        assert "url(http" not in html
        self.charts = charts_of(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._hidden = tag in ("style", "script")
        fetching = ("src", "href", "xlink:href", "srcset", "data")
        named = [value for name, value in attributes if name in fetching and value]
        self.fetched += [value for value in named if not value.startswith(("#", "data:"))]

    def handle_endtag(self, tag: str) -> None:
        self._hidden = False

    def handle_data(self, data: str) -> None:
        self.text += "" if self._hidden else " ".join(data.split()) + " "


__all__ = ["Page", "charts_of"]
