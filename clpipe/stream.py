"""Frames of a simulator that is running: each is developed like a frame of a sequence."""

import itertools
import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Self, Unpack

import numpy as np

from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError, RequestError
from clpipe.base.types import Array
from clpipe.base.user_warnings import Issued, warn
from clpipe.base.validation import check_argument_types
from clpipe.chain.camera_info import CameraInfo
from clpipe.chain.options import Transfer
from clpipe.engine.runner import Result
from clpipe.engine.state import State
from clpipe.images.arrays import as_array, as_image
from clpipe.inputs.metering import Meter, merged
from clpipe.pipeline import Pipeline, Prepared
from clpipe.reference.geometry import NO_MARGINS
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import Kind

if TYPE_CHECKING:
    from clpipe.chain.keywords import Keywords

SRGB = inverse_srgb_curve(np.arange(256) / 255).astype(np.float32)  # the light of 8-bit codes


@dataclass(frozen=True)
class Shot:
    """A frame of a :class:`Stream`.

    >>> import numpy as np
    >>> import clpipe
    >>> with clpipe.Stream(iso=800, device="numpy", until="quantize") as stream:
    ...     shot = stream(np.full((24, 32, 3), 0.05, np.float32))
    >>> shot.index, shot.image.shape, shot.image.dtype
    (0, (24, 32), dtype('uint16'))

    Attributes:
        index: the number of the frame, from 0. Frames that were dropped are counted.
        image: the picture, (height, width, 3) uint8; the raw, (height, width) uint16, if the chain
            ends with it; else float32.
        settings: what the sequence's draws and control loops set, nested like a configuration.
        metered: what was metered for this frame only, by name. A frame without light has nothing,
            and holds the control loops.
        result: the kept images, and the numbers that stages estimated.
        time: the time that was passed with the frame, s; None if there was none.
    """

    index: int
    image: Array
    settings: Mapping[str, Any]
    metered: Mapping[str, float]
    result: Result
    time: float | None = None

    @property
    def camera(self) -> CameraInfo:
        """The camera of the frame, see :class:`CameraInfo`."""
        return replace(self.result.camera, time=self.time)


class _Frames(Pipeline):
    """A pipeline for the frames of a sequence."""

    _is_sequence = True

    def meter(self) -> Meter:
        """Return the meter of a sequence."""
        return Meter(self._service.run)


