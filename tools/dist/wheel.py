#!/usr/bin/env python3
"""Finishes the wheel that maturin built: puts libusb beside the binary, adds the programs of the Python package, and takes this computer's paths out of the list of parts.

    tools/dist/wheel.py WHEEL LIBUSB-FOLDER OUT-FOLDER

Writes the wheel, the binary in it as `depthrig`, and the list of parts (CycloneDX) as `depthrig.cdx.json` to OUT-FOLDER.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIBUSB = "libusb-1.0.so.0"


def put_libusb(tree: Path, libusb: Path) -> None:
    """Adds the library where the binary looks for it: `lib/depthrig` beside `bin`."""
    data = next(tree.glob("*.data"))
    folder = data / "data" / "lib" / "depthrig"
    folder.mkdir(parents=True)
    shutil.copy(libusb / LIBUSB, folder / LIBUSB)
    licenses = next(tree.glob("*.dist-info")) / "licenses"
    licenses.mkdir(exist_ok=True)
    shutil.copy(libusb / "COPYING", licenses / "COPYING.libusb")


def put_programs(tree: Path) -> None:
    """Adds the programs of the Python package, which maturin refuses beside a binary."""
    scripts = tomllib.loads((ROOT / "python/pyproject.toml").read_text())["project"]["scripts"]
    lines = [f"{name} = {entry}\n" for name, entry in scripts.items()]
    (next(tree.glob("*.dist-info")) / "entry_points.txt").write_text("[console_scripts]\n" + "".join(lines))


def parts(tree: Path, libusb: Path) -> bytes:
    """The list of parts, with libusb, without this computer's folders and the time of the build."""
    [found] = tree.glob("*.dist-info/sboms/*.json")
    sbom = json.loads(found.read_text().replace(ROOT.as_uri(), "file:///depthrig"))
    sbom.pop("serialNumber", None)
    sbom["metadata"].pop("timestamp", None)
    version = next(
        line.split()[1] for line in (libusb / "libusb-1.0.pc").read_text().splitlines() if line.startswith("Version:")
    )
    component = {
        "type": "library",
        "bom-ref": f"pkg:generic/libusb@{version}",
        "name": "libusb",
        "version": version,
        "purl": f"pkg:generic/libusb@{version}",
        "licenses": [{"license": {"id": "LGPL-2.1-or-later"}}],
    }
    sbom["components"].append(component)
    text = json.dumps(sbom, indent=1, ensure_ascii=False) + "\n"
    found.write_text(text)
    return text.encode()


def main(wheel: Path, libusb: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        tool = [sys.executable, "-m", "wheel"]
        subprocess.run([*tool, "unpack", "--dest", work, str(wheel)], check=True)
        [tree] = Path(work).iterdir()
        put_libusb(tree, libusb)
        put_programs(tree)
        (out / "depthrig.cdx.json").write_bytes(parts(tree, libusb))
        [binary] = tree.glob("*.data/scripts/depthrig")
        shutil.copy(binary, out / "depthrig")
        subprocess.run([*tool, "pack", "--dest-dir", str(out), str(tree)], check=True)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    main(*map(Path, sys.argv[1:]))
