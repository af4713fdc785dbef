"""Samples of renders in tars, which are unpacked one after the other."""

import copy
import glob
import hashlib
import re
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import zip_longest
from pathlib import Path, PurePosixPath
from typing import Any, Self

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.process_folder import process_folder
from clpipe.base.readonly import ReadOnly
from clpipe.base.text import as_texts
from clpipe.base.url_text import is_glob, is_url, local
from clpipe.base.urls import fetched_files, list_urls, path_of
from clpipe.base.workers import worker
from clpipe.dataset.dataset import Dataset
from clpipe.dataset.developer import Sample
from clpipe.dataset.passes import Passes, part_of
from clpipe.torch.iterable import IterableDataset


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
    Pass the data set to ``torch.utils.data.DataLoader``: each worker takes a part of the tars, and
    so does each rank if ``torch.distributed`` runs. Each pass is an epoch with new noise and draws,
    with any number of workers, persistent or not.

    Args:
        tars: paths, globs or URLs of tars. ``renders-{000..127}.tar`` and ``{a,b}.tar`` name
            several, like in WebDataset.
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
        self._passes = Passes(options.pop("epoch", 0))
        self._options = options
        names = [
            name
            for text in as_texts(tars)
            for name in ([text] if Path(text).exists() else expand_braces(text))
        ]
        self._tars = [tar for name in names for tar in _tars_of(name)]
        self._part: tuple[int, int] | None = None  # the rank, and how many there are
        self._start: Mapping[str, Any] = {}  # the state where the next pass starts
        self._position: dict[str, Any] = {}  # the tar of the current pass
        self._samples: Dataset | None = None  # the samples of this tar

    def __repr__(self) -> str:
        return f"StreamingDataset({len(self._tars)} tars)"

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_part": self._ranks(), "_samples": None}  # workers have no ranks

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next pass. Passes are counted if you do not call this."""
        self._passes.set(epoch)
        self._start, self._samples = {}, None

    def shard(self, rank: int | None = None, ranks: int | None = None) -> Self:
        """Return the part of one of several ranks: every ``ranks``-th tar, starting at ``rank``.

        Without a call, and by default, this is the rank in ``torch.distributed`` if it runs.

        Raises:
            RequestError: ``rank`` is not from 0 to ``ranks`` - 1.
        """
        part = copy.copy(self)
        part._part = part_of(rank, ranks)
        part._passes = self._passes.copy()
        return part

    def _ranks(self) -> tuple[int, int]:
        """Return the rank, and how many there are.

        Raises:
            RequestError: there are more ranks than tars.
        """
        rank, ranks = self._part or part_of(None, None)
        if ranks > len(self._tars):
            raise RequestError(
                f"found {len(self._tars)} tars for {ranks} ranks, but each rank needs one or more. "
                "Write smaller tars, or use fewer ranks"
            )
        return rank, ranks

    def state_dict(self) -> dict[str, Any]:
        """Return the position of the iteration as plain values for :meth:`load_state_dict`.

        In the process that iterates, this is the position after the last sample. A process whose
        workers iterate knows only passes. Its state continues with the next one.
        """
        if self._samples:
            return {**self._position, "in_tar": self._samples.state_dict()}
        return {"epoch": self._passes.epoch, "tars": self._digest(), **self._start}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Start the next pass after the last sample of a saved state.

        Raises:
            RequestError: the state belongs to other tars.
        """
        if state.get("tars") != self._digest():
            raise RequestError(
                "the state belongs to a dataset with other tars. Create the dataset with the tars "
                "that it had when the state was saved"
            )
        self._passes.set(state["epoch"], *worker())  # each worker has its own state
        self._start, self._samples = dict(state), None

    def _digest(self) -> str:
        return hashlib.sha256("\0".join(self._tars).encode()).hexdigest()

    def __iter__(self) -> Iterator[Sample]:
        """Yield every sample of the tars of this worker, in order.

        Raises:
            ImageError: a tar or an image cannot be read, or an image cannot be developed.
            RequestError: an option is not allowed, or a tar has no renders.
            DeviceError: there is no usable device.
        """
        (rank, ranks), (number, count) = self._ranks(), worker()
        part = [rank, ranks, number, count]
        start, self._start, self._samples = self._start, {}, None
        epoch = self._passes.begin(number, count)
        if start.get("part", part) != part:
            raise RequestError(
                "the state belongs to rank {} of {}, worker {} of {}, but this is rank {} of {}, "
                "worker {} of {}. Continue with the same ranks and workers".format(
                    *start["part"], *part
                )
            )
        first = start.get("tar", 0)
        with (
            tempfile.TemporaryDirectory(prefix="tars-", dir=process_folder()) as folder,
            ThreadPoolExecutor(1, "unpack") as unpacker,
        ):
            tars = self._tars[rank::ranks][number::count]
            remaining = [(i, tars[i], Path(folder) / str(i)) for i in range(first, len(tars))]
            unpacking: Future[None] | None = None
            for (index, tar, target), following in zip_longest(remaining, remaining[1:]):
                if unpacking:
                    unpacking.result()
                else:
                    _unpack(tar, target)
                unpacking = unpacker.submit(_unpack, *following[1:]) if following else None
                samples = Dataset(target, epoch=epoch, **self._options)
                if index == first and "in_tar" in start:
                    samples.load_state_dict(start["in_tar"])
                self._position = {
                    "epoch": epoch,
                    "tars": self._digest(),
                    "part": part,
                    "tar": index,
                }
                self._samples = samples
                yield from samples
                shutil.rmtree(target)
            self._samples = None


# A range of numbers, or alternatives.
BRACES = re.compile(r"\{(?:(\d+)\.\.(\d+)|([^{}]*,[^{}]*))\}")


def expand_braces(text: str) -> list[str]:
    """Return the names that a text with braces stands for, in order.

    >>> expand_braces("{a,b}-{08..10}.tar")
    ['a-08.tar', 'a-09.tar', 'a-10.tar', 'b-08.tar', 'b-09.tar', 'b-10.tar']
    """
    found = BRACES.search(text)
    if not found:
        return [text]
    first, last, names = found.groups()
    if names is None:
        step = 1 if int(first) <= int(last) else -1
        numbers = range(int(first), int(last) + step, step)
        parts = [str(number).zfill(len(first)) for number in numbers]
    else:
        parts = names.split(",")
    return [
        text[: found.start()] + part + rest
        for part in parts
        for rest in expand_braces(text[found.end() :])
    ]


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
