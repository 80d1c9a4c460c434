"""Spaces of observations and actions."""

import numpy as np


class Space:
    """A set of values."""

    def __init__(self, shape=None, dtype=None, seed=None):
        self.shape = None if shape is None else tuple(shape)
        self.dtype = None if dtype is None else np.dtype(dtype)
        self._rng = np.random.default_rng(seed)


class Box(Space):
    """Arrays between two bounds."""

    def __init__(self, low, high, shape=None, dtype=np.float32, seed=None):
        shape = np.broadcast_shapes(np.shape(low), np.shape(high)) if shape is None else shape
        super().__init__(shape, dtype, seed)
        self.low = np.broadcast_to(np.asarray(low, self.dtype), tuple(shape))
        self.high = np.broadcast_to(np.asarray(high, self.dtype), tuple(shape))

    def contains(self, x):
        x = np.asarray(x)
        return x.shape == self.shape and bool(np.all((x >= self.low) & (x <= self.high)))

    def sample(self):
        low = np.where(np.isfinite(self.low), self.low, -1.0)
        high = np.where(np.isfinite(self.high), self.high, 1.0)
        return self._rng.uniform(low, high).astype(self.dtype)


class Discrete(Space):
    """Whole numbers from ``start``."""

    def __init__(self, n, seed=None, start=0):
        super().__init__((), np.int64, seed)
        self.n, self.start = int(n), int(start)

    def contains(self, x):
        return self.start <= int(x) < self.start + self.n

    def sample(self):
        return self.start + int(self._rng.integers(self.n))


class MultiDiscrete(Space):
    """Several :class:`Discrete`."""

    def __init__(self, nvec, dtype=np.int64, seed=None):
        self.nvec = np.asarray(nvec)
        super().__init__(self.nvec.shape, dtype, seed)


class MultiBinary(Space):
    """Bits."""

    def __init__(self, n, seed=None):
        super().__init__((n,) if isinstance(n, int) else n, np.int8, seed)


class Dict(Space, dict):
    """Spaces by name."""

    def __init__(self, spaces=None, seed=None, **more):
        Space.__init__(self, None, None, seed)
        dict.__init__(self, {**(spaces or {}), **more})
        self.spaces = self


class Tuple(Space):
    """Spaces in a row."""

    def __init__(self, spaces, seed=None):
        super().__init__(None, None, seed)
        self.spaces = tuple(spaces)


def flatdim(space):
    """How many numbers a value of a space has."""
    if isinstance(space, Dict):
        return sum(flatdim(s) for s in space.values())
    return int(np.prod(space.shape or (1,)))
