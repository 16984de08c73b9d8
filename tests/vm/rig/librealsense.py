"""Intel's own library for the guest: Debian's Python and the library's wheels as one more archive, made once."""

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from . import Broken, Missing
from .initramfs import Archive
from .kernel import locked

FOLDER = Path(__file__).parents[1] / "librealsense"
# What a scenario says that needs this.
NEED = "librealsense"
# The wheels are for this version; it is Debian 12's own.
PYTHON = Path("/usr/bin/python3.11")
LIBRARY = Path("/usr/lib/python3.11")
# Of no use to the probe, and two thirds of it.
UNUSED = set(
    "test idlelib tkinter ensurepip lib2to3 pydoc_data distutils turtledemo unittest sqlite3 asyncio multiprocessing venv "
    "dist-packages site-packages __pycache__ config-3.11-x86_64-linux-gnu".split()
)
# The wheels, each with the folder of the guest that it lies in.
WHEELS = {"d400": "opt/librealsense-d400", "l515": "opt/librealsense-l515"}


def provide(cache: Path, say) -> Path:
    """The archive; `Missing` says what it lacks on this computer."""
    if not PYTHON.exists():
        raise Missing(f"{PYTHON} is not there (Debian 12's python3.11): the wheels of pyrealsense2 are for it")
    key = hashlib.sha256()
    for part in (Path(__file__), PYTHON, *(FOLDER / f"{name}.txt" for name in WHEELS), FOLDER / "probe.py"):
        key.update(part.read_bytes())
    path = cache / f"librealsense-{key.hexdigest()[:16]}.cpio"
    wheels = {name: fetched(cache, name, say) for name in WHEELS}
    with locked(cache):
        if not path.exists():
            for old in cache.glob("librealsense-*.cpio"):
                old.unlink()
            with tempfile.TemporaryDirectory(dir=cache) as work:
                write(Path(work), wheels)
                (Path(work) / "archive").rename(path)
    return path


def fetched(cache: Path, name: str, say) -> Path:
    """The wheel that the file of requirements pins, by its checksum."""
    requirements = FOLDER / f"{name}.txt"
    folder = cache / f"wheel-{name}-{hashlib.sha256(requirements.read_bytes()).hexdigest()[:16]}"
    with locked(cache):
        if not folder.is_dir():
            say(f"fetching {requirements.read_text().split('--hash')[0].splitlines()[-1].strip()}")
            with tempfile.TemporaryDirectory(dir=cache) as work:
                command = [
                    sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps",
                    "--require-hashes", "--only-binary", ":all:", "--python-version", "3.11", "--platform", "manylinux1_x86_64",
                    "--dest", f"{work}/wheel", "--requirement", str(requirements),
                ]  # fmt: skip
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode:
                    said = (done.stderr.strip() or done.stdout.strip()).splitlines()
                    raise Missing(f"pip cannot fetch {requirements.name}: {said[-1] if said else 'no reason given'}")
                (Path(work) / "wheel").rename(folder)
    found = list(folder.glob("*.whl"))
    if len(found) != 1:
        raise Broken(f"{folder} has not one wheel in it: remove it")
    return found[0]


def write(work: Path, wheels: dict[str, Path]):
    """Writes the archive to `work`/archive."""
    archive = Archive()
    archive.program(PYTHON, "usr/bin/python3")
    for file in sorted(LIBRARY.rglob("*")):
        inside = file.relative_to(LIBRARY)
        if file.is_file() and not UNUSED.intersection(inside.parts):
            add(archive, file, str(file).lstrip("/"))
    for name, folder in WHEELS.items():
        tree = work / name
        with zipfile.ZipFile(wheels[name]) as wheel:
            wheel.extractall(tree)
        for file in sorted(tree.rglob("*")):
            inside = str(file.relative_to(tree))
            # The binding and the libraries beside it; without the tools and the bindings of other programs.
            if file.is_file() and not any(word in inside for word in (".dist-info", ".data/", ".debug", "dds", "pybackend", "pyrsutils")):
                add(archive, file, f"{folder}/{inside}")
        shutil.rmtree(tree)
    archive.file("opt/librealsense/probe.py", (FOLDER / "probe.py").read_bytes())
    archive.write(work / "archive")


def add(archive: Archive, file: Path, name: str):
    if ".so" in file.name:
        archive.program(file, name)
    else:
        archive.file(name, file.read_bytes())
