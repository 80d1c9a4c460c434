"""Compiled per-tick draws. Imported on first use, for it brings Numba.

Numba's generator methods give the same stream as NumPy's own (a test holds them to that), so
the draws stay those of a plain loop over ``standard_normal`` and ``random``.
"""

from __future__ import annotations

from crazyarena.jit import kernel


@kernel(_nrt=True)
def fill(rng, out, std, low, span, action, force):
    """Fill rows of ``out`` (n, 7): four normals times ``std``, then three uniforms; see draw.py."""
    for k in range(out.shape[0]):
        if action:
            for i in range(4):
                out[k, i] = std[i] * rng.standard_normal()
        if force:
            for i in range(3):
                out[k, 4 + i] = low[i] + span[i] * rng.random()
