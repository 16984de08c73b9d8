#!/usr/bin/env python3
"""Writes NOTICE: the components of the program `depthrig` from cargo's dependency tree, with copyright lines and licences.

    tools/notice.py           write NOTICE
    tools/notice.py --check   exit 1 if NOTICE is not what would be written

A crate whose licence is a choice is taken under the first of `PREFERRED` that it offers.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOTICE = ROOT / "NOTICE"
PREFERRED = ["MIT", "Zlib", "ISC", "0BSD", "BSD-2-Clause", "BSD-3-Clause", "Apache-2.0"]
TARGETS = ["x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu"]
EMBEDDED = {"zstd-sys": ["BSD-3-Clause"]}
"""Licences of C code inside a crate that its own licence does not name."""
COPYRIGHT = re.compile(r"^[\s#*/]*(copyright\s+(?:\(c\)|©|\d{4}).*)$", re.IGNORECASE)
TEMPLATE = re.compile(r"\[yyyy\]|\{yyyy\}|<year>|name of copyright owner", re.IGNORECASE)
TITLES = {
    "MIT": r"Permission is hereby granted, free of charge.*?DEALINGS\s+IN THE\s+SOFTWARE\.",
    "ISC": r"Permission to use, copy, modify, and/?o?r? ?distribute this software.*?PERFORMANCE OF\s+THIS SOFTWARE\.",
    "BSD-2-Clause": r"Redistribution and use in source.*?(?=IN NO EVENT).*?SUCH DAMAGE\.",
    "BSD-3-Clause": r"Redistribution and use in source(?:(?!SUCH DAMAGE).)*?endorse or promote.*?SUCH\s+DAMAGE\.",
    "Zlib": r"This software is provided 'as-is'.*?from any source\s+distribution\.",
    "Unicode-3.0": r"UNICODE LICENSE V3.*?written authorization of the\s+copyright holder\.",
}
"""Where the text of a licence begins and ends in a crate's file."""
HEAD = """\
depthrig is licensed under MIT OR Apache-2.0 (LICENSE-MIT, LICENSE-APACHE).

This file is made by tools/notice.py and lists what the program `depthrig` contains and uses.

Libraries that are not part of the program
------------------------------------------
These are shared libraries of the system, or ones that the user installs; whoever has the program can replace them.

libusb 1.0 (libusb-1.0.so.0), LGPL-2.1-or-later, https://libusb.info: linked dynamically. Cameras are read through it where
the kernel's driver is not used.
GNU C library, LGPL-2.1-or-later: linked dynamically.
ONNX Runtime, MIT, https://onnxruntime.ai: loaded when a depth model runs; fetched by tools/onnxruntime.sh.
OpenH264, BSD-2-Clause, https://www.openh264.org: loaded when an SVO2 file is played.
Azure Kinect Sensor SDK (libk4a), MIT, and its depth engine, which is Microsoft's own: loaded when a Kinect is opened.

Crates in the program
---------------------
"""


def cargo(*arguments: str) -> str:
    return subprocess.run(["cargo", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def crates() -> list[dict]:
    """The packages that end up in the program, those that generate code at build time left out."""
    names = set()
    for target in TARGETS:
        edges = "normal,no-proc-macro"
        tree = cargo("tree", "--locked", "--package=depthrig", f"--edges={edges}", "--prefix=none", f"--target={target}")
        names |= {tuple(line.split()[:2]) for line in tree.splitlines() if line}
    packages = json.loads(cargo("metadata", "--locked", "--format-version=1"))["packages"]
    found = [p for p in packages if p["source"] and (p["name"], f"v{p['version']}") in names]
    return sorted(found, key=lambda p: (p["name"], p["version"]))


def choice(expression: str) -> list[str]:
    """The licences that a crate is taken under."""
    chosen = []
    for part in expression.replace("/", " OR ").split(" AND "):
        offered = [word.strip(" ()") for word in part.split(" OR ")]
        wanted = [name for name in PREFERRED if name in offered]
        chosen.append(wanted[0] if wanted else offered[0])
    return chosen


def licence_files(package: dict) -> list[Path]:
    """The licence files of a crate, and those of C code inside it."""
    folder = Path(package["manifest_path"]).parent
    names = ("license", "licence", "copying", "copyright", "notice", "unlicense")
    here = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name.lower().startswith(names)]
    plain = [p for p in here if p.suffix.lower() in ("", ".txt", ".md", ".html") or p.suffix[1:].isupper()]
    # zstd may be had under the GPL as well; it is not taken under it.
    return [p for p in plain if "GNU GENERAL PUBLIC LICENSE" not in p.read_text(errors="replace")]


def copyrights(files: list[Path]) -> list[str]:
    """Copyright lines, each once."""
    lines: dict[str, None] = {}
    for path in files:
        for line in path.read_text(errors="replace").splitlines():
            found = COPYRIGHT.match(line)
            if found and not TEMPLATE.search(line) and not re.search("copyright (notice|owner|holder|license)", line, re.I):
                lines[" ".join(found[1].split()).rstrip(",")] = None
    return list(lines)


def text() -> str:
    out = [HEAD]
    texts: dict[str, str] = {}
    used: set[str] = set()
    for package in crates():
        files = licence_files(package)
        licences = list(dict.fromkeys(choice(package["license"]) + EMBEDDED.get(package["name"], [])))
        used.update(licences)
        where = package.get("repository") or f"https://crates.io/crates/{package['name']}"
        out.append(f"{package['name']} {package['version']}: {' AND '.join(licences)}; {where}\n")
        lines = copyrights(files) or [f"Copyright by its authors: {', '.join(package['authors'])}"] * bool(package["authors"])
        out += [f"    {line}\n" for line in lines]
        for name, pattern in TITLES.items():
            for path in files if name in licences else []:
                if name not in texts and (found := re.search(pattern, path.read_text(errors="replace"), re.S)):
                    texts[name] = found[0]
    texts["Apache-2.0"] = (ROOT / "LICENSE-APACHE").read_text().strip()
    for name in sorted(used):
        if name in texts:
            out.append(f"\n{name}\n{'-' * len(name)}\n{texts[name]}\n")
        elif name == "0BSD":
            out.append("\n0BSD\n----\nPermission to use, copy, modify, and/or distribute this software for any purpose is hereby granted.\n")
        elif name == "IJG":
            out.append("\nIJG\n---\nThis software is based in part on the work of the Independent JPEG Group.\n")
        else:
            raise SystemExit(f"tools/notice.py has no text of {name}")
    return "\n".join(line.rstrip() for line in "".join(out).splitlines()) + "\n"


def main() -> int:
    generated = text()
    if sys.argv[1:] == ["--check"]:
        if NOTICE.exists() and NOTICE.read_text() == generated:
            return 0
        print("NOTICE is not that of the dependencies; write it with tools/notice.py", file=sys.stderr)
        return 1
    NOTICE.write_text(generated)
    return 0


if __name__ == "__main__":
    sys.exit(main())
