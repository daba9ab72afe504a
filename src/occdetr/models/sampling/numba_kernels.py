"""Multi-scale bilinear sampling and its gradients on the CPU, compiled with numba.

The functions are marked ``no_type_check`` because numba cannot compile what jaxtyping's import hook
wraps. Products and sums are fused, and sums over channels reordered, so that they use vector
instructions. What is not finite makes the result not finite (beside the border NaN where
``grid_sample`` gives an infinity). The cells around all samples of a query and
head are found first, in one loop without branches. Its arrays are created in the same function, so
that the compiler knows that they do not overlap.

A plane is one head of one image. Only this head reads its values and writes their gradients, so
that threads can work on different planes at the same time, and the result does not depend on their
number. Arrays: values (plane, token, channel); locations (batch, query, 2, head, sample) and
weights (batch, query, head, sample), where the samples are as many points of each level, one level
after the other; outputs (batch, query, head, channel); levels (rows, columns, first token).
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

#: Inlined, so that the compiler sees where the arrays come from.
_inlined = numba.njit(
    cache=True, nogil=True, fastmath={"contract"}, error_model="numpy", inline="always"
)


@_inlined
@no_type_check
def _make_arrays(levels, weights):
    """Arrays of the samples of a query and head: the rows, columns and first token of their levels;
    and those that ``_find_cells`` fills."""
    samples, real = weights.shape[3], weights.dtype
    rows, columns = np.empty(samples, np.int32), np.empty(samples, np.int32)
    starts = np.empty(samples, np.int32)
    for sample in range(samples):
        level = sample * len(levels) // samples
        rows[sample], columns[sample], starts[sample] = levels[level]
    upper_left, upper_right = np.empty(samples, np.int32), np.empty(samples, np.int32)
    lower_left, lower_right = np.empty(samples, np.int32), np.empty(samples, np.int32)
    of_left, of_right = np.empty(samples, real), np.empty(samples, real)
    of_upper, of_lower = np.empty(samples, real), np.empty(samples, real)
    cells = (upper_left, upper_right, lower_left, lower_right)
    return (rows, columns, starts), cells, (of_left, of_right), (of_upper, of_lower)


@_inlined
@no_type_check
def _find_cells(xs, ys, maps, cells, x_shares, y_shares):
    """Find the four cells around each sample, and their bilinear weights.

    ``cells``: the tokens upper left, upper right, lower left, lower right; -1 first if the location
    is outside of the map by a cell or more, or NaN. A cell that is not in the map is replaced by
    its neighbour, with a weight of zero; that of a left or upper cell in the map is never zero.
    ``x_shares`` are the weights of left and right, ``y_shares`` of above and below. The order of
    operations is that of ``grid_sample``, so that both find the same cells for a location at the
    centre of one.
    """
    rows, columns, starts = maps
    upper_left, upper_right, lower_left, lower_right = cells
    of_left, of_right = x_shares
    of_upper, of_lower = y_shares
    real = type(xs[0])
    zero, half, one, two = real(0), real(0.5), real(1), real(2)
    for sample in range(np.uintp(len(xs))):
        height, width, start = rows[sample], columns[sample], starts[sample]
        x = ((two * xs[sample] - one) + one) * (real(width) * half) - half
        y = ((two * ys[sample] - one) + one) * (real(height) * half) - half
        inside = (x >= -one) & (x < real(width)) & (y >= -one) & (y < real(height))
        x, y = x if inside else zero, y if inside else zero
        first_x, first_y = np.floor(x), np.floor(y)
        across, down = x - first_x, y - first_y
        left, upper = np.int32(first_x), np.int32(first_y)
        right, lower = left + np.int32(1), upper + np.int32(1)
        of_left[sample] = one - across if left >= 0 else zero
        of_right[sample] = across if right < width else zero
        of_upper[sample] = one - down if upper >= 0 else zero
        of_lower[sample] = down if lower < height else zero
        left, upper = left if left >= 0 else right, upper if upper >= 0 else lower
        right, lower = right if right < width else left, lower if lower < height else upper
        above, below = start + upper * width, start + lower * width
        upper_left[sample] = above + left if inside else np.int32(-1)
        upper_right[sample] = above + right
        lower_left[sample], lower_right[sample] = below + left, below + right


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"}, error_model="numpy")
@no_type_check
def forward(values, levels, locations, weights, outputs, first_plane, last_plane):
    """Write the weighted sums of the planes ``first_plane`` to ``last_plane`` - 1."""
    queries, heads, samples = weights.shape[1:]
    channels, real = values.shape[2], values.dtype.type
    maps, cells, x_shares, y_shares = _make_arrays(levels, weights)
    upper_left, upper_right, lower_left, lower_right = cells
    of_left, of_right = x_shares
    of_upper, of_lower = y_shares
    for plane in range(first_plane, last_plane):
        batch, head = divmod(plane, heads)
        tokens = values[plane]
        for query in range(queries):
            xs, ys = locations[batch, query, 0, head], locations[batch, query, 1, head]
            shares = weights[batch, query, head]
            output = outputs[batch, query, head]
            _find_cells(xs, ys, maps, cells, x_shares, y_shares)
            spoiled = real(0)  # NaN if a location or a weight is not finite
            for sample in range(np.uintp(samples)):
                spoiled += (xs[sample] + ys[sample] + shares[sample]) * real(0)
            for channel in range(np.uintp(channels)):
                output[channel] = spoiled
            for sample in range(np.uintp(samples)):
                if upper_left[sample] < 0:
                    continue
                a, b = np.uintp(upper_left[sample]), np.uintp(upper_right[sample])
                c, d = np.uintp(lower_left[sample]), np.uintp(lower_right[sample])
                above, below = shares[sample] * of_upper[sample], shares[sample] * of_lower[sample]
                of_a, of_b = above * of_left[sample], above * of_right[sample]
                of_c, of_d = below * of_left[sample], below * of_right[sample]
                for channel in range(np.uintp(channels)):
                    output[channel] += (
                        of_a * tokens[a, channel]
                        + of_b * tokens[b, channel]
                        + of_c * tokens[c, channel]
                        + of_d * tokens[d, channel]
                    )


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"}, error_model="numpy")
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
    queries, heads, samples = weights.shape[1:]
    channels, real = values.shape[2], values.dtype.type
    maps, cells, x_shares, y_shares = _make_arrays(levels, weights)
    upper_left, upper_right, lower_left, lower_right = cells
    of_left, of_right = x_shares
    of_upper, of_lower = y_shares
    rows, columns, _ = maps
    for plane in range(first_plane, last_plane):
        batch, head = divmod(plane, heads)
        tokens, to_tokens = values[plane], to_values[plane]
        for query in range(queries):
            xs, ys = locations[batch, query, 0, head], locations[batch, query, 1, head]
            shares = weights[batch, query, head]
            to_xs = to_locations[batch, query, 0, head]
            to_ys = to_locations[batch, query, 1, head]
            to_shares = to_weights[batch, query, head]
            given = gradient[batch, query, head]
            _find_cells(xs, ys, maps, cells, x_shares, y_shares)
            for sample in range(np.uintp(samples)):
                if upper_left[sample] < 0:
                    nothing = (xs[sample] + ys[sample]) * real(0)  # or NaN
                    to_shares[sample] = to_xs[sample] = to_ys[sample] = nothing
                    continue
                a, b = np.uintp(upper_left[sample]), np.uintp(upper_right[sample])
                c, d = np.uintp(lower_left[sample]), np.uintp(lower_right[sample])
                left, right = of_left[sample], of_right[sample]
                above, below = of_upper[sample], of_lower[sample]
                by_a = by_b = by_c = by_d = real(0)
                for channel in range(np.uintp(channels)):
                    by_a += given[channel] * tokens[a, channel]
                    by_b += given[channel] * tokens[b, channel]
                    by_c += given[channel] * tokens[c, channel]
                    by_d += given[channel] * tokens[d, channel]
                share = shares[sample]
                of_a, of_b = share * above * left, share * above * right
                of_c, of_d = share * below * left, share * below * right
                for channel in range(np.uintp(channels)):
                    to_tokens[a, channel] += of_a * given[channel]
                for channel in range(np.uintp(channels)):
                    to_tokens[b, channel] += of_b * given[channel]
                for channel in range(np.uintp(channels)):
                    to_tokens[c, channel] += of_c * given[channel]
                for channel in range(np.uintp(channels)):
                    to_tokens[d, channel] += of_d * given[channel]
                in_left, in_upper = real(left > 0), real(above > 0)
                in_right, in_lower = real(left == 0 or a != b), real(above == 0 or a != c)
                along_x = above * (in_right * by_b - in_left * by_a)
                along_x += below * (in_right * by_d - in_left * by_c)
                along_y = left * (in_lower * by_c - in_upper * by_a)
                along_y += right * (in_lower * by_d - in_upper * by_b)
                to_shares[sample] = above * (left * by_a + right * by_b)
                to_shares[sample] += below * (left * by_c + right * by_d)
                to_xs[sample] = share * real(columns[sample]) * along_x
                to_ys[sample] = share * real(rows[sample]) * along_y
