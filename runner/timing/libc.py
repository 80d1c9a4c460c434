"""System calls for compiled code, which makes them without the interpreter and its lock."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

MONOTONIC = 1

_NUMBER, _POINTER, _SIZE = ctypes.c_int, ctypes.c_void_p, ctypes.c_size_t
_CALLS = {
    "clock_gettime": (_NUMBER, _POINTER),
    "ppoll": (_POINTER, _SIZE, _POINTER, _POINTER),
    "sched_setaffinity": (_NUMBER, _SIZE, _POINTER),
    "sched_getcpu": (),
    "sem_init": (_POINTER, _NUMBER, ctypes.c_uint),
    "sem_post": (_POINTER,),
    "sem_clockwait": (_POINTER, _NUMBER, _POINTER),
    "write": (_NUMBER, _POINTER, _SIZE),
}


@functools.cache
def call(name: str) -> Any:
    """The C library's function of that name; raises AttributeError where there is none."""
    function = getattr(ctypes.CDLL(None), name)
    function.argtypes = _CALLS[name]
    function.restype = ctypes.c_ssize_t if name == "write" else _NUMBER
    return function
