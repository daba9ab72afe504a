"""Multi-scale bilinear sampling and its gradients on the CPU, compiled with numba.

The functions are marked ``no_type_check`` because numba cannot compile what jaxtyping's import hook
wraps. Products and sums are fused, and sums over channels reordered, so that they use vector
instructions; infinities and NaN keep their meaning.

A plane is one head of one image. Only this head reads its values and writes their gradients, so
that threads can work on different planes at the same time, and the result does not depend on their
number. Arrays: values (plane, token, channel); locations (batch, query, 2, head, level, point);
weights (batch, query, head, level, point); outputs (batch, query, head, channel); levels (rows,
columns, first token).
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
@no_type_check
def _neighbours(location, size):
    """The two cells around a normalised location along one axis of ``size`` cells.

    Returns their indices, 1 for each that is in the map and 0 for one that is not (its index is
    then the other's), and the fraction of the way from the first to the second. Both indices are -1
    if neither is in the map, and for NaN.
    The order of operations is that of ``grid_sample``, so that both find the same cells for a
    location at the centre of one.
    """
    real = type(location)
    zero, one = real(0), real(1)
    place = ((real(2) * location - one) + one) * (real(size) * real(0.5)) - real(0.5)
    if not (place >= -one and place < real(size)):
        return -1, -1, zero, zero, zero
    first = np.intp(place + one) - 1
    if place < real(first):  # the sum was rounded up
        first -= 1
    fraction = place - real(first)
    if first < 0:
        return 0, 0, zero, one, fraction
    if first + 1 >= size:
        return first, first, one, zero, fraction
    return first, first + 1, one, one, fraction


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
@no_type_check
def forward(values, levels, locations, weights, outputs, first_plane, last_plane):
    """Write the weighted sums of the planes ``first_plane`` to ``last_plane`` - 1."""
    queries, heads, points = weights.shape[1], weights.shape[2], weights.shape[4]
    channels, real = values.shape[2], values.dtype.type
    for plane in range(first_plane, last_plane):
        batch, head = divmod(plane, heads)
        tokens = values[plane]
        for query in range(queries):
            xs, ys = locations[batch, query, 0, head], locations[batch, query, 1, head]
            shares = weights[batch, query, head]
            output = outputs[batch, query, head]
            for channel in range(channels):
                output[channel] = 0
            spoiled = real(0)  # NaN if a location or a weight is not finite
            for level in range(len(levels)):
                rows, columns, start = levels[level]
                for point in range(points):
                    x, y = xs[level, point], ys[level, point]
                    weight = shares[level, point]
                    spoiled += (x + y + weight) * real(0)
                    left, right, in_left, in_right, across = _neighbours(x, columns)
                    upper, lower, in_upper, in_lower, down = _neighbours(y, rows)
                    if left < 0 or upper < 0:
                        continue
                    of_left, of_right = in_left * (1 - across), in_right * across
                    of_upper = in_upper * (1 - down) * weight
                    of_lower = in_lower * down * weight
                    upper, lower = start + upper * columns, start + lower * columns
                    a = tokens[np.uintp(upper + left)]
                    b = tokens[np.uintp(upper + right)]
                    c = tokens[np.uintp(lower + left)]
                    d = tokens[np.uintp(lower + right)]
                    of_a, of_b = of_upper * of_left, of_upper * of_right
                    of_c, of_d = of_lower * of_left, of_lower * of_right
                    for channel in range(channels):
                        output[channel] += (
                            of_a * a[channel]
                            + of_b * b[channel]
                            + of_c * c[channel]
                            + of_d * d[channel]
                        )
            if spoiled != 0:
                for channel in range(channels):
                    output[channel] += spoiled


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
@no_type_check
def backward(
    gradient,
    values,
    levels,
    locations,
    weights,
    to_values,
    to_locations,
    to_weights,
    first_plane,
    last_plane,
):
    """Write the gradients of locations and weights, and add those of the values, of these planes.

    ``gradient``: of the outputs.
    """
    queries, heads, points = weights.shape[1], weights.shape[2], weights.shape[4]
    channels, real = values.shape[2], values.dtype.type
    for plane in range(first_plane, last_plane):
        batch, head = divmod(plane, heads)
        tokens, to_tokens = values[plane], to_values[plane]
        for query in range(queries):
            xs, ys = locations[batch, query, 0, head], locations[batch, query, 1, head]
            shares = weights[batch, query, head]
            to_x, to_y = to_locations[batch, query, 0, head], to_locations[batch, query, 1, head]
            to_shares = to_weights[batch, query, head]
            given = gradient[batch, query, head]
            for level in range(len(levels)):
                rows, columns, start = levels[level]
                for point in range(points):
                    x, y = xs[level, point], ys[level, point]
                    weight = shares[level, point]
                    left, right, in_left, in_right, across = _neighbours(x, columns)
                    upper, lower, in_upper, in_lower, down = _neighbours(y, rows)
                    if left < 0 or upper < 0:
                        nothing = (x + y) * real(0)  # or NaN
                        to_shares[level, point] = nothing
                        to_x[level, point] = to_y[level, point] = nothing
                        continue
                    along_x = along_y = along_weight = real(0)
                    for corner in range(4):
                        is_lower, is_right = corner >> 1, corner & 1
                        if not (in_lower if is_lower else in_upper):
                            continue
                        if not (in_right if is_right else in_left):
                            continue
                        row = lower if is_lower else upper
                        column = right if is_right else left
                        share_y = down if is_lower else 1 - down
                        share_x = across if is_right else 1 - across
                        token = np.uintp(start + row * columns + column)
                        source, target = tokens[token], to_tokens[token]
                        share, product = weight * share_y * share_x, real(0)
                        for channel in range(channels):
                            product += given[channel] * source[channel]
                        for channel in range(channels):
                            target[channel] += share * given[channel]
                        along_weight += share_y * share_x * product
                        along_x += share_y * product if is_right else -share_y * product
                        along_y += share_x * product if is_lower else -share_x * product
                    to_shares[level, point] = along_weight
                    to_x[level, point] = weight * real(columns) * along_x
                    to_y[level, point] = weight * real(rows) * along_y
