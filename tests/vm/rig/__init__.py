"""The host's side of the virtual machine: its kernel, its file system, its boot, and what it reports."""


class Broken(Exception):
    """The rig itself does not work; nothing is known about depthrig."""


class Missing(Exception):
    """Something that the rig needs is not on this computer: the tests are skipped, unless they are required."""