class Stream:
    """A camera for a running simulation. Call it with each frame, or put and get frames.

    Exposure and white balance follow the frames like in ``clpipe run --sequence``, and so do draws.
    A frame has the same bits as with :meth:`Pipeline.process` and the settings in :class:`Shot`.

    >>> import numpy as np
    >>> import clpipe
    >>> render = np.full((24, 32, 3), 0.05, np.float32)  # linear light
    >>> with clpipe.Stream(device="numpy", exposure={"method": "auto"}) as stream:
    ...     shots = [stream(render * light) for light in (1, 1, 2, 2, 2)]
    >>> [round(shot.settings["exposure"]["ev"], 2) for shot in shots]
    [1.85, 1.85, 1.85, 1.85, 1.62]

    A simulation that must not wait uses :meth:`put` and :meth:`get`, which develop in a thread:

    >>> with clpipe.Stream(device="numpy", drop=True) as stream:
    ...     sent = [stream.put(render) for _ in range(9)]
    ...     shots = list(stream.finish())
    >>> len(shots) == sum(sent) == 9 - stream.dropped
    True

    Args:
        config: as for :class:`Pipeline`.
        name: the name of the sequence. Noise depends on it and on the number of the frame.
        device: as for :class:`Pipeline`.
        until: the last step to run. ``until="quantize"`` ends with the raw.
        keep: steps whose images are also returned, or "all".
        transfer: "srgb" if frames are finished pictures of sRGB in eight bits, as most simulators
            render them. They are converted to light.
        drop: whether :meth:`put` drops a frame instead of waiting, see there.
        **settings: as for :class:`Pipeline`.

    Attributes:
        dropped: the number of frames that were dropped.

    Raises:
        RequestError: a name or value is not allowed.
        DeviceError: there is no usable device.
    """

    @check_argument_types
    def __init__(
        self,
        config: str | Path | Sequence[str | Path] = "default",
        *,
        name: str = "stream",
        device: str | int | None = None,
        until: str | None = None,
        keep: str | Sequence[str] | None = None,
        transfer: Transfer = "linear",
        drop: bool = False,
        **settings: "Unpack[Keywords]",
    ) -> None:
        self.dropped = 0
        self._pipeline = _Frames(config, device=device, until=until, keep=keep, **settings)
        self._name = name
        self._is_srgb = transfer == "srgb"
        self._drop = drop
        self._meter, self._state = self._pipeline.meter(), State()
        self._issued = Issued()
        self._numbers = itertools.count()
        # One frame waits while another is developed.
        self._free = threading.Semaphore(2)
        self._shots: queue.SimpleQueue[tuple[Shot, tuple[str, ...]] | Exception | None]
        self._shots = queue.SimpleQueue()
        self._thread = ThreadPoolExecutor(1, "stream")
        self._lock = threading.Lock()  # lets no frame follow the end
        self._process = os.getpid()
        self._is_threaded = self._has_ended = self._is_closed = False

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a Stream cannot be pickled, because its thread and its frames belong to this process. "
            "Create a Stream in each process"
        )

    def __enter__(self) -> Self:
        self._check_open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def warm_up(self, shape: Sequence[int], dtype: Any = np.float32) -> None:
        """Compile all kernels for frames of a shape and type, so that no frame waits for them.

        The frames that follow have the same numbers, noise and settings as without it. A call with
        an array whose channels are separate planes needs other kernels, which are not compiled.

        >>> import numpy as np
        >>> import clpipe
        >>> with clpipe.Stream(device="numpy", transfer="srgb") as stream:
        ...     stream.warm_up((24, 32, 3), "uint8")
        ...     stream(np.zeros((24, 32, 3), np.uint8)).index
        0

        Args:
            shape: the shape of frames, (height, width, 3).
            dtype: the type of their samples.

        Raises:
            ImageError: frames of this shape or type cannot be developed.
            RequestError: these are no shape and type, or the stream is closed.
            DeviceError: a kernel does not compile.
        """
        self._check_accepts()
        try:
            type_ = np.dtype(dtype)
            grey = 0.18 if type_.kind == "f" else 118  # 118 is the code of 0.18 in sRGB
            frame = np.full(shape, grey, type_)
        except (TypeError, ValueError) as error:
            raise RequestError(
                f"found shape {shape!r} and dtype {dtype!r} ({error}); pass those of a frame, such "
                "as (720, 1280, 3) and 'float32'"
            ) from None
        self._in_thread(self._rehearse, frame).result()

    def __call__(
        self,
        frame: Array,
        depth: Array | None = None,
        flow: Array | None = None,
        time: float | None = None,
    ) -> Shot:
        """Develop the next frame, and return its picture.

        Args:
            frame: (height, width, 3) linear light as for :meth:`Pipeline.process`, or with
                ``transfer="srgb"`` uint8. An array in shared memory is not copied.
            depth: as for :meth:`Pipeline.process`.
            flow: (height, width, 2), for temporal_denoise with the method flow: from each pixel to
                the place of its surface in the frame before, in px to the right and down. Pixels
                whose surface that frame does not show are NaN. All of the first frame may be NaN.
            time: the simulator's time of the frame, s, which :class:`Shot` repeats.

        Raises:
            ImageError, RequestError: as for :meth:`Pipeline.process`. The next frame can still be
                developed.
        """
        self._check_accepts()
        if self._is_threaded:
            raise RequestError("this stream develops the frames of put; use get, not a call")
        index, light = next(self._numbers), as_array(frame, "frame")
        return self._announced(*self._next_shot(index, light, _by_kind(depth, flow), time))

    def put(
        self,
        frame: Array,
        depth: Array | None = None,
        flow: Array | None = None,
        time: float | None = None,
    ) -> bool:
        """Pass the next frame to the stream's thread. The frame is copied.

        At most two frames are in the stream. If neither of their pictures has been fetched with
        :meth:`get`, this waits for the first to be fetched. With ``drop``, it drops the frame.

        Returns:
            Whether the frame was taken.

        Raises:
            ImageError: this is no array.
            RequestError: the stream is closed, or :meth:`end` was called.
        """
        self._check_accepts()
        self._is_threaded = True
        image, layers = as_array(frame, "frame"), _by_kind(depth, flow)
        index = next(self._numbers)
        is_free = self._free.acquire(blocking=not self._drop)
        if self._has_ended:
            self._free.release()  # another thread may wait as well
            self._check_accepts()
        if not is_free:
            self.dropped += 1
            return False
        copied = {kind: layer.copy() for kind, layer in layers.items()}
        self._in_thread(self._deliver, index, image.copy(), copied, time)
        return True

    def get(self, timeout: float | None = None) -> Shot | None:
        """Return the next picture, in the order of the frames. None if there will be no more.

        Args:
            timeout: the longest time to wait, in s; None waits.

        Raises:
            TimeoutError: there is no picture yet.
            ImageError, RequestError: this frame failed. The next one can still be developed.
            RequestError: the stream is closed.
        """
        self._check_open()
        try:
            found = self._shots.get(timeout=timeout)
        except queue.Empty:
            raise TimeoutError("no picture yet") from None
        if found is None:
            self._shots.put(None)  # for the next call
        self._free.release()
        if isinstance(found, Exception):
            raise found
        return None if found is None else self._announced(*found)

    def end(self) -> None:
        """Accept no more frames. The pictures of earlier frames can still be fetched.

        Raises:
            RequestError: the stream is closed.
        """
        self._check_open()
        self._end()

    def finish(self) -> Iterator[Shot]:
        """Yield the pictures of all frames that were put; none can be put any more.

        Raises:
            RequestError: the stream is closed.
        """
        self.end()
        return iter(self.get, None)

    def close(self) -> None:
        """Stop the stream, once the frames that were put are developed.

        From then on, every method raises a RequestError, except for this one. Pictures that were
        not fetched are lost.
        """
        self._end()
        self._thread.shutdown()
        self._is_closed = True

    def _end(self) -> None:
        with self._lock:
            if not self._has_ended:
                self._thread.submit(self._shots.put, None)
                self._has_ended = True
                self._free.release()  # a thread that waits in put then learns of it

    def _in_thread(self, function: Callable[..., None], *arguments: Any) -> Future[None]:
        """Call a function in the stream's thread, after the frames before it.

        Raises:
            RequestError: the stream accepts no frames.
        """
        with self._lock:
            self._check_accepts()
            return self._thread.submit(function, *arguments)

    def _check_open(self) -> None:
        """Check that the stream is not closed, and that its thread and device are of this process.

        Raises:
            RequestError, DeviceError: it is closed, or this process was forked.
        """
        if self._is_closed:
            raise RequestError("this stream is closed; make another one")
        if device := self._pipeline.device:
            device.check_process()
        if self._process != os.getpid():
            raise RequestError(
                "this process was forked from the one that made this stream, whose thread is "
                "missing here; make another one"
            )

    def _check_accepts(self) -> None:
        """Check that the stream accepts frames.

        Raises:
            RequestError: it does not.
        """
        self._check_open()
        if self._has_ended:
            raise RequestError("this stream was ended and accepts no more frames; make another one")

    def _announced(self, shot: Shot, warnings: Iterable[str]) -> Shot:
        """Return a picture, and issue the new kinds of warnings about it in the user's thread."""
        for text in self._issued.new(warnings):
            self._warn(f"{self._key(shot.index)}: {text}")
        return shot

    _warn = staticmethod(warn)

    def _key(self, index: int) -> str:
        """Return the image key of a frame, without the digest of its pixels."""
        return f"{self._name}/{index:06}"

    def _deliver(self, *frame: Any) -> None:
        """Develop a frame for :meth:`get`."""
        try:
            self._shots.put(self._next_shot(*frame))
        except Exception as error:
            self._shots.put(error)

    def _rehearse(self, frame: Array) -> None:
        """Develop frames like those to come, with loops and state that are then dropped.

        The second frame of a sequence needs other kernels than the first one.
        """
        as_image(self._light(frame), self._pipeline.chain.source, self._pipeline.chain.bands)
        height, width = frame.shape[:2]
        layers = _by_kind(np.ones((height, width)), np.zeros((height, width, 2)))
        meter, state = self._pipeline.meter(), State()
        for index in range(2) if self._pipeline.device else ():  # NumPy compiles nothing
            self._develop(index, frame, layers, meter, state)

    def _next_shot(
        self, index: int, frame: Array, arrays: Mapping[str, Array], time: float | None
    ) -> tuple[Shot, tuple[str, ...]]:
        """Develop the next frame, with its time. The rest is that of :meth:`_develop`."""
        try:
            shot, warnings = self._develop(index, frame, arrays, self._meter, self._state)
            return replace(shot, time=time), warnings
        except (DeviceError, DeviceFailedError):
            self._state = State()  # the next frame starts again
            raise

    def _light(self, frame: Array) -> Array:
        """Return the light of a frame.

        Raises:
            ImageError: it has a wrong type.
        """
        if not self._is_srgb:
            return frame
        if frame.dtype != np.uint8:
            raise ImageError(
                f"the frame has samples of type {frame.dtype}, but transfer='srgb' expects uint8; "
                "for linear light, use transfer='linear'"
            )
        return SRGB.take(frame, mode="clip")

    def _develop(
        self, index: int, frame: Array, arrays: Mapping[str, Array], meter: Meter, state: State
    ) -> tuple[Shot, tuple[str, ...]]:
        """Meter a frame, run the chain with its settings, and return its picture and warnings.

        Args:
            index: the number of the frame.
            frame: its pixels.
            arrays: its layers, by kind.
            meter: the loops of the sequence.
            state: the results of the frame before.

        Raises:
            ImageError, RequestError, DeviceError: the frame cannot be developed.
        """
        pipeline, key = self._pipeline, self._key(index)
        drawn = pipeline.settings.drawn_values(self._name, index)
        first = pipeline.prepare(self._light(frame), key, arrays, NO_MARGINS, drawn)

        def prepared_with(values: Mapping[str, Any]) -> Prepared:
            settings = merged(drawn, values)
            return pipeline.prepare(first.pixels, key, arrays, NO_MARGINS, settings, first)

        reading = meter.read(
            first.chain,
            first.pixels,
            first.own_key,
            index,
            lambda values: prepared_with(values).chain,
        )
        prepared = prepared_with(reading.values) if reading.values else first
        result = pipeline.develop(prepared, state)
        is_raw = prepared.chain.result is Kind.RAW
        image = result.image.astype(np.uint16) if is_raw else result.image
        settings = merged(drawn, reading.values)
        return Shot(index, image, settings, reading.metered, result), prepared.warnings


def _by_kind(depth: Array | None, flow: Array | None) -> dict[str, Array]:
    """Return the layers that were passed, by kind.

    Raises:
        ImageError: one is no array.
    """
    layers = {"depth": depth, "flow": flow}
    return {kind: as_array(layer, kind) for kind, layer in layers.items() if layer is not None}
