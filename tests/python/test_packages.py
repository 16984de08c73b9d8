"""What the wheel and the Debian package are made of (tools/dist): the parts that change with the rest of the tree.

`make test-dist` installs the packages themselves in clean systems; it takes a release build.
"""

from __future__ import annotations

import gzip
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
SAME_AS_IN_REPOSITORY = {
    "usr/lib/udev/rules.d/70-depthrig.rules": "tools/udev/70-depthrig.rules",
    "usr/lib/tmpfiles.d/depthrig.conf": "tools/tmpfiles/depthrig.conf",
    "usr/lib/systemd/user/depthrig.service": "tools/systemd/user/depthrig.service",
}
COMPLETIONS = {
    "bash": "usr/share/bash-completion/completions/depthrig",
    "zsh": "usr/share/zsh/vendor-completions/_depthrig",
    "fish": "usr/share/fish/vendor_completions.d/depthrig.fish",
}
PACKED = ["NOTICE", "changelog", "changelog.Debian"]


def project(file: str) -> dict[str, Any]:
    with (ROOT / file).open("rb") as text:
        return dict(tomllib.load(text)["project"])


@pytest.fixture(scope="module")
def binary() -> str:
    if "DEPTHRIG_BIN" not in os.environ:
        pytest.skip("DEPTHRIG_BIN is not set")
    return os.environ["DEPTHRIG_BIN"]


@pytest.fixture(scope="module")
def tree(binary: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the Debian package; `/bin/true` stands for the binary, which is large."""
    folder = tmp_path_factory.mktemp("deb") / "tree"
    asked = [ROOT / "tools/dist/deb.sh", "--tree", "/bin/true", binary, folder]
    # The folder may belong to another user, to whom git says nothing.
    subprocess.run(asked, check=True, env={**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}, timeout=120)
    return folder


def commands(binary: str) -> list[str]:
    said = subprocess.run([binary, "--help"], capture_output=True, text=True, check=True, timeout=60).stdout
    listed = said.partition("\nCommands:\n")[2].partition("\n\n")[0]
    return re.findall(r"^  ([a-z]+) ", listed, re.MULTILINE)


def test_the_wheel_with_the_binary_and_the_editable_package_are_one_project() -> None:
    whole = project("pyproject.toml")
    package = project("python/pyproject.toml")
    for key in ("name", "version", "requires-python", "dependencies", "classifiers"):
        assert whole[key] == package[key], key
    assert whole["license"] == package["license"]["text"]
    assert whole["optional-dependencies"] == package["optional-dependencies"]
    with (ROOT / "Cargo.toml").open("rb") as text:
        assert whole["version"] == tomllib.load(text)["workspace"]["package"]["version"]
    # LeRobot imports installed packages by their name.
    plugin = project("python/lerobot_camera_depthrig/pyproject.toml")
    assert (ROOT / "python/lerobot_camera_depthrig" / plugin["name"] / "__init__.py").exists()
    assert plugin["version"] == whole["version"]
    assert f"depthrig=={whole['version'].rpartition('.')[0]}.*" in plugin["dependencies"]


def test_the_debian_package_has_these_files_and_no_others(binary: str, tree: Path) -> None:
    files = {str(path.relative_to(tree)) for path in tree.rglob("*") if path.is_file()}
    pages = {name for name in files if name.startswith("usr/share/man/man1/depthrig")}
    for command in commands(binary):
        if command != "help":
            assert f"usr/share/man/man1/depthrig-{command}.1.gz" in pages, command
    assert "usr/share/man/man1/depthrig.1.gz" in pages
    documents = {f"usr/share/doc/depthrig/{name}.gz" for name in PACKED}
    documents |= {"usr/share/doc/depthrig/copyright", "usr/share/doc/depthrig/examples/rig.toml"}
    rest = {"usr/bin/depthrig", *SAME_AS_IN_REPOSITORY, *COMPLETIONS.values(), *documents}
    assert files - pages == rest
    for path in tree.rglob("*"):
        assert path.stat().st_mode & 0o777 == (0o755 if path.is_dir() or path.parent.name == "bin" else 0o644), path


def test_files_of_the_debian_package_are_those_of_the_repository(tree: Path) -> None:
    for packaged, source in SAME_AS_IN_REPOSITORY.items():
        assert (tree / packaged).read_bytes() == (ROOT / source).read_bytes(), packaged
    documents = tree / "usr/share/doc/depthrig"
    assert gzip.decompress((documents / "NOTICE.gz").read_bytes()) == (ROOT / "NOTICE").read_bytes()
    license_text = " ".join((ROOT / "LICENSE-MIT").read_text().split()).partition("authors ")[2]
    copyright_text = " ".join((documents / "copyright").read_text().split()).replace(" . ", " ")
    assert license_text in copyright_text


def test_completions_offer_every_command(binary: str, tree: Path) -> None:
    for shell, name in COMPLETIONS.items():
        text = (tree / name).read_text()
        for command in commands(binary):
            assert re.search(rf"\b{command}\b", text), f"{shell}: {command}"
    bash = f"""
        . {tree / COMPLETIONS["bash"]}
        COMP_WORDS=(depthrig ver)
        COMP_CWORD=1
        _depthrig depthrig ver depthrig
        echo "${{COMPREPLY[@]}}"
    """
    said = subprocess.run(["bash", "-c", bash], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.split() == ["verify"]


def test_install_sees_what_the_package_brought(binary: str, tree: Path) -> None:
    asked = [binary, "install", "--print", "--user", "robot", "--root", str(tree)]
    said = subprocess.run(asked, capture_output=True, text=True, check=True, timeout=60).stdout
    assert said.count("installed by the package") == 2, said


def test_systemd_finds_nothing_wrong_with_the_users_service(tree: Path, tmp_path: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd-analyze is not installed")
    unit = (tree / "usr/lib/systemd/user/depthrig.service").read_text()
    assert "ExecStart=/usr/bin/depthrig run" in unit
    # It looks whether the program is there.
    checked = tmp_path / "depthrig.service"
    checked.write_text(unit.replace("/usr/bin/depthrig", "/bin/true"))
    asked = [analyze, "--user", "--man=no", "verify", str(checked)]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    said = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=60, env=env)
    ours = [line for line in (said.stdout + said.stderr).splitlines() if "depthrig.service" in line]
    assert ours == [], ours


def test_scripts_of_the_packages_are_correct_shell() -> None:
    for script in (*ROOT.glob("tools/dist/*.sh"), *ROOT.glob("tests/dist/*.sh"), ROOT / "tests/dist/run"):
        subprocess.run(["bash", "-n", str(script)], check=True)
    for script in (ROOT / "tools/dist/debian/postinst", ROOT / "tools/dist/debian/postrm"):
        subprocess.run(["sh", "-n", str(script)], check=True)
