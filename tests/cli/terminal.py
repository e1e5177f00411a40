"""A pseudo-terminal of a given width, in which `rtcd` runs as a user meets it."""

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
from pathlib import Path

from tests.paths import ROOT

BAR = "\x1b[?25l"
"""Sent where a live line begins: it hides the cursor."""


def in_terminal(*arguments: object, folder: Path, width: int = 120, **environment: str) -> tuple[int, str]:
    """The exit code of `rtcd arguments`, and everything that its terminal was sent."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    command = [sys.executable, "-m", "rtcd_jax", *map(str, arguments)]
    chosen = os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm-256color", "PYTHONUTF8": "1"} | environment
    process = subprocess.Popen(command, cwd=folder, env=chosen, stdin=its, stdout=its, stderr=its)
    os.close(its)
    sent = bytearray()
    try:
        while part := os.read(ours, 1 << 16):
            sent += part
    except OSError:  # what Linux says when nobody has the other end any more
        pass
    os.close(ours)
    return process.wait(timeout=60), sent.decode()
