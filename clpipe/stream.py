"""Frames of a simulator that is running: each is developed like a frame of a sequence."""

import itertools
import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Self, TypeVar, Unpack

import numpy as np

from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError, RequestError
from clpipe.base.text import unknown_name
from clpipe.base.types import Array
from clpipe.base.user_warnings import Issued, warn
from clpipe.base.validation import check_argument_types
from clpipe.chain.camera_info import CameraInfo
from clpipe.chain.keys import RENDER
from clpipe.chain.options import Transfer
from clpipe.chain.registry import stage_in
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result
from clpipe.engine.service import Development
from clpipe.engine.state import State, has_state
from clpipe.images.arrays import as_array, as_image, as_stack
from clpipe.inputs.metering import Meter, merged
from clpipe.inputs.subframes import add_frame, weights_of
from clpipe.pipeline import Pipeline, Prepared
from clpipe.reference.geometry import NO_MARGINS
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import Kind, StageRole
from clpipe.stages.shutter import Rows

if TYPE_CHECKING:
    from clpipe.chain.keywords import Keywords

T = TypeVar("T")

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
        view: the name of its view; "" in a stream without views.
    """

    index: int
    image: Array
    settings: Mapping[str, Any]
    metered: Mapping[str, float]
    result: Result
    time: float | None = None
    view: str = ""

    @property
    def camera(self) -> CameraInfo:
        """The camera of the frame, see :class:`CameraInfo`."""
        return replace(self.result.camera, time=self.time)


@dataclass
class _View:
    """A camera of a stream, whose frames are a sequence."""

    name: str
    key: str  # of the sequence
    settings: Mapping[str, Any]
    meter: Meter
    state: State = field(default_factory=State)
    numbers: Iterator[int] = field(default_factory=itertools.count)


@dataclass(frozen=True)
class _Taken:
    """A frame that a stream has taken."""

    view: _View
    index: int
    pixels: Sequence[Array]  # its sub-frames
    arrays: Mapping[str, Array]
    time: float | None


@dataclass(frozen=True)
class _Part:
    """A frame that was metered: its chain, what was metered, and its settings."""

    taken: _Taken
    prepared: Prepared
    metered: Mapping[str, float]
    settings: Mapping[str, Any]


class _Frames(Pipeline):
    """A pipeline for the frames of a sequence."""

    _is_sequence = True

    def exposed(self, frames: Sequence[Array], key: str, settings: Mapping[str, Any]) -> Array:
        """Return the image of an exposure: for each row, the mean of its sub-frames.

        Raises:
            ImageError, RequestError: there are not as many as the shutter states, or they differ.
        """
        if len(frames) == 1:
            return frames[0]
        chain = self._chain_for(key, settings)
        step = chain.step_in(StageRole.SHUTTER)
        shutter = step.method if step and isinstance(step.method, Rows) else Rows()
        if shutter.subframes != len(frames):
            raise RequestError(
                f"found {len(frames)} sub-frames, but {stage_in(StageRole.SHUTTER).name}.subframes "
                f"is {shutter.subframes}; set it to their number"
            )
        if len({frame.shape for frame in frames}) > 1:
            raise ImageError("the sub-frames of an exposure have different shapes; use one shape")
        weights = weights_of(shutter, len(frames), frames[0].shape[0], NO_MARGINS)
        total = np.zeros(frames[0].shape, np.float32)
        for each, frame in zip(weights, frames, strict=True):
            add_frame(total, each, frame)
        return total

    def develop_many(self, prepared: Sequence[Prepared]) -> list[Callable[[], Result]]:
        """Begin to develop images without state, and return functions that wait for the results.

        Small images share launches. A function raises ImageError if its image is too large.
        """
        frames = [self._frame(each, RunOptions()) for each in prepared]

        def wait(development: Development, origin: Prepared) -> Result:
            return self._with_origin(development.result(), origin)

        pairs = zip(self._service.develop(frames), prepared, strict=True)
        return [partial(wait, *pair) for pair in pairs]

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
        views: the settings of each camera of a rig, by its name. Each has a sequence of its own.
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
        views: Mapping[str, Mapping[str, Any]] | None = None,
        **settings: "Unpack[Keywords]",
    ) -> None:
        self.dropped = 0
        self._pipeline = _Frames(config, device=device, until=until, keep=keep, **settings)
        self._is_srgb = transfer == "srgb"
        self._drop = drop
        self._views = {
            view: _View(view, f"{name}/{view}" if view else name, own, self._pipeline.meter())
            for view, own in (views or {"": {}}).items()
        }
        self._issued = Issued()
        # One frame waits while another is developed.
        self._free = threading.Semaphore(2)
        # Each is a shot with its warnings, or an error, and whether it is the last of a put.
        self._shots: queue.SimpleQueue[tuple[_Found, bool] | None] = queue.SimpleQueue()
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
        frame: Array | Sequence[Array],
        depth: Array | None = None,
        flow: Array | None = None,
        time: float | None = None,
        view: str | None = None,
    ) -> Shot:
        """Develop the next frame, and return its picture.

        Args:
            frame: (height, width, 3) linear light as for :meth:`Pipeline.process`, or with
                ``transfer="srgb"`` uint8. An array in shared memory is not copied. A list has the
                sub-frames of an exposure, as many as ``shutter.subframes``.
            depth: as for :meth:`Pipeline.process`.
            flow: (height, width, 2), for temporal_denoise with the method flow: from each pixel to
                the place of its surface in the frame before, in px to the right and down. Pixels
                whose surface that frame does not show are NaN. All of the first frame may be NaN.
            time: the simulator's time of the frame, s, which :class:`Shot` repeats.
            view: the name of its camera, in a stream with views.

        Raises:
            ImageError, RequestError: as for :meth:`Pipeline.process`. The next frame can still be
                developed.
        """
        self._check_accepts()
        if self._is_threaded:
            raise RequestError("this stream develops the frames of put; use get, not a call")
        return self._announced(
            *self._next_shot(self._taken(frame, depth, flow, time, self._view(view)))
        )

    def put(
        self,
        frame: Array | Sequence[Array],
        depth: Array | None = None,
        flow: Array | None = None,
        time: float | None = None,
        view: str | None = None,
    ) -> bool:
        """Pass the next frame to the stream's thread. The frame is copied.

        At most two frames are in the stream. If neither of their pictures has been fetched with
        :meth:`get`, this waits for the first to be fetched. With ``drop``, it drops the frame.

        Returns:
            Whether the frame was taken.

        Raises:
            ImageError: this is no array.
            RequestError: the stream is closed, :meth:`end` was called, or there is no such view.
        """
        self._check_accepts()
        return self._put([self._taken(frame, depth, flow, time, self._view(view))])

    def put_many(
        self,
        frames: Array,
        views: Sequence[str] | None = None,
        times: Sequence[float] | None = None,
    ) -> bool:
        """Pass a frame of each of several views to the stream's thread, like one :meth:`put`.

        Small frames are developed together. :meth:`get` returns their pictures in this order.

        >>> import numpy as np
        >>> import clpipe
        >>> rig = {"left": {"iso": 100}, "right": {"iso": 400}}
        >>> with clpipe.Stream(device="numpy", views=rig) as stream:
        ...     taken = stream.put_many(np.full((2, 24, 32, 3), 0.05, np.float32))
        ...     [(shot.view, shot.index, shot.camera.iso) for shot in stream.finish()]
        [('left', 0, 100.0), ('right', 0, 400.0)]

        Args:
            frames: (view, height, width, 3).
            views: the names of their views; None is all views of the stream.
            times: their times, s.

        Raises:
            ImageError: this is no array.
            RequestError: as for :meth:`put`, or there are not as many views or times as frames.
        """
        self._check_accepts()
        names = [*self._views] if views is None else views
        stack = as_stack(frames, "frames", views=names, times=times)
        moments = [None] * len(stack) if times is None else times
        found = [self._view(name) for name in names]
        taken = [
            self._taken(frame, None, None, time, view)
            for frame, time, view in zip(stack, moments, found, strict=True)
        ]
        return self._put(taken) if taken else True

    def _put(self, taken: list[_Taken]) -> bool:
        """Pass frames to the stream's thread, and return whether they were taken."""
        self._is_threaded = True
        is_free = self._free.acquire(blocking=not self._drop)
        if self._has_ended:
            self._free.release()  # another thread may wait as well
            self._check_accepts()
        if not is_free:
            self.dropped += len(taken)
            return False
        copies = [
            replace(
                each,
                pixels=[frame.copy() for frame in each.pixels],
                arrays={kind: layer.copy() for kind, layer in each.arrays.items()},
            )
            for each in taken
        ]
        self._in_thread(self._deliver, copies)
        return True

    def _view(self, name: str | None) -> _View:
        """Return a view by its name; None is the only one.

        Raises:
            RequestError: there is no such view, or there are several.
        """
        if name is None and len(self._views) > 1:
            raise RequestError(f"this stream has the views {', '.join(self._views)}; name one")
        name = next(iter(self._views)) if name is None else name
        if name not in self._views:
            raise RequestError(unknown_name("view", name, self._views))
        return self._views[name]

    @staticmethod
    def _taken(
        frame: Array | Sequence[Array],
        depth: Array | None,
        flow: Array | None,
        time: float | None,
        view: _View,
    ) -> _Taken:
        """Return the next frame of a view.

        Raises:
            ImageError: this is no array.
        """
        frames = frame if isinstance(frame, list | tuple) and frame else [frame]
        pixels, arrays = [as_array(each, "frame") for each in frames], _by_kind(depth, flow)
        return _Taken(view, next(view.numbers), pixels, arrays, time)

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
            return None
        shot, is_last = found
        if is_last:
            self._free.release()
        if isinstance(shot, Exception):
            raise shot
        return self._announced(*shot)

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
            self._warn(f"{key_of(self._views[shot.view], shot.index)}: {text}")
        return shot

    _warn = staticmethod(warn)

    def _deliver(self, taken: Sequence[_Taken]) -> None:
        """Develop frames for :meth:`get`, together if they have no state."""
        parts = [_attempted(partial(self._prepared, each)) for each in taken]
        ready = [part for part in parts if isinstance(part, _Part)]
        waits: list[Callable[[], Result]] = [partial(self._developed, part) for part in ready]
        if len(taken) > 1 and not has_state(self._pipeline.chain):
            waits = self._pipeline.develop_many([part.prepared for part in ready])
        pending = iter(waits)
        for number, part in enumerate(parts, 1):
            found: _Found
            if isinstance(part, _Part):
                result = _attempted(next(pending))
                found = result if isinstance(result, Exception) else self._shot(part, result)
            else:
                found = part
            self._shots.put((found, number == len(parts)))

    def _rehearse(self, frame: Array) -> None:
        """Develop frames like those to come, with loops and state that are then dropped.

        The second frame of a sequence needs other kernels than the first one.
        """
        as_image(self._light(frame), self._pipeline.chain.source, self._pipeline.chain.bands)
        height, width = frame.shape[:2]
        layers = _by_kind(np.ones((height, width)), np.zeros((height, width, 2)))
        for view in self._views.values() if self._pipeline.device else ():  # NumPy compiles nothing
            copy = _View(view.name, view.key, view.settings, self._pipeline.meter())
            for index in range(2):
                self._next_shot(_Taken(copy, index, [frame], layers, None))

    def _next_shot(self, taken: _Taken) -> tuple[Shot, tuple[str, ...]]:
        """Develop a frame, and return its picture and warnings.

        Raises:
            ImageError, RequestError, DeviceError: the frame cannot be developed.
        """
        part = self._prepared(taken)
        return self._shot(part, self._developed(part))

    def _developed(self, part: _Part) -> Result:
        """Develop the next frame of a view."""
        view = part.taken.view
        try:
            return self._pipeline.develop(part.prepared, view.state)
        except (DeviceError, DeviceFailedError):
            view.state = State()  # the next frame starts again
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

    def _prepared(self, taken: _Taken) -> _Part:
        """Meter a frame, and return it with its chain.

        Raises:
            ImageError, RequestError, DeviceError: the frame cannot be developed.
        """
        pipeline, view = self._pipeline, taken.view
        key = key_of(view, taken.index)
        drawn = merged(pipeline.settings.drawn_values(view.key, taken.index), view.settings)
        frames = [self._light(each) for each in taken.pixels]
        light = pipeline.exposed(frames, key, drawn)
        first = pipeline.prepare(light, key, taken.arrays, NO_MARGINS, drawn)

        def prepared_with(values: Mapping[str, Any]) -> Prepared:
            settings = merged(drawn, values)
            if len(frames) > 1 and RENDER in values:  # the rows of another exposure time
                light = pipeline.exposed(frames, key, settings)
                return pipeline.prepare(light, key, taken.arrays, NO_MARGINS, settings)
            return pipeline.prepare(first.pixels, key, taken.arrays, NO_MARGINS, settings, first)

        reading = view.meter.read(
            first.chain,
            first.pixels,
            first.own_key,
            taken.index,
            lambda values: prepared_with(values).chain,
        )
        prepared = prepared_with(reading.values) if reading.values else first
        return _Part(taken, prepared, reading.metered, merged(drawn, reading.values))

    @staticmethod
    def _shot(part: _Part, result: Result) -> tuple[Shot, tuple[str, ...]]:
        """Return a picture and its warnings."""
        taken, prepared = part.taken, part.prepared
        is_raw = prepared.chain.result is Kind.RAW
        image = result.image.astype(np.uint16) if is_raw else result.image
        facts = part.metered, result, taken.time, taken.view.name
        return Shot(taken.index, image, part.settings, *facts), prepared.warnings


_Found = tuple[Shot, tuple[str, ...]] | Exception


def _attempted(function: Callable[[], T]) -> T | Exception:
    """Return the result of a function, or its error."""
    try:
        return function()
    except Exception as error:
        return error


def key_of(view: _View, index: int) -> str:
    """Return the image key of a frame, without the digest of its pixels."""
    return f"{view.key}/{index:06}"


def _by_kind(depth: Array | None, flow: Array | None) -> dict[str, Array]:
    """Return the layers that were passed, by kind.

    Raises:
        ImageError: one is no array.
    """
    layers = {"depth": depth, "flow": flow}
    return {kind: as_array(layer, kind) for kind, layer in layers.items() if layer is not None}
