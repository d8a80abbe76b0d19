"""What the kernel is asked for by a process that must be woken in time."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys

import pytest

from understudy.process import cpu_scheduling

READS = """
import ctypes, struct, sys, threading
from understudy.process import cpu_scheduling as scheduling
print(scheduling.ask_for_short_slices())

def slice_of_this_thread():
    found = ctypes.create_string_buffer(scheduling.ATTRIBUTES.size)
    number = int(sys.argv[1])
    assert ctypes.CDLL(None).syscall(number, 0, found, scheduling.ATTRIBUTES.size, 0) == 0
    print(scheduling.ATTRIBUTES.unpack(found.raw)[5])

slice_of_this_thread()
thread = threading.Thread(target=slice_of_this_thread)
thread.start()
thread.join()
"""


def kernel() -> tuple[int, int]:
    major, minor, *_ = os.uname().release.split(".")
    return int(major), int(minor.split("-")[0])


@pytest.mark.skipif(platform.machine() not in cpu_scheduling.NUMBERS, reason="another processor")
@pytest.mark.skipif(os.sched_getscheduler(0) != os.SCHED_OTHER, reason="somebody chose another policy for the tests")
@pytest.mark.skipif(kernel() < (6, 12), reason="this kernel takes no notice of slices")
def test_a_process_and_its_later_threads_get_short_slices() -> None:
    number = cpu_scheduling.NUMBERS[platform.machine()][1]
    output = subprocess.run(
        [sys.executable, "-c", READS, str(number)], capture_output=True, text=True, timeout=60, check=True
    ).stdout.split()
    assert output == ["True", str(cpu_scheduling.SLICE), str(cpu_scheduling.SLICE)]


def test_a_refusal_of_the_kernel_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Refusing:
        def __init__(self, *_: object, **__: object) -> None: ...

        def syscall(self, *_: object) -> int:
            return -1

    monkeypatch.setattr(ctypes, "CDLL", Refusing)
    assert cpu_scheduling.ask_for_short_slices() is False


def test_an_unknown_processor_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    assert cpu_scheduling.ask_for_short_slices() is False
