#!/usr/bin/env python3
"""Checks the documents, and builds the site from them with mdBook.

usage: tools/docs/build.py check                         links, anchors, and that docs/SUMMARY.md has every document
       tools/docs/build.py site [OPTION...]              the site, then a check of its links

The pages of docs/SUMMARY.md and the files that they link to are copied to a folder as they lie in the repository, so that links
between them hold; the reference (docs/reference/, not in the repository) is generated from the program beside them.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import links
import reference

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SUMMARY = DOCS / "SUMMARY.md"
REFERENCE = DOCS / "reference"
GENERATED = {REFERENCE / name for name in ("commands.md", "rig-file.md", "api.md", "metrics.md")}
ENTRY = re.compile(r"^(\s*)(- )?\[([^\]]+)\]\(([^)]+)\)$")
SKIPPED = {"target", "node_modules", "dist", "demo-data"}


def documents() -> list[Path]:
    """Every document of the repository."""
    found = []
    for folder, folders, files in os.walk(ROOT):
        folders[:] = [f for f in folders if f not in SKIPPED and not f.startswith(".")]
        found += [Path(folder) / f for f in files if f.endswith(".md")]
    return sorted(found)


def summary() -> list[Path]:
    """The pages of the site, in order."""
    entries = (ENTRY.match(line) for line in SUMMARY.read_text().splitlines())
    return [(DOCS / entry[4]).resolve() for entry in entries if entry]


def problems() -> Iterator[str]:
    for path in documents():
        for problem in links.broken(path, GENERATED):
            yield f"{path.relative_to(ROOT)}: {problem}"
    pages = summary()
    for path in sorted(DOCS.rglob("*.md")):
        if path not in pages and path != SUMMARY and REFERENCE not in path.parents:
            yield f"docs/SUMMARY.md: {path.relative_to(DOCS)} is missing"
    for path in pages:
        if pages.count(path) > 1:
            yield f"docs/SUMMARY.md: {path.name} is there twice"


def stage(binary: Path, folder: Path) -> None:
    """Puts everything that mdBook reads into `folder`."""
    shutil.rmtree(folder, ignore_errors=True)
    source = folder / "src"
    pages = [page for page in summary() if page not in GENERATED]
    linked = {
        (page.parent / urlsplit(link).path).resolve()
        for page in pages
        for link in links.links(page)
        if not urlsplit(link).scheme and urlsplit(link).path
    }
    for path in {*pages, *linked} - GENERATED:
        if path.suffix == ".md" and path not in pages:
            raise SystemExit(f"docs/SUMMARY.md: {path.relative_to(ROOT)} is missing; a page of the site links to it")
        copy = source / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    generated = reference.pages(binary)
    for name, text in generated.items():
        copy = source / "docs/reference" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(text)
    (source / "SUMMARY.md").write_text("".join(staged_summary(generated)))
    shutil.copyfile(DOCS / "book.toml", folder / "book.toml")


def staged_summary(generated: dict[str, str]) -> Iterator[str]:
    """The summary with paths from the repository's root, and an entry for each command."""
    for line in SUMMARY.read_text().splitlines(keepends=True):
        entry = ENTRY.match(line.rstrip("\n"))
        if not entry:
            yield line
            continue
        indent, bullet, title, path = entry.groups()
        yield f"{indent}{bullet or ''}[{title}]({os.path.relpath(DOCS / path, ROOT)})\n"
        if path == "reference/commands.md":
            for name in sorted(n for n in generated if n.startswith("commands/")):
                yield f"{indent}  - [{Path(name).stem}](docs/reference/{name})\n"


def main() -> int:
    parser = argparse.ArgumentParser(usage=__doc__.partition("usage: ")[2].partition("\n\n")[0])
    parser.add_argument("do", choices=["check", "site"])
    parser.add_argument("--binary", type=Path, default=ROOT / "target/debug/depthrig", help="the program to document")
    parser.add_argument("--mdbook", default=ROOT / ".venv-docs/bin/mdbook", help="mdBook 0.5")
    parser.add_argument("--out", type=Path, default=ROOT / "target/book", help="folder of the site")
    asked = parser.parse_args()
    found = list(problems())
    if asked.do == "site" and not found:
        staged = asked.out.with_name(f"{asked.out.name}-sources").resolve()
        stage(asked.binary.resolve(), staged)
        shutil.rmtree(asked.out, ignore_errors=True)
        built = subprocess.run(
            [asked.mdbook, "build", staged, "--dest-dir", asked.out.resolve()], capture_output=True, text=True, check=False
        )
        found = [line for line in built.stderr.splitlines() if " INFO " not in line]
        if built.returncode == 0:
            found += links.broken_site(asked.out.resolve())
    print(*found, sep="\n", end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
