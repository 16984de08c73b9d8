"""The guest's file system: an archive with the modules and busybox, cached, and one with the programs under test."""

import hashlib
import lzma
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from . import Broken
from .kernel import Kernel, call, locked

INIT = Path(__file__).parents[1] / "init"
# What scenarios may load with `system::modprobe`, and what init loads; each with what it depends on.
MODULES = (
    "virtio_pci virtio_net 9pnet_virtio 9p virtio_rng uvcvideo vivid vhci-hcd usbhid hid-generic hid-sensor-hub hid-sensor-accel-3d "
    "hid-sensor-gyro-3d usbmon".split()
)
FOLDERS = "bin dev etc lib lib64 proc root run share sys tmp var/tmp".split()


class Archive:
    """A cpio archive in the kernel's own form ("newc"; Linux Documentation/driver-api/early-userspace/buffer-format.rst)."""

    def __init__(self):
        self.parts = []
        self.names = set()

    def add(self, name: str, mode: int, content: bytes = b"", device: tuple[int, int] = (0, 0)):
        if name in self.names:
            return
        parent = os.path.dirname(name)
        if parent and parent not in self.names:
            self.folder(parent)
        self.names.add(name)
        fields = (len(self.names), mode, 0, 0, 1, 0, len(content), 0, 0, *device, len(name) + 1, 0)
        head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
        self.parts += [head, b"\0" * (-len(head) % 4), content, b"\0" * (-len(content) % 4)]

    def folder(self, name: str):
        self.add(name, 0o40755)

    def file(self, name: str, content: bytes, mode: int = 0o644):
        self.add(name, 0o100000 | mode, content)

    def link(self, name: str, target: str):
        self.add(name, 0o120777, target.encode())

    def program(self, source: Path, name: str):
        """A program with the libraries that `ldd` finds for it."""
        self.file(name, source.read_bytes(), 0o755)
        for library in libraries(source):
            self.file(str(library).lstrip("/"), library.read_bytes(), 0o755)

    def write(self, path: Path):
        self.add("TRAILER!!!", 0)
        path.write_bytes(b"".join(self.parts))


def libraries(program: Path) -> list[Path]:
    """The shared libraries and the loader of `program`, at the paths where the loader looks for them."""
    found = subprocess.run(["ldd", str(program)], capture_output=True, text=True).stdout
    if "not found" in found:
        raise Broken(f"{program.name} needs a library that is not here:\n{found}")
    words = [line.split("=>")[-1].split() for line in found.splitlines()]
    return [Path(w[0]) for w in words if w and w[0].startswith("/")]


def base(cache: Path, kernel: Kernel) -> Path:
    """The archive with init, busybox and the modules: made once for each kernel, busybox and version of this file."""
    busybox = Path(shutil.which("busybox"))
    key = hashlib.sha256(kernel.tree.name.encode())
    for part in (Path(__file__), INIT, busybox):
        key.update(part.read_bytes())
    path = cache / f"base-{key.hexdigest()[:16]}.cpio"
    with locked(cache):
        if path.exists():
            return path
        archive = Archive()
        for folder in FOLDERS:
            archive.folder(folder)
        archive.add("dev/console", 0o20600, device=(5, 1))
        archive.file("init", INIT.read_bytes(), 0o755)
        archive.program(busybox, "bin/busybox")
        for applet in call(busybox, "--list").split():
            archive.link(f"bin/{applet}", "busybox")
        add_modules(archive, kernel)
        with tempfile.TemporaryDirectory(dir=cache) as work:
            archive.write(Path(work) / "base")
            (Path(work) / "base").rename(path)
    return path


def add_modules(archive: Archive, kernel: Kernel):
    """The modules, unpacked so that the guest need not, and the tables that modprobe reads."""
    source = kernel.tree / "lib/modules" / kernel.release
    wanted = []
    for module in MODULES:
        shown = call("modprobe", "--dirname", kernel.tree, "--set-version", kernel.release, "--show-depends", module)
        wanted += [line.split()[1] for line in shown.splitlines() if line.startswith("insmod")]
    with tempfile.TemporaryDirectory() as work:
        made = Path(work) / "lib/modules" / kernel.release
        for module in dict.fromkeys(wanted):
            inside = Path(module).relative_to(source)
            content = Path(module).read_bytes()
            if inside.suffix == ".xz":
                inside, content = inside.with_suffix(""), lzma.decompress(content)
            elif inside.suffix != ".ko":
                raise Broken(f"modules are packed in a way that this rig does not know ({inside.name})")
            (made / inside).parent.mkdir(parents=True, exist_ok=True)
            (made / inside).write_bytes(content)
        for table in ("modules.builtin", "modules.builtin.modinfo", "modules.order"):
            shutil.copy(source / table, made)
        call("depmod", "--basedir", work, kernel.release)
        for file in sorted(made.rglob("*")):
            if file.is_file() and (file.suffix == ".ko" or file.name in ("modules.dep", "modules.alias", "modules.builtin")):
                archive.file(str(file.relative_to(work)), file.read_bytes())


def programs(path: Path, binaries: list[Path]):
    """The archive with the programs under test, at `path`. Debug information stays behind; names of functions do not."""
    archive = Archive()
    with tempfile.TemporaryDirectory() as work:
        for binary in binaries:
            stripped = Path(work) / binary.name
            call("objcopy", "--strip-debug", binary, stripped)
            archive.program(stripped, f"bin/{binary.name}")
    archive.write(path)
