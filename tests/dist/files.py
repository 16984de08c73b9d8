"""What dist/ says about itself: checksums, metadata of the wheels, what the Debian packages need, and the lists of parts.

files.py DIST
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
import zipfile
from email.parser import HeaderParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

ROOT = Path(__file__).resolve().parents[2]
DEBIAN = {"x86_64": "amd64", "aarch64": "arm64"}
UBUNTU = {"libc6": "2.35", "libusb-1.0-0": "2:1.0.25"}
"""What Ubuntu 22.04 has of what the Debian package depends on; nothing else may be depended on."""
CRATE = re.compile(r"^(\S+) (\S+): .*; https?://", re.MULTILINE)


def crates(arch: str) -> set[str]:
    """Package URLs of the crates in the program for an architecture, of those that NOTICE lists for all of them."""
    listed = (ROOT / "NOTICE").read_text().partition("\nCrates in the program\n")[2]
    tree = ["cargo", "tree", "--locked", "--package=depthrig", "--edges=normal", "--prefix=none"]
    tree += [f"--target={arch}-unknown-linux-gnu"]
    asked = subprocess.run(tree, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    used = {(name, version) for name, version in re.findall(r"^(\S+) v(\S+)", asked, re.MULTILINE)}
    return {f"pkg:cargo/{name}@{version}" for name, version in CRATE.findall(listed) if (name, version) in used}


def check_sums(dist: Path) -> None:
    """Every file of the folder has its checksum; `sha256sum --check` compared them."""
    named = {line.partition("  ")[2] for line in (dist / "SHA256SUMS").read_text().splitlines()}
    assert named == {path.name for path in dist.iterdir()} - {"SHA256SUMS"}, named


def check_metadata(wheel: zipfile.ZipFile) -> None:
    """Name, version, dependencies and extras are those of pyproject.toml, and the program is there to be run."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    [name] = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
    metadata = HeaderParser().parsestr(wheel.read(name).decode())
    assert (metadata["Name"], metadata["Version"]) == (project["name"], project["version"])
    assert set(metadata.get_all("Provides-Extra")) == set(project["optional-dependencies"])
    needed = metadata.get_all("Requires-Dist")
    for extra, requirements in project["optional-dependencies"].items():
        told = [line for line in needed if re.search(rf"extra == ['\"]{extra}['\"]", line)]
        assert len(told) == len(requirements), (extra, told)
    assert len([line for line in needed if "extra ==" not in line]) == len(project["dependencies"])
    [program] = [info for info in wheel.infolist() if info.filename.endswith(".data/scripts/depthrig")]
    assert program.external_attr >> 16 & 0o777 == 0o755, oct(program.external_attr >> 16)
    [entries] = [name for name in wheel.namelist() if name.endswith(".dist-info/entry_points.txt")]
    package = tomllib.loads((ROOT / "python/pyproject.toml").read_text())["project"]
    told = dict(line.split(" = ") for line in wheel.read(entries).decode().splitlines()[1:])
    assert told == package["scripts"], told
    print(f"{Path(wheel.filename).name}: extras {', '.join(sorted(project['optional-dependencies']))}")


def check_depends(package: Path) -> None:
    """What the package depends on is in Ubuntu 22.04."""
    asked = ["dpkg-deb", "--field", package, "Depends"]
    depends = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    left = dict(UBUNTU)
    for name, version in re.findall(r"([^ ,]+) \(>= ([^)]+)\)", depends):
        subprocess.run(["dpkg", "--compare-versions", left.pop(name), "ge", version], check=True)
    assert not left and depends.count(",") == 1, depends
    print(f"{package.name}: {depends}")


def references(part: Any) -> list[str]:
    """The names of all components below a part of the list."""
    if isinstance(part, list):
        return [name for item in part for name in references(item)]
    if not isinstance(part, dict):
        return []
    own = [part["bom-ref"]] if "bom-ref" in part else []
    return own + [name for key, item in part.items() if key != "dependencies" for name in references(item)]


def check_parts(wheel: zipfile.ZipFile, listed: Path, arch: str) -> None:
    """The list is valid, has every crate of the program and libusb, refers to nothing that it lacks, and is in the wheel too."""
    text = listed.read_text()
    [inside] = [name for name in wheel.namelist() if "/sboms/" in name]
    assert wheel.read(inside).decode() == text
    sbom = json.loads(text)
    version = SchemaVersion.from_version(sbom["specVersion"])
    problem = JsonStrictValidator(version).validate_str(text)
    assert problem is None, problem
    urls = {unquote(part.get("purl", "").partition("?")[0]) for part in sbom["components"]}
    needed = crates(arch)
    assert len(needed) > 100
    assert not needed - urls, needed - urls
    assert any(url.startswith("pkg:generic/libusb@") for url in urls)
    names = references(sbom)
    assert len(names) == len(set(names)), "a component is listed twice"
    linked = {name for item in sbom["dependencies"] for name in (item["ref"], *item.get("dependsOn", []))}
    assert linked <= set(names), linked - set(names)
    assert re.findall(r"file:///(?!depthrig)[^\"]*", text) == []
    print(f"{listed.name}: CycloneDX {sbom['specVersion']}, {len(sbom['components'])} components, with {len(needed)} crates of NOTICE")


def main(dist: Path) -> None:
    """Checks the packages of every architecture in the folder."""
    check_sums(dist)
    for path in sorted(dist.glob("depthrig-*.whl")):
        arch = path.stem.rpartition("manylinux_2_34_")[2]
        with zipfile.ZipFile(path) as wheel:
            check_metadata(wheel)
            check_parts(wheel, next(dist.glob(f"depthrig-*-{arch}.cdx.json")), arch)
        check_depends(next(dist.glob(f"depthrig_*_{DEBIAN[arch]}.deb")))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
