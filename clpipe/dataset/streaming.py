"""Samples of renders in tars, which are unpacked one after the other."""

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
from clpipe.base.text import as_texts
from clpipe.base.urls import fetched_files, is_glob, is_url, list_urls, local, path_of
from clpipe.dataset.dataset import Dataset
from clpipe.dataset.developer import Sample
from clpipe.torch.iterable import IterableDataset, worker


class StreamingDataset(ReadOnly, IterableDataset):
    """Samples of renders in tars: an iterable for data sets that are larger than the disk.

    >>> import tarfile
    >>> import tempfile
    >>> import OpenImageIO as oiio
    >>> import clpipe
    >>> folder = tempfile.TemporaryDirectory()
    >>> render = oiio.ImageBufAlgo.fill((0.2, 0.3, 0.4), oiio.ROI(0, 64, 0, 48, 0, 1, 0, 3))
    >>> _ = render.write(f"{folder.name}/a.exr")
    >>> with tarfile.open(f"{folder.name}/renders-0.tar", "w") as tar:
    ...     tar.add(f"{folder.name}/a.exr", "a.exr")
    >>> tars = f"{folder.name}/renders-*.tar"
    >>> samples = clpipe.StreamingDataset(tars, iso=3200, device="numpy", cache=0)
    >>> [(sample["key"], sample["image"].shape) for sample in samples]
    [('renders-0/a.exr', (48, 64, 3))]
    >>> folder.cleanup()

    It yields the samples of a :class:`~clpipe.Dataset` of each tar in turn. "key" is the name of
    the tar without ``.tar``, a slash, and the name in the tar. While one tar is developed, the next
    is fetched and unpacked into a temporary directory (``TMPDIR``), which is removed afterwards.
    Pass the data set to ``torch.utils.data.DataLoader``: each worker takes a part of the tars. Each
    pass is an epoch with new noise and draws.

    Args:
        tars: paths, globs or URLs of tars.
        **options: as for :class:`~clpipe.Dataset`, except ``epochs``. ``epoch`` is the first one.

    Raises:
        RequestError: a tar does not exist, or ``epochs`` is set. Options are checked with the first
            tar.
    """

    def __init__(self, tars: str | Path | Sequence[str | Path], **options: Any) -> None:
        if "epochs" in options:
            raise RequestError(
                "found epochs, but each pass over a StreamingDataset is an epoch. Remove it"
            )
        self._epoch: int = options.pop("epoch", 0)
        self._options = options
        self._tars = [tar for name in as_texts(tars) for tar in _tars_of(name)]

    def __repr__(self) -> str:
        return f"StreamingDataset({len(self._tars)} tars)"

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next pass."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[Sample]:
        """Yield every sample of the tars of this worker, in order.

        Raises:
            ImageError: a tar or an image cannot be read, or an image cannot be developed.
            RequestError: an option is not allowed, or a tar has no renders.
            DeviceError: there is no usable device.
        """
        epoch, self._epoch = self._epoch, self._epoch + 1
        number, count = worker()
        with (
            tempfile.TemporaryDirectory(prefix="clpipe-tars-") as folder,
            ThreadPoolExecutor(1, "unpack") as unpacker,
        ):
            folders = [Path(folder) / str(i) for i in range(len(self._tars))]
            remaining = list(zip(self._tars, folders, strict=True))[number::count]
            unpacking: Future[None] | None = None
            for (tar, target), next_tar in zip(remaining, [*remaining[1:], None], strict=True):
                if unpacking:
                    unpacking.result()
                else:
                    _unpack(tar, target)
                unpacking = unpacker.submit(_unpack, *next_tar) if next_tar else None
                yield from Dataset(target, epoch=epoch, **self._options)
                shutil.rmtree(target)


def _tars_of(name: str) -> list[str]:
    """Return the tars of a path, a glob or a URL.

    Raises:
        RequestError: there is no such tar.
    """
    name = local(name)
    if is_url(name):
        tars = list_urls(name) if is_glob(name) else [name]
    else:
        tars = sorted(glob.glob(name)) if glob.has_magic(name) else [name] * Path(name).is_file()
    if not tars:
        raise RequestError(f"{name}: no such tar exists")
    return tars


def _unpack(tar: str, folder: Path) -> None:
    """Unpack a tar into a new directory with the tar's name inside a folder.

    Raises:
        ImageError: the tar cannot be read.
    """
    folder.mkdir()
    target_folder = folder / PurePosixPath(tar).name.removesuffix(".tar")
    try:
        with fetched_files([path_of(tar)]) as (path,), tarfile.open(path) as file:
            for member in file:
                path_in_tar = PurePosixPath(member.name)
                if not member.isfile() or path_in_tar.is_absolute() or ".." in path_in_tar.parts:
                    continue
                target = target_folder / path_in_tar
                target.parent.mkdir(parents=True, exist_ok=True)
                content = file.extractfile(member)
                assert content
                with target.open("wb") as written:
                    shutil.copyfileobj(content, written)
    except tarfile.ReadError:
        raise ImageError(f"{tar}: cannot be read; it is damaged, or not a tar") from None
    except (tarfile.TarError, OSError, EOFError) as error:
        raise ImageError(f"{tar}: cannot be read as a tar: {error}") from None
