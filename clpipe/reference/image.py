"""Neighbours and borders, like in ``kernels/lib/image.h``."""

import numpy as np

from clpipe.base.types import Array, Floats


def mirror(index: Array, size: int) -> Array:
    """Return the pixel (0..size-1) for each index by reflect-101, without repeating the edge pixel.

    >>> mirror(np.arange(-3, 7), 4).tolist()
    [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    """
    if size == 1:
        return np.zeros_like(index)
    period = 2 * (size - 1)
    index = index % period
    return np.where(index < size, index, period - index)


def tap(image: Floats, dx: int, dy: int) -> Floats:
    """Return the value ``dx`` px to the right and ``dy`` px below each pixel, mirrored.

    ``image`` is (height, width) or (height, width, channel); the result has the same shape.
    """
    rows = mirror(np.arange(image.shape[0]) + dy, image.shape[0])
    columns = mirror(np.arange(image.shape[1]) + dx, image.shape[1])
    return image[rows][:, columns]


def mirrored(image: Floats, margin: int) -> Floats:
    """Return the image with ``margin`` pixels added on every side, mirrored at the borders.

    >>> mirrored(np.float32([[1, 2, 3]]), 1).tolist()
    [[2.0, 1.0, 2.0, 3.0, 2.0], [2.0, 1.0, 2.0, 3.0, 2.0], [2.0, 1.0, 2.0, 3.0, 2.0]]
    """
    rows = mirror(np.arange(-margin, image.shape[0] + margin), image.shape[0])
    columns = mirror(np.arange(-margin, image.shape[1] + margin), image.shape[1])
    return image[rows][:, columns]


def in_blocks(images: Array, side: int, axis: int = 0) -> Array:
    """Return the whole blocks of images, with an axis of ``side`` px after each of the two axes.

    The last rows and columns that fill no block are dropped.

    >>> in_blocks(np.arange(15).reshape(3, 5), 2).max((1, 3)).tolist()
    [[6, 8]]

    Args:
        images: the images.
        side: the side of a block in px.
        axis: the number of the axis of rows; that of columns is the next one.
    """
    before, (height, width) = images.shape[:axis], images.shape[axis : axis + 2]
    rows, columns = height // side, width // side
    whole = images[(*(np.s_[:],) * axis, np.s_[: rows * side], np.s_[: columns * side])]
    return whole.reshape(*before, rows, side, columns, side, *images.shape[axis + 2 :])


def smooth(planes: Floats) -> Floats:
    """Return the binomial means of 3x3 pixels, (height, width, plane) in and out.

    >>> smooth(np.float32([[[0], [0], [4], [4]]]))[0, :, 0].tolist()
    [0.0, 1.0, 3.0, 4.0]
    """
    two = np.float32(2)
    rows = tap(planes, -1, 0) + tap(planes, 1, 0) + two * planes
    total = tap(rows, 0, -1) + tap(rows, 0, 1) + two * rows
    return np.asarray(total * np.float32(1 / 16))
