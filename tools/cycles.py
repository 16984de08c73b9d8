#!/usr/bin/env python3
"""Finds import cycles between the files of each Rust crate; `make lint` runs it.

usage: cycles.py [ROOT] [--edges]      exit 1 if a cycle was found

A file imports another when it names a path into it (`crate::a::b`, `super::x`, `use` lists), through re-exports to the file
that defines the name. A module and its own submodules may import each other. Test modules (`tests.rs`, `tests/`,
`#[cfg(test)] mod tests` to the end of the file) are left out. It reads text, not types: a path made by a macro is not seen.
"""

import os
import re
import sys
from pathlib import Path

PATH = re.compile(r"\b((?:crate|super|self)(?:::\w+)+)")
USE = re.compile(r"\b(pub(?:\([^)]*\))?\s+)?use\s+([^;]+);")


def expand(tree: str) -> list[tuple[str, str]]:
    """`a::{b, c as d}` as [(path, name it gets)]."""
    tree = " ".join(tree.split())
    out: list[tuple[str, str]] = []

    def walk(prefix: str, text: str) -> None:
        depth, part, parts = 0, "", []
        for ch in text:
            depth += (ch == "{") - (ch == "}")
            if ch == "," and depth == 0:
                parts.append(part)
                part = ""
            else:
                part += ch
        for p in [*parts, part]:
            p = p.strip()
            if not p:
                continue
            if "{" in p:
                head, rest = p.split("{", 1)
                walk(prefix + head.strip(), rest.rsplit("}", 1)[0])
            else:
                path, _, alias = p.partition(" as ")
                full = (prefix + path.strip()).removesuffix("::self")
                out.append((full, alias.strip() or full.rsplit("::", 1)[-1]))

    walk("", tree)
    return out


def strip(text: str) -> str:
    text = re.sub(r"//[^\n]*", "", text)
    return re.split(r"#\[cfg\(test\)\]\s*mod tests\s*[{;]", text)[0]


def crate_graph(src: Path) -> tuple[dict[str, set[str]], dict[str, Path]]:
    files: dict[str, Path] = {}
    for f in sorted(src.rglob("*.rs")):
        rel = f.relative_to(src).with_suffix("")
        if "tests" in rel.parts or rel.name in ("tests", "main"):
            continue
        parts = [p for p in rel.parts if p not in ("lib", "mod")]
        files["::".join(["crate", *parts])] = f
    text = {m: strip(f.read_text()) for m, f in files.items()}

    def absolute(module: str, path: str) -> str:
        here, words = module.split("::"), path.split("::")
        if words[0] == "crate":
            return path
        if words[0] == "self":
            words = words[1:]
        while words and words[0] == "super":
            here, words = here[:-1], words[1:]
        return "::".join([*here, *words])

    exports: dict[str, dict[str, str]] = {m: {} for m in files}
    uses: dict[str, list[str]] = {m: [] for m in files}
    for m, t in text.items():
        children = {c.rsplit("::", 1)[-1] for c in files if c.rsplit("::", 1)[0] == m}
        for public, tree in USE.findall(t):
            for path, name in expand(tree):
                first = path.split("::")[0]
                if first in children and first not in ("crate", "super", "self"):
                    path = "self::" + path
                if path.split("::")[0] in ("crate", "super", "self"):
                    full = absolute(m, path)
                    uses[m].append(full)
                    if public:
                        exports[m][name] = full
        uses[m] += [absolute(m, p) for p in PATH.findall(USE.sub("", t))]

    def resolve(path: str, depth: int = 0) -> str | None:
        words = path.split("::")
        for cut in range(len(words), 0, -1):
            m = "::".join(words[:cut])
            if m in files:
                if cut < len(words) and depth < 8:
                    target = exports[m].get(words[cut])
                    if target and target != path:
                        return resolve("::".join([target, *words[cut + 1 :]]), depth + 1)
                return m
        return None

    graph: dict[str, set[str]] = {m: set() for m in files}
    for m, paths in uses.items():
        for p in paths:
            to = resolve(p)
            if to and to != m and to != "crate" and not to.startswith(m + "::") and not m.startswith(to + "::"):
                graph[m].add(to)
    return graph, files


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one file (Tarjan)."""
    sys.setrecursionlimit(10_000)
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(v: str) -> None:
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in graph[v]:
            if w not in index:
                visit(w)
                low[v] = min(low[v], low[w])
            elif w in stack:
                low[v] = min(low[v], index[w])
        if low[v] == index[v]:
            part = []
            while True:
                part.append(stack.pop())
                if part[-1] == v:
                    break
            if len(part) > 1:
                found.append(sorted(part))

    for v in graph:
        if v not in index:
            visit(v)
    return found


def sources(root: Path) -> list[Path]:
    """The `src` folder of each crate below `root`."""
    found = []
    for folder, folders, files in os.walk(root):
        folders[:] = [f for f in folders if f not in ("target", "node_modules") and not f.startswith(".")]
        if "Cargo.toml" in files and "src" in folders:
            found.append(Path(folder) / "src")
    return sorted(found)


def main() -> int:
    root = Path(next((a for a in sys.argv[1:] if not a.startswith("-")), "."))
    bad = 0
    for src in sources(root):
        graph, files = crate_graph(src)
        for part in sorted(cycles(graph), key=len, reverse=True):
            bad += 1
            print(f"{src.relative_to(root)}: {len(part)} files")
            for m in part:
                inside = sorted(graph[m] & set(part))
                print("   ", files[m].relative_to(src), *(["->", *inside] if "--edges" in sys.argv else []))
    if bad:
        print(f"{bad} import cycles; --edges prints the imports. Move what both sides need into a file below them.")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
