"""Samples of renders that lie in tars, which are unpacked one after the other."""

import glob
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import several
from clpipe.base.urls import fetched, is_glob, is_url, listed, path_of
from clpipe.dataset.dataset import Dataset
from clpipe.dataset.developer import Sample
from clpipe.torch.iterable import IterableDataset, worker


class StreamingDataset(ReadOnly, IterableDataset):
    """Samples of renders in tars, tar by tar: an iterable, for more renders than a disk holds.

    It is a :class:`~clpipe.Dataset` of each tar in turn, and yields the same samples: "key" is the
    tar's name without ``.tar``, a slash, and the name in the tar. While one tar is developed, the
    next is fetched and unpacked into a temporary folder (``TMPDIR``), which is removed then. Pass
    it to ``torch.utils.data.DataLoader``: each worker takes a part of the tars. Each pass over it
    is an epoch, with noise and draws of its own.

    Args:
        tars: paths, globs or URLs of tars.
        **options: as for :class:`~clpipe.Dataset`, but for ``epochs``; ``epoch`` is the first one.

    Raises:
        RequestError: there is no such tar, or ``epochs`` is set; options are checked with the first
            tar.

    Example::

        samples = clpipe.StreamingDataset("renders-*.tar", iso=3200, patch=128)
        loader = DataLoader(samples, batch_size=32, num_workers=2)
    """

    def __init__(self, tars: str | Path | Sequence[str | Path], **options: Any) -> None:
        if "epochs" in options:
            raise RequestError("found epochs; each pass over a StreamingDataset is an epoch")
        self._epoch: int = options.pop("epoch", 0)
        self._options = options
        self._tars = [found for name in several(tars) for found in _found(name)]

    def __repr__(self) -> str:
        return f"StreamingDataset({len(self._tars)} tars)"

    def set_epoch(self, epoch: int) -> None:
        """Begin the next pass with this epoch."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[Sample]:
        """Every sample of this process's tars, in order.

        Raises:
            ImageError: a tar or an image cannot be read, or an image cannot be developed.
            RequestError: an option is not allowed, or a tar has no renders.
            DeviceError: there is no usable device.
        """
        epoch, self._epoch = self._epoch, self._epoch + 1
        number, count = worker()
        with (
            tempfile.TemporaryDirectory(prefix="clpipe-tars-") as folder,
            ThreadPoolExecutor(1, "unpack") as beside,
        ):
            places = [Path(folder) / str(i) for i in range(len(self._tars))]
            left = list(zip(self._tars, places, strict=True))[number::count]
            ahead: Future[None] | None = None
            for (tar, place), following in zip(left, [*left[1:], None], strict=True):
                if ahead:
                    ahead.result()
                else:
                    _unpack(tar, place)
                ahead = beside.submit(_unpack, *following) if following else None
                yield from Dataset(place, epoch=epoch, **self._options)
                shutil.rmtree(place)


def _found(name: str) -> list[str]:
    """The tars of a path, a glob or a URL.

    Raises:
        RequestError: there is none.
    """
    if is_url(name):
        tars = listed(name) if is_glob(name) else [name]
    else:
        tars = sorted(glob.glob(name)) if glob.has_magic(name) else [name] * Path(name).is_file()
    if not tars:
        raise RequestError(f"{name}: there is no such tar")
    return tars


def _unpack(tar: str, folder: Path) -> None:
    """Unpack a tar into a folder of its name in a folder.

    Raises:
        ImageError: it cannot be read.
    """
    folder.mkdir()
    into = folder / PurePosixPath(tar).name.removesuffix(".tar")
    try:
        with fetched([path_of(tar)]) as (path,), tarfile.open(path) as file:
            for member in file:
                inside = PurePosixPath(member.name)
                if not member.isfile() or inside.is_absolute() or ".." in inside.parts:
                    continue
                target = into / inside
                target.parent.mkdir(parents=True, exist_ok=True)
                content = file.extractfile(member)
                assert content
                with target.open("wb") as written:
                    shutil.copyfileobj(content, written)
    except (tarfile.TarError, OSError, EOFError) as error:
        raise ImageError(f"{tar}: cannot be read as a tar: {error}") from None
