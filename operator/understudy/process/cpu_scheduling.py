"""CPU scheduling that wakes a process in time on a node whose processors are all busy."""

from __future__ import annotations

import ctypes
import logging
import platform
import struct

_logger = logging.getLogger(__name__)

SLICE = 100_000
"""Length of the time slice, in nanoseconds, that a process requests if its work is short and urgent. Linux allows no
shorter one."""

NUMBERS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""Numbers of the system calls sched_setattr and sched_getattr, for which the C library has no functions."""

ATTRIBUTES = struct.Struct("=IIQiIQQQII")
"""struct sched_attr of sched_setattr(2): size, policy, flags, nice, priority, runtime (ns), deadline, period, and the
two utilization clamps."""


def ask_for_short_slices() -> bool:
    """Request that this process, and the threads that it starts from now on, run as soon as they are woken.

    Linux runs a process that requests a shorter slice before the one that is running (EEVDF, from 6.12 on; older
    kernels ignore the request). It needs no privilege, and the process gains no share of the processor. Returns whether
    the kernel accepted it.
    """
    numbers = NUMBERS.get(platform.machine())
    if numbers is None:
        return False
    set_number, get_number = numbers
    libc = ctypes.CDLL(None, use_errno=True)
    found = ctypes.create_string_buffer(ATTRIBUTES.size)
    if libc.syscall(get_number, 0, found, ATTRIBUTES.size, 0) != 0:
        return _refused()
    _, policy, _, nice, *_ = ATTRIBUTES.unpack(found.raw)
    if policy != 0:  # SCHED_OTHER; somebody chose another policy for this process
        return False
    wanted = ATTRIBUTES.pack(ATTRIBUTES.size, policy, 0, nice, 0, SLICE, 0, 0, 0, 0)
    return libc.syscall(set_number, 0, wanted, 0) == 0 or _refused()


def _refused() -> bool:
    # For example, a seccomp profile forbids sched_setattr. Everything works, only later on a node without a free
    # processor.
    _logger.info(
        "the kernel refuses short scheduler time slices (errno %d): on a busy node, this process may react later",
        ctypes.get_errno(),
    )
    return False
