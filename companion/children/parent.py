"""What a child process asks of the kernel about its parent."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h


def die_with_parent(parent_pid: int) -> None:
    """Have the kernel kill this process when the parent dies, even while it hangs in C code.

    Raises
    ------
    OSError
        When the kernel refuses.
    """
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    # The kernel reads whole registers: a plain int would leave half of each to chance on some machines.
    prctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_ulong, ctypes.c_ulong, ctypes.c_ulong)
    if prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent_pid:  # it died before the line above
        sys.exit(0)
