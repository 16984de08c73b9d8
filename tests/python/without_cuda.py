#!/usr/bin/env python3
"""Takes out of PyTorch of PyPI what only a GPU runs: 3 GB that no test calls.

    ENVIRONMENT/bin/python tests/python/without_cuda.py

PyPI has PyTorch for x86-64 Linux only with CUDA, and the loader wants every library and every function of it when `torch`
is imported. One empty library replaces CUDA's. Each function of it fails with "no device", so that PyTorch finds no GPU;
only those that it calls while it is loaded (`__cudaRegisterFatBinary`) do nothing. The GPU's code in PyTorch's own
libraries becomes a hole, which takes no room on the disk; its headers and its programs go, but for the one it looks for.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

PREFIXES = ("libcu", "libnv", "libnccl", "cu", "nccl", "nvshmem", "NVSHMEM")
"""Of the names of CUDA's libraries, of their versions, and of their functions without a version."""
NO_DEVICE = 100
"""`cudaErrorNoDevice`."""


def readelf(option: str, library: Path) -> list[list[str]]:
    done = subprocess.run(["readelf", "--wide", option, library], capture_output=True, text=True, check=True)
    return [line.split() for line in done.stdout.splitlines()]


def symbols(library: Path) -> tuple[set[str], set[str]]:
    """Symbols that a library defines (names), and those that it needs from others (`name` or `name@version`)."""
    rows = [row for row in readelf("--dyn-syms", library) if len(row) >= 8 and row[4] in ("GLOBAL", "WEAK")]
    has = {row[7].partition("@")[0] for row in rows if row[6] != "UND"}
    return has, {row[7] for row in rows if row[6] == "UND" and row[4] == "GLOBAL"}


def without_gpu_code(library: Path) -> None:
    """Makes a hole of the section that has the code of GPUs."""
    for row in readelf("--section-headers", library):
        if ".nv_fatbin" in row:
            offset, size = row[row.index(".nv_fatbin") + 3 :][:2]
            punch = ["fallocate", "--punch-hole", "--offset", f"0x{offset}", "--length", f"0x{size}", library]
            # A file system without holes keeps the code: only the room is lost.
            subprocess.run(punch, check=False)


def main() -> int:
    lib = Path(sysconfig.get_paths()["platlib"]) / "torch" / "lib"
    stub = lib / "libwithout_cuda.so"
    libraries = sorted({path for path in lib.glob("*.so*") if not path.is_symlink()} - {stub})
    both = [symbols(library) for library in libraries]
    there = set().union(*(has for has, _ in both))
    # The loader asserts that a library has the versions that its users name.
    stubs: dict[str, set[str]] = {}
    for symbol in set().union(*(needed for _, needed in both)):
        name, _, version = symbol.partition("@")
        if name not in there and (version or name).startswith(PREFIXES):
            stubs.setdefault(version, set()).add(name)
    wanted = {row[-1].strip("[]") for library in libraries for row in readelf("--dynamic", library) if "(NEEDED)" in row}
    wanted = {name for name in wanted if name.startswith(PREFIXES)}
    if not wanted:
        return 0
    names = sorted(set().union(*stubs.values()))
    source = "".join(f"long {name}(void) {{ return {0 if name.startswith('__') else NO_DEVICE}; }}\n" for name in names)
    script = "".join(f'{v} {{ global: {"; ".join(sorted(n))}; }};\n' for v, n in sorted(stubs.items()) if v)
    with tempfile.NamedTemporaryFile("w", suffix=".map") as versions:
        versions.write(script)
        versions.flush()
        link = ["gcc", "-shared", "-fPIC", "-w", "-x", "c", "-", f"-Wl,--version-script={versions.name}", "-o", stub]
        subprocess.run(link, input=source, text=True, check=True)
    for name in wanted:
        (lib / name).unlink(missing_ok=True)
        (lib / name).symlink_to(stub.name)
    for library in libraries:
        without_gpu_code(library)
    shutil.rmtree(lib.parent / "include", ignore_errors=True)
    for program in (lib.parent / "bin").glob("*"):
        if program.name != "torch_shm_manager":
            program.unlink()
    print(f"{len(wanted)} libraries of CUDA with {len(names)} functions are replaced")
    return subprocess.run([sys.executable, "-c", "import torch; assert torch.ones(2).sum() == 2"], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
