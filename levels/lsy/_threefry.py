"""Threefry-2x32-20 and the numbers that jax makes of it, compiled.

The generator is that of J. Salmon, M. Moraes, R. Dror, D. Shaw, "Parallel random numbers: as
easy as 1, 2, 3", SC 2011. The use of counters is jax's (``jax_threefry_partitionable``, the
default since jax 0.5): number i of an array is made of the counter (i >> 32, i & 0xffffffff);
its 32 random bits are both output words xor-ed, and key i of a split is both words.
"""

from __future__ import annotations

import numpy as np

from crazyarena.jit import kernel

_PARITY = np.uint32(0x1BD11BDA)
_ROTATIONS = np.array([[13, 15, 26, 6], [17, 29, 16, 24]], np.uint32)
_32 = np.uint32(32)


@kernel
def threefry(k0, k1, x0, x1):
    """Twenty rounds over the counter (x0, x1) under the key (k0, k1); all uint32."""
    k0, k1, x0, x1 = np.uint32(k0), np.uint32(k1), np.uint32(x0), np.uint32(x1)
    keys = (k0, k1, np.uint32(k0 ^ k1 ^ _PARITY))
    x0 = np.uint32(x0 + keys[0])
    x1 = np.uint32(x1 + keys[1])
    for block in range(5):
        for i in range(4):
            turn = _ROTATIONS[block & 1, i]
            x0 = np.uint32(x0 + x1)
            x1 = np.uint32((x1 << turn) | (x1 >> np.uint32(_32 - turn)))
            x1 = np.uint32(x1 ^ x0)
        x0 = np.uint32(x0 + keys[(block + 1) % 3])
        x1 = np.uint32(x1 + keys[(block + 2) % 3] + np.uint32(block + 1))
    return x0, x1


@kernel
def split(key, out):
    """Fill ``out`` (n, 2) with the keys that ``key`` (2,) splits into."""
    for i in range(out.shape[0]):
        out[i, 0], out[i, 1] = threefry(key[0], key[1], np.uint32(0), np.uint32(i))


@kernel
def bits(key, out):
    """Fill ``out`` (n,) with 32 random bits each."""
    for i in range(out.shape[0]):
        a, b = threefry(key[0], key[1], np.uint32(0), np.uint32(i))
        out[i] = a ^ b


@kernel(_nrt=True)
def chain(key, out):
    """Bits of one array of ``out.shape[1]`` numbers a row; before each row ``key`` (2,) is split
    into itself and the row's key, as happens at every tick of a simulation."""
    keys = np.empty((2, 2), np.uint32)
    for row in range(out.shape[0]):
        split(key, keys)
        key[0], key[1] = keys[0, 0], keys[0, 1]
        bits(keys[1], out[row])
