"""The pinned Debian kernel: fetched with the host's own package configuration, unpacked into the cache, ready to boot."""

import fcntl
import hashlib
import lzma
import shutil
import struct
import subprocess
import tempfile
import tomllib
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from . import Broken, Missing

PIN = Path(__file__).parents[1] / "kernel.toml"
KEYRING = "/usr/share/keyrings/debian-archive-keyring.gpg"


@dataclass(frozen=True)
class Kernel:
    """An unpacked kernel package."""

    tree: Path  # with vmlinux and lib/modules/RELEASE
    about: str
    pinned: bool

    @property
    def vmlinux(self) -> Path:
        return self.tree / "vmlinux"

    @property
    def release(self) -> str:
        return next((self.tree / "lib/modules").iterdir()).name


@contextmanager
def locked(cache: Path):
    """Only one process at a time changes the cache."""
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def provide(cache: Path, deb: Path | None, newest: bool, required: bool, mirror: str | None, say) -> Kernel:
    """The kernel to boot: of `deb`, the `newest` of the suite, or the pinned one."""
    pin = tomllib.loads(PIN.read_text())
    with locked(cache):
        if deb:
            return unpacked(cache, deb, sha256(deb), f"{deb.name}, given with --kernel", False, say)
        if newest:
            return newest_of(cache, pin, mirror, say)
        about = f"{pin['package']} {pin['version']}"
        if (tree := cache / f"kernel-{pin['sha256'][:16]}").is_dir():
            return Kernel(tree, about, True)
        with tempfile.TemporaryDirectory(dir=cache) as work:
            apt = Apt(Path(work), pin["suite"], mirror)
            if pin["version"] in apt.versions(pin["package"]):
                say(f"fetching {about} from {apt.mirror}")
                deb = apt.download(pin["package"], pin["version"])
                if (found := sha256(deb)) != pin["sha256"]:
                    raise Broken(f"{deb.name} has sha256 {found}, and not {pin['sha256']} as {PIN.name} says")
                return unpacked(cache, deb, pin["sha256"], about, True, say)
        gone = (
            f"{about} is no longer in {pin['suite']} at {apt.mirror}. "
            "Pin a newer one (tests/vm/run --newest-kernel prints it), or give a package of it with --kernel DEB "
            "(https://snapshot.debian.org/package/linux-signed-amd64/ keeps them all)"
        )
        if required:
            raise Broken(gone)
        say(f"NOTE: {gone}.")
        say("NOTE: going on with the newest kernel of that suite; what fails now may be the kernel's doing.")
        return newest_of(cache, pin, mirror, say)


def newest_of(cache: Path, pin: dict, mirror: str | None, say) -> Kernel:
    """The newest kernel of the pinned suite, whose pin is printed."""
    with tempfile.TemporaryDirectory(dir=cache) as work:
        apt = Apt(Path(work), pin["suite"], mirror)
        package, version = apt.newest()
        say(f"fetching {package} {version} from {apt.mirror}")
        deb = apt.download(package, version)
        digest = sha256(deb)
        for key, value in (("suite", pin["suite"]), ("package", package), ("version", version), ("sha256", digest)):
            say(f'  {key} = "{value}"')
        return unpacked(cache, deb, digest, f"{package} {version}", digest == pin["sha256"], say)


def unpacked(cache: Path, deb: Path, digest: str, about: str, pinned: bool, say) -> Kernel:
    """`deb` as a tree of the cache; complete or absent."""
    tree = cache / f"kernel-{digest[:16]}"
    if not tree.is_dir():
        say(f"unpacking {deb.name}")
        with tempfile.TemporaryDirectory(dir=cache) as work:
            made = Path(work) / "tree"
            call("dpkg-deb", "--extract", deb, made)
            if not (made / "lib").is_dir():  # a package of a system that has moved /lib below /usr
                shutil.move(made / "usr/lib", made / "lib")
            (made / "vmlinux").write_bytes(uncompressed(next((made / "boot").glob("vmlinuz-*")).read_bytes()))
            release = next((made / "lib/modules").iterdir()).name
            call("depmod", "--basedir", made, release)
            shutil.rmtree(made / "boot")
            made.rename(tree)
    return Kernel(tree, about, pinned)


