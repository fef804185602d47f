"""NumPy arrays on the device: their memory goes on after their end."""

import ctypes
import mmap
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_sparse_prt.core.device_arrays import on_device


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="protects a page of memory by Linux's calls")
def test_an_array_before_memory_that_is_nobodys():
    """
    Scenario: an array ends where a page begins that must not be read.
    Expected: a kernel reads the array alone; it would end the process if it read whole packets of this memory.
    """
    n, page, libc = 100_003, mmap.PAGESIZE, ctypes.CDLL(None, use_errno=True)
    libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    pages = (4 * n + page - 1) // page
    memory = mmap.mmap(-1, (pages + 1) * page)
    start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    assert libc.mprotect(start + pages * page, page, 0) == 0
    values = np.frombuffer((ctypes.c_uint32 * n).from_address(start + pages * page - 4 * n), np.uint32)
    values[:] = np.arange(n)
    found = on_device(mi.UInt32, values) + 1
    dr.eval(found)
    assert np.array_equal(found.numpy(), np.arange(1, n + 1))
    assert libc.mprotect(start + pages * page, page, 3) == 0
