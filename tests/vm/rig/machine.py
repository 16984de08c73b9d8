"""One boot of the virtual machine."""

import os
import signal
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

QEMU = "qemu-system-x86_64"
# Guest time is the number of instructions executed, one nanosecond each, and an idle guest jumps to its next timer:
# however busy the host is, the guest does not notice. One processor, because only one thread can count.
CLOCK = "-accel tcg,thread=single -icount shift=0,sleep=off -rtc clock=vm -smp 1".split()
# Where another computer is on the network: time passes as it does there.
REAL_TIME = "-accel tcg -rtc clock=host -smp 1".split()
# Without cx16 and la57: QEMU 7.2 has crashed an early boot after a cmpxchg16b. Without erms, fsrm and avx: with them
# the guest copies memory byte by byte, each byte emulated.
CPU = "-cpu max,-cx16,-la57,-erms,-fsrm,-avx".split()
# With norandmaps a program that is started again lies at the same addresses, and QEMU has translated it already.
COMMAND_LINE = (
    "console=ttyS0 quiet loglevel=1 log_buf_len=8M panic=-1 oops=panic mitigations=off tsc=reliable "
    "random.trust_cpu=on init_on_alloc=0 hardened_usercopy=off audit=0 lsm= nokaslr norandmaps cryptomgr.notests"
)


@dataclass
class Boot:
    """How a boot went."""

    ended: bool  # the guest reported all it had to, and powered off
    panicked: bool
    late: bool
    wall_s: float
    cpu_s: float  # of QEMU
    console: str = field(repr=False)


class Machine:
    """A virtual machine that is running."""

    def __init__(self, vmlinux: Path, archives: list[Path], share: Path, memory_mib: int, shell: bool = False, forward: str = ""):
        """With `forward`, such as `tcp:127.0.0.1:2222-:22`, it has a network and real time, and runs `script` of the shared folder."""
        initrd = share / "initrd"
        with initrd.open("wb") as out:  # the kernel unpacks archives that follow each other
            for archive in archives:
                out.write(archive.read_bytes())
        self.share = share
        self.initrd = initrd
        self.console = share / "console.log"
        self.started = time.monotonic()
        command = [
            QEMU, "-M", "q35", *(REAL_TIME if forward else CLOCK), *CPU, "-m", str(memory_mib),
            "-nodefaults", "-no-user-config", "-no-reboot", "-display", "none", "-serial", "stdio",
            "-kernel", vmlinux, "-initrd", initrd,
            "-append", COMMAND_LINE + (" depthrig.shell" if shell else "") + (" depthrig.script" if forward else ""),
            "-fsdev", f"local,id=share,path={share},security_model=none",
            "-device", "virtio-9p-pci,fsdev=share,mount_tag=share",
            *(["-netdev", f"user,id=net,hostfwd={forward}", "-device", "virtio-net-pci,netdev=net"] if forward else []),
        ]  # fmt: skip
        if shell:
            self.process = subprocess.Popen([str(part) for part in command])
        else:
            with self.console.open("wb") as console:
                self.process = subprocess.Popen(
                    [str(part) for part in command],
                    stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True,
                )  # fmt: skip

    def poll(self) -> bool:
        """Whether it has ended. Its processor time is known from then on."""
        if self.process.returncode is None:
            pid, status, usage = os.wait4(self.process.pid, os.WNOHANG)
            if pid:
                self.process.returncode = os.waitstatus_to_exitcode(status)
                self.cpu_s = usage.ru_utime + usage.ru_stime
                self.initrd.unlink(missing_ok=True)
        return self.process.returncode is not None

    def used_s(self) -> float:
        """The processor time it has used so far: unlike the time on the wall, the same on a busy host."""
        try:
            # After the name in parentheses: state, and from there the 12th and 13th (proc_pid_stat(5): utime, stime).
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            return getattr(self, "cpu_s", 0.0)
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def stop(self):
        """Ends it at once."""
        if not self.poll():
            self.process.send_signal(signal.SIGKILL)
            while not self.poll():
                time.sleep(0.01)

    def boot(self, late: bool) -> Boot:
        """How it went, once it has ended."""
        console = self.console.read_text(errors="replace") if self.console.exists() else ""
        return Boot(
            ended=(self.share / "done").exists(),
            panicked="Kernel panic" in console or "PANIC" in console,
            late=late,
            wall_s=time.monotonic() - self.started,
            cpu_s=self.cpu_s,
            console=console,
        )
