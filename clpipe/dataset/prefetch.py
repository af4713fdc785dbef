"""Prefetching: decodes and develops several samples before they are requested."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

from clpipe.base.errors import ImageError
from clpipe.base.processors import available_processors
from clpipe.base.types import Array
from clpipe.dataset.developer import Sample
from clpipe.dataset.samples import Read, SampleBatch, SampleLoader
from clpipe.images.openimageio import set_codec_threads

Pending = tuple[SampleBatch, Callable[[], list[Sample]]]

PATCHES_TOGETHER = 16  # patches with their own draws in one batch
# Samples are developed together until one of these limits is reached. In a shuffled dataset, every
# sample may have its own render. Larger groups only use more memory.
MAX_BYTES = 2**27  # bytes of renders
MAX_PIXELS = 2**21  # pixels of samples


class BatchSize:
    """The size of the images that are developed together.

    Args:
        side: the side of patches in px. None is whole pictures.
    """

    def __init__(self, side: int | None) -> None:
        self._side = side
        self._sources: set[int] = set()
        self._pixels = self._bytes = 0

    def add(self, batch: SampleBatch, source: Array) -> bool:
        """Add samples of an image, and return whether the batch is full."""
        is_new = id(source) not in self._sources
        self._sources.add(id(source))
        self._bytes += source.nbytes * is_new
        if self._side:
            self._pixels += len(batch.numbers) * self._side**2
        else:
            self._pixels += source.shape[0] * source.shape[1] * is_new
        return self._pixels >= MAX_PIXELS or self._bytes >= MAX_BYTES


def prefetched(
    loader: SampleLoader, batches: Iterator[SampleBatch], threads: int, group_size: int
) -> Generator[Pending]:
    """Decode images in threads and start to develop them, a few in advance.

    Args:
        loader: decodes and develops.
        batches: the batches.
        threads: how many images are decoded at once.
        group_size: how many batches are begun together.

    Yields:
        The batches in order, each with a callable that waits for its samples. The callable raises
        ImageError if its image cannot be read or processed.

    Raises:
        DeviceError: there is no usable device.
    """
    set_codec_threads(max(available_processors() // threads, 1))
    in_flight: deque[Future[list[Pending]]] = deque()
    decoders = ThreadPoolExecutor(threads, "decode")
    beginner = ThreadPoolExecutor(1, "begin")
    try:
        while group := list(islice(batches, group_size)):
            decoded = [decoders.submit(loader.read, batch) for batch in group]
            in_flight.append(beginner.submit(_begin, loader, group, decoded))
            if len(in_flight) > threads + 1:
                yield from in_flight.popleft().result()
        while in_flight:
            yield from in_flight.popleft().result()
    finally:
        decoders.shutdown(cancel_futures=True)
        beginner.shutdown(cancel_futures=True)


def _begin(
    loader: SampleLoader, batches: Sequence[SampleBatch], decoded: Sequence[Future[Read]]
) -> list[Pending]:
    """Start batches together, when their images are decoded."""
    read = [(batch, attempted(each.result)) for batch, each in zip(batches, decoded, strict=True)]
    return list(zip(batches, loader.begin(read), strict=True))


def attempted(read: Callable[[], Read]) -> Read | ImageError:
    """Return the image that a function reads, or its error."""
    try:
        return read()
    except ImageError as error:
        return error
