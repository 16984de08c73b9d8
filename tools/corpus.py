#!/usr/bin/env python3
"""Unpacks and packs the inputs of the fuzz targets: fuzz/corpus/TARGET.zip holds those of TARGET, the folder beside it is for fuzzers.

usage: tools/corpus.py unpack|pack [TARGET...]    every target without one

An archive follows from its inputs alone: sorted, stored, without times.
"""

import sys
import zipfile
from pathlib import Path

CORPUS = Path(__file__).resolve().parent.parent / "fuzz" / "corpus"


def unpack(target: str) -> None:
    folder = CORPUS / target
    folder.mkdir(exist_ok=True)
    if not (CORPUS / f"{target}.zip").exists():
        print(f"{target}: no inputs yet")
        return
    with zipfile.ZipFile(CORPUS / f"{target}.zip") as archive:
        for name in archive.namelist():
            (folder / name).write_bytes(archive.read(name))


def pack(target: str) -> None:
    paths = sorted((CORPUS / target).iterdir())
    part = CORPUS / f".{target}.zip.part"
    with zipfile.ZipFile(part, "w") as archive:
        for path in paths:
            archive.writestr(zipfile.ZipInfo(path.name), path.read_bytes())
    part.rename(CORPUS / f"{target}.zip")
    print(f"{target}: {len(paths)} inputs, {sum(p.stat().st_size for p in paths)} bytes")


def main() -> int:
    actions = {"unpack": unpack, "pack": pack}
    if len(sys.argv) < 2 or sys.argv[1] not in actions:
        print(__doc__, file=sys.stderr)
        return 2
    action = actions[sys.argv[1]]
    known = CORPUS.glob("*.zip") if action is unpack else (p for p in CORPUS.iterdir() if p.is_dir())
    for target in sys.argv[2:] or sorted(p.stem for p in known):
        action(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