def uncompressed(image: bytes) -> bytes:
    """The ELF file inside a bzImage. QEMU boots it directly (PVH), so that the guest need not decompress it."""
    # Linux Documentation/arch/x86/boot.rst: setup_sects at 0x1f1, payload_offset and payload_length at 0x248.
    start = ((image[0x1F1] or 4) + 1) * 512
    offset, length = struct.unpack_from("<II", image, 0x248)
    payload = image[start + offset : start + offset + length]
    if payload[:6] == b"\xfd7zXZ\0":
        elf = lzma.LZMADecompressor().decompress(payload)
    elif payload[:4] == b"\x28\xb5\x2f\xfd":  # the last four bytes are the unpacked length
        elf = subprocess.run(["zstd", "-qdc"], input=payload[:-4], stdout=subprocess.PIPE, check=True).stdout
    else:
        raise Broken(f"the kernel is packed in a way that this rig does not know ({payload[:6].hex()})")
    if elf[:4] != b"\x7fELF":
        raise Broken("the unpacked kernel is no ELF file")
    return elf


class Apt:
    """A view of one Debian suite below `work`, with the host's proxies and mirror. The host's own apt state stays as it is."""

    def __init__(self, work: Path, suite: str, mirror: str | None):
        self.work = work
        self.mirror = mirror or host_mirror()
        (work / "lists/partial").mkdir(parents=True)
        (work / "cache/archives/partial").mkdir(parents=True)
        (work / "sources.list").write_text(f"deb [signed-by={KEYRING}] {self.mirror} {suite} main\n")
        self.options = []
        for key, value in {
            "Dir::Etc::sourcelist": work / "sources.list",
            "Dir::Etc::sourceparts": "-",
            "Dir::State::lists": work / "lists",
            "Dir::Cache": work / "cache",
            "APT::Architecture": "amd64",
            "APT::Sandbox::User": "",  # the user _apt may not be able to write here
            "Acquire::Retries": "3",
        }.items():
            self.options += ["-o", f"{key}={value}"]
        try:
            self.call("apt-get", "--quiet=2", "update")
        except Broken as error:
            raise Missing(f"the kernel is not cached and {suite} of {self.mirror} cannot be read: {error}") from error

    def call(self, program: str, *arguments) -> str:
        return call(program, *self.options, *arguments, cwd=self.work)

    def versions(self, package: str) -> list[str]:
        lines = self.call("apt-cache", "madison", package).splitlines()
        return [line.split("|")[1].strip() for line in lines]

    def newest(self) -> tuple[str, str]:
        for line in self.call("apt-cache", "show", "--no-all-versions", "linux-image-amd64").splitlines():
            if line.startswith("Depends: "):
                package, _, version = line.removeprefix("Depends: ").split(",")[0].partition(" (= ")
                return package, version.rstrip(")")
        raise Broken("linux-image-amd64 depends on no kernel")

    def download(self, package: str, version: str) -> Path:
        self.call("apt-get", "--quiet=2", "download", f"{package}={version}")
        return next(self.work.glob(f"{package}_*.deb"))


def host_mirror() -> str:
    """The Debian archive that this computer's apt uses."""
    if not shutil.which("apt-get"):
        raise Missing("the kernel is not cached and there is no apt-get: give a Debian kernel package with --kernel DEB")
    for uri in call("apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages").splitlines():
        if uri.rstrip("/").endswith("/debian"):
            return uri
    raise Missing("apt is configured for no Debian archive: give one with --mirror URL, or a kernel with --kernel DEB")


def call(*arguments, cwd: Path | None = None) -> str:
    """The output of a program that must succeed."""
    done = subprocess.run([str(a) for a in arguments], cwd=cwd, capture_output=True, text=True)
    if done.returncode:
        raise Broken(f"{arguments[0]}: {(done.stderr or done.stdout).strip()}")
    return done.stdout
