"""Reference pages, generated from what the program itself says: its help, rig files, API description and metrics."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
GLOBAL = re.compile(r"^Global options:\n(?:[ \t].*\n|\n)*", re.MULTILINE)
LISTED = re.compile(r"^  ([a-z][a-z0-9-]*)  ", re.MULTILINE)


def output(binary: Path, *arguments: str) -> str:
    """What the program prints."""
    return subprocess.run([binary, *arguments], capture_output=True, text=True, timeout=60, check=True).stdout


@dataclass
class Command:
    """A command of the program, with its help."""

    name: str
    """With the names of the commands above it: `depthrig record start`."""
    help: str
    inner: list[Command] = field(default_factory=list)

    @property
    def about(self) -> str:
        return self.help.split("\n", 1)[0]

    def all(self) -> list[Command]:
        """Itself and every command below it."""
        return [self, *(c for inner in self.inner for c in inner.all())]


def command(binary: Path, *names: str) -> Command:
    """A command and those below it, read from `--help`."""
    text = output(binary, *names, "--help")
    listed = re.search(r"^Commands:\n((?: .*\n)+)", text, re.MULTILINE)
    inner = [n for n in LISTED.findall(listed[1]) if n != "help"] if listed else []
    return Command(" ".join(["depthrig", *names]), text, [command(binary, *names, name) for name in inner])


def fenced(text: str, language: str = "text") -> str:
    return f"````{language}\n{text.strip()}\n````\n"


def commands(root: Command) -> dict[str, str]:
    """A page for each command, and one for all of them. Options that every command has are on that one alone."""
    shared = GLOBAL.search(root.help)
    pages = {
        "commands.md": f"# Commands\n\nPrinted by `depthrig --help`. `depthrig man` writes the same as manual pages.\n\n"
        + "".join(f"- [`{c.name}`](commands/{slug(c)}.md): {c.about}\n" for c in root.inner)
        + f"\n## depthrig\n\n{fenced(root.help)}"
    }
    for top in root.inner:
        text = ""
        for one in top.all():
            own = GLOBAL.sub("", one.help.partition("\n")[2]) if shared else one.help
            text += f"{'#' if one is top else '##'} {one.name}\n\n{one.about}.\n\n{fenced(own)}\n"
        pages[f"commands/{slug(top)}.md"] = text + "Options that every command has: [depthrig](../commands.md#depthrig).\n"
    return pages


def slug(command: Command) -> str:
    return command.name.removeprefix("depthrig ").replace(" ", "-")


def rig_file(binary: Path) -> str:
    return (
        "# Rig file\n\nEvery key of a rig file, with its default. `depthrig config show` prints the first file, "
        "`depthrig config show paper` the second; `depthrig config check RIG.toml` lists every problem of yours with its line.\n\n"
        f"## Default: simulated cameras\n\n{fenced(output(binary, 'config', 'show'), 'toml')}\n"
        f"## Seven real cameras\n\n{fenced(output(binary, 'config', 'show', 'paper'), 'toml')}"
    )


def metrics() -> str:
    """The table of metrics, from the sample that the daemon's own test compares with."""
    golden = (ROOT / "daemon/src/metrics/golden.txt").read_text()
    kinds = dict(re.findall(r"^# TYPE (\S+) (\S+)$", golden, re.MULTILINE))
    rows = []
    for name, text in re.findall(r"^# HELP (\S+) (.*)$", golden, re.MULTILINE):
        sample = re.search(rf"^{name}(?:_total|_bucket)?{{([^}}]*)}}", golden, re.MULTILINE)
        labels = [label for label in re.findall(r'(\w+)="', sample[1]) if label != "le"] if sample else []
        rows.append([f"`{name}`", kinds[name], ", ".join(f"`{label}`" for label in labels), text])
    return (
        "# Metrics\n\n`GET /metrics` on the rig's socket or loopback port, in the OpenMetrics format. A counter's samples end in `_total`.\n\n"
        + table(["metric", "kind", "labels", "meaning"], rows)
    )


def api() -> str:
    """The HTTP API, from its OpenAPI document."""
    document = json.loads((ROOT / "daemon/src/api/openapi.json").read_text())
    server = document["servers"][0]
    text = f"# HTTP API\n\n{plain(document['info']['description'])}\n\n{plain(server['description'])}\n\n"
    text += "`GET /v1/openapi.json` returns the document that this page is made from.\n\n"
    for path, methods in document["paths"].items():
        for method, call in methods.items():
            # A heading that ends in braces would lose them: they are attributes there.
            shown = path.replace("{", "&#123;").replace("}", "&#125;")
            text += f"## {method.upper()} {shown}\n\n{plain(call['summary'] + ' ' + call.get('description', ''))}\n\n"
            if body := call.get("requestBody"):
                text += f"Body: {content(body)}\n\n"
            replies = [[f"`{code}`", plain(r["description"]), content(r)] for code, r in sorted(call["responses"].items())]
            text += table(["status", "meaning", "body"], replies) + "\n"
    text += "# Types\n\n"
    for name, schema in document["components"]["schemas"].items():
        text += f"## {name}\n\n{plain(schema.get('description', ''))}\n\n"
        if "properties" in schema:
            required = schema.get("required", [])
            rows = [
                [f"`{key}`" + ("" if key in required else " (optional)"), kind(value), plain(value.get("description", ""))]
                for key, value in schema["properties"].items()
            ]
            text += table(["key", "type", "meaning"], rows) + "\n"
        else:
            text += f"{kind(schema)}\n\n"
    return text


def content(part: dict[str, Any]) -> str:
    """Types of a body."""
    return "; ".join(f"{kind(c.get('schema', {}))} as `{mime}`" for mime, c in part.get("content", {}).items())


def kind(schema: dict[str, Any]) -> str:
    """A type of the document in a few words."""
    if reference := schema.get("$ref"):
        name = reference.rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if options := schema.get("anyOf") or schema.get("oneOf"):
        return " or ".join(kind(option) for option in options)
    if values := schema.get("enum"):
        return ", ".join(f"`{json.dumps(v)}`" for v in values)
    names = schema.get("type", "any")
    names = [names] if isinstance(names, str) else names
    if "array" in names and "items" in schema:
        names = [f"array of {kind(schema['items'])}" if n == "array" else n for n in names]
    inner = schema.get("additionalProperties")
    if "object" in names and isinstance(inner, dict):
        names = [f"object of {kind(inner)}" if n == "object" else n for n in names]
    return " or ".join(names)


def plain(text: str) -> str:
    """Text as Markdown that has no tags."""
    return text.replace("<", "&lt;")


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *([cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def pages(binary: Path) -> dict[str, str]:
    """Every generated page: its path below `docs/reference`, and its text."""
    return {
        **commands(command(binary)),
        "rig-file.md": rig_file(binary),
        "api.md": api(),
        "metrics.md": metrics(),
    }
