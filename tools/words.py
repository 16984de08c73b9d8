#!/usr/bin/env python3
"""Holds help texts, documents, configuration comments and documentation comments to the project's glossary: the field's words, no
private ones. Prints each place with the word to use, and exits with 1 if there is one.

usage: tools/words.py [ROOT]
"""

import re
import sys
from pathlib import Path

WORDS = [  # pattern, what to write
    (r"pictures?", "image, frame"),
    (r"(?<!hand-)(?<!hand )eyes?(?!-in-hand|-to-hand|-hand)", "left/right image, left/right camera"),
    (r"motion units?|units? of motion|samples? of motion", "IMU, IMU sample"),
    (r"back ends?", "backend"),
    (r"patience|patient", "timeout, deadline"),
    (r"crews?", "workers, worker pool"),
    (r"entrances?|(?<!docking )stations?|houses?|keeps? house", "queue, worker, housekeeping"),
    (r"in flight|flights?(?<!of-flight)(?<!of flight)", "transfer, submitted"),
    (r"is no (?!longer|such)[a-z]+|are no [a-z]+ (?:of|that)|is none|are none|cannot be(?=[.,;:]| and | or |$)", "invalid X, unsupported X, out of range A..=B"),
    (r"tells?|told|telling", "reports, prints, returns, logs"),
    (r"gave way|gives way|passed over|passes over", "skipped, superseded, dropped"),
    (r"not whole|is whole|are whole|made whole", "complete, incomplete, damaged"),
    (r"that is meant|is meant", "selected, to use"),
    (r"when it may|if they may|when they may", "if permitted"),
]
PATTERN = re.compile("|".join(rf"(?P<w{i}>\b(?:{p})\b)" for i, (p, _) in enumerate(WORDS)), re.IGNORECASE)
OPENING = re.compile(r"^\s*//[/!] What\b")
DOCUMENTED = re.compile(r"^\s*//[/!](.*)")
APART = ("LICENSE", "NOTICE", "CHANGELOG.md")


def lines(path: Path):
    """The lines of a file that people read as text: number, line, text."""
    fenced = False
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if path.suffix == ".rs":
            if match := DOCUMENTED.match(line):
                yield number, line, match[1]
        elif path.suffix == ".md":
            fenced ^= line.startswith("```")
            if not fenced:
                yield number, line, line
        elif "#" in line:
            yield number, line, line.split("#", 1)[1]


def findings(root: Path):
    """Path, line number, word found and words to use."""
    for path in sorted(p for ending in ("rs", "md", "toml") for p in root.rglob(f"*.{ending}")):
        name = path.relative_to(root)
        if name.parts[0] in ("target", "demo-data", "dist") or any(p.startswith(".") or p == "node_modules" for p in name.parts[:-1]):
            continue
        if name.name.startswith(APART):
            continue
        for number, line, text in lines(path):
            if OPENING.match(line):
                yield name, number, "What", "a noun for a thing, a verb for an action"
            spoken = re.sub(r"`[^`]*`|\[[^\]]*\]\([^)]*\)", "", text)
            for match in PATTERN.finditer(spoken):
                yield name, number, match.group(), WORDS[int(match.lastgroup[1:])][1]


def main() -> int:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent.parent
    found = list(findings(root))
    for name, number, word, instead in found:
        print(f"{name}:{number}: {word!r}: write {instead}")
    if found:
        print(f"{len(found)} places are not in the project's words (the glossary is WORDS in tools/words.py)")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
