"""Prefetching: decodes and develops several samples before they are requested."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import islice

from clpipe.base.errors import ImageError
from clpipe.base.processors import available_processors
from clpipe.base.types import Array
from clpipe.dataset.developer import Sample
from clpipe.dataset.samples import SampleBatch, SampleLoader
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.loader import LoadedImage

Read = Future[tuple[LoadedImage, Sample]]
Begun = tuple[SampleBatch, Callable[[], list[Sample]]]

PATCHES = 16  # patches with their own draws in one batch
# Samples are developed together until either limit is reached. In a shuffled dataset, every sample
# may have its own render. More pixels would only wait in memory.
MOST_BYTES = 2**27  # of renders
MOST_PIXELS = 2**21  # of samples


class Size:
    """The size of the images that are developed together.

    Args:
        side: the side of patches in px. None is whole pictures.
    """

    def __init__(self, side: int | None) -> None:
        self._side = side
        self._sources: set[int] = set()
        self._pixels = self._bytes = 0

    def add(self, batch: SampleBatch, source: Array) -> bool:
        """Add samples of an image. Return whether that is enough."""
        is_new = id(source) not in self._sources
        self._sources.add(id(source))
        self._bytes += source.nbytes * is_new
        if self._side:
            self._pixels += len(batch.numbers) * self._side**2
        else:
            self._pixels += source.shape[0] * source.shape[1] * is_new
        return self._pixels >= MOST_PIXELS or self._bytes >= MOST_BYTES


def begun_ahead(
    loader: SampleLoader, batches: Iterator[SampleBatch], threads: int, together: int
) -> Generator[Begun]:
    """Decode images in threads and begin to develop them, a few ahead.

    Args:
        loader: decodes and develops.
        batches: the batches.
        threads: how many images are decoded at once.
        together: how many batches are begun together.

    Yields:
        The batches in order, each with a callable that waits for its samples. The callable raises
        ImageError if its image cannot be read or processed.

    Raises:
        DeviceError: there is no usable device.
    """
    set_codec_threads(max(available_processors() // threads, 1))
    ahead: deque[Future[list[Begun]]] = deque()
    decoders = ThreadPoolExecutor(threads, "decode")
    developer = ThreadPoolExecutor(1, "device")
    try:
        while some := list(islice(batches, together)):
            read = [decoders.submit(loader.read, batch) for batch in some]
            ahead.append(developer.submit(_begun, loader, some, read))
            if len(ahead) > threads + 1:
                yield from ahead.popleft().result()
        while ahead:
            yield from ahead.popleft().result()
    finally:
        decoders.shutdown(cancel_futures=True)
        developer.shutdown(cancel_futures=True)
        loader.drain()


def _begun(
    loader: SampleLoader, batches: Sequence[SampleBatch], read: Sequence[Read]
) -> list[Begun]:
    """Begin with batches together. If that fails, each one begins when it is waited for."""
    pairs = list(zip(batches, read, strict=True))
    try:
        waits = loader.begin([(batch, *own.result()) for batch, own in pairs])
    except ImageError:
        waits = [partial(_alone, loader, batch, own) for batch, own in pairs]
    return list(zip(batches, waits, strict=True))


def _alone(loader: SampleLoader, batch: SampleBatch, read: Read) -> list[Sample]:
    return loader.begin([(batch, *read.result())])[0]()
