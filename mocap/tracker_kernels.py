"""Compiled matching of predicted to seen markers."""

from __future__ import annotations

import numpy as np

from crazyarena.jit import kernel


@kernel(_nrt=True)
def _claim(points, real, cloud, reach, match, owner_body, owner_point, owner_distance):
    # Deferred acceptance: every predicted point asks its nearest marker, a marker keeps the
    # nearest asker, the refused one asks the next. The outcome does not depend on the order.
    bodies, width = real.shape
    stack = np.empty((bodies * width, 2), dtype=np.int64)
    top = 0
    for b in range(bodies):
        for k in range(width):
            if real[b, k]:
                stack[top, 0] = b
                stack[top, 1] = k
                top += 1
    while top > 0:
        top -= 1
        b = stack[top, 0]
        k = stack[top, 1]
        limit = reach[b] * reach[b]
        best = limit
        choice = -1
        for m in range(cloud.shape[0]):
            dx = cloud[m, 0] - points[b, k, 0]
            if dx * dx > best:
                continue
            dy = cloud[m, 1] - points[b, k, 1]
            dz = cloud[m, 2] - points[b, k, 2]
            distance = dx * dx + dy * dy + dz * dz
            if distance < best and (owner_body[m] < 0 or distance < owner_distance[m]):
                best = distance
                choice = m
        if choice < 0:
            continue
        if owner_body[choice] >= 0:
            loser_b = owner_body[choice]
            loser_k = owner_point[choice]
            match[loser_b, loser_k] = -1
            stack[top, 0] = loser_b
            stack[top, 1] = loser_k
            top += 1
        owner_body[choice] = b
        owner_point[choice] = k
        owner_distance[choice] = best
        match[b, k] = choice


def greedy_match(points, real, cloud, reach):
    """Match predicted points to markers, one to one, nearest pairs first.

    points: (b, k, 3) predicted markers. real: (b, k) False for padding. cloud: (m, 3) seen.
    reach: (b,) largest distance, m. Returns (b, k) indices into ``cloud``, -1 for none.
    """
    match = np.full(real.shape, -1, dtype=np.int64)
    count = len(cloud)
    _claim(
        np.ascontiguousarray(points),
        real,
        cloud,
        np.ascontiguousarray(reach, dtype=np.float64),
        match,
        np.full(count, -1, dtype=np.int64),
        np.zeros(count, dtype=np.int64),
        np.zeros(count),
    )
    return match
