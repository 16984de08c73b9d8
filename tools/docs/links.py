"""Links of the documents and of the built site: each target and each anchor exists, and the site loads nothing from elsewhere."""

from __future__ import annotations

import html.parser
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

MARKDOWN = re.compile(r"!?\[(?:[^\]\[]|\[[^\]]*\])*\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")
RAW = re.compile(r"<(?:img|a)\b[^>]*\b(?:src|href)=\"([^\"]+)\"")
HEADING = re.compile(r"^#{1,6}\s+(.*?)\s*#*$")
ATTRIBUTES = {"href", "src", "srcset", "action", "poster", "data"}


def prose(path: Path) -> Iterator[str]:
    """The lines of a document outside its code."""
    fence = ""
    for line in path.read_text().splitlines():
        opening = re.match(r"\s*(```+|~~~+)", line)
        if opening and not fence:
            fence = opening[1]
        elif opening and line.strip() == fence:
            fence = ""
        elif not fence:
            yield line


def links(path: Path) -> list[str]:
    """Targets of the links and images of a document."""
    text = re.sub(r"`[^`\n]*`", "``", "\n".join(prose(path)))
    return MARKDOWN.findall(text) + RAW.findall(text)


@cache
def anchors(path: Path) -> set[str]:
    """Anchors of a document's headings, as a Git host makes them."""
    found: set[str] = set()
    for line in prose(path):
        if heading := HEADING.match(line):
            text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading[1])
            name = re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")
            found.add(name if name not in found else f"{name}-{sum(n.startswith(name) for n in found)}")
    return found


def broken(path: Path, generated: set[Path]) -> Iterator[str]:
    """Links of a document that lead nowhere. `generated` are the pages that only the site has."""
    for link in links(path):
        url = urlsplit(link)
        if url.scheme or url.netloc:
            continue
        target = (path.parent / unquote(url.path)).resolve() if url.path else path
        if target in generated:
            continue
        if not target.exists():
            yield f"{link}: no such file"
        elif url.fragment and target.suffix == ".md" and url.fragment not in anchors(target):
            yield f"{link}: no such heading"


@dataclass
class Page(html.parser.HTMLParser):
    """Anchors and references of a page of the site."""

    path: Path
    ids: set[str] = field(default_factory=set)
    references: list[tuple[str, str]] = field(default_factory=list)
    """Tag and address."""

    def __post_init__(self) -> None:
        super().__init__()
        self.feed(self.path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.ids.add(value)
            elif name in ATTRIBUTES and value and tag != "base":
                self.references.append((tag, value))


def broken_site(site: Path) -> Iterator[str]:
    """References of a built site that lead nowhere or out of it; plain links may lead out."""
    pages = {path: Page(path) for path in sorted(site.rglob("*.html"))}
    for path, page in pages.items():
        for tag, reference in page.references:
            url = urlsplit(reference)
            if url.scheme in ("http", "https") or url.netloc:
                if tag != "a":
                    yield f"{path.relative_to(site)}: <{tag}> loads {reference} from elsewhere"
                continue
            if url.scheme or path.name == "404.html":  # whose addresses begin at the site's root
                continue
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            if target.is_dir():
                target /= "index.html"
            if not target.exists():
                yield f"{path.relative_to(site)}: {reference}: no such file"
            elif url.fragment and target in pages and unquote(url.fragment) not in pages[target].ids:
                yield f"{path.relative_to(site)}: {reference}: no such heading"
