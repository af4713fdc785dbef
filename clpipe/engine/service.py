"""The service that develops frames: callers pass frames from any thread, and get a future for each.

Each device has a thread, which starts with the first frame. It takes the frames of all callers in
order, puts small ones into common launches, and keeps as many in flight as the device allows. If
one of several devices fails, the others develop its frames.
"""

import atexit
import logging
import os
import queue
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import nullcontext, suppress
from dataclasses import dataclass

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import DeviceError, ImageError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.engine.device import Device
from clpipe.engine.options import DEFAULTS, RunOptions
from clpipe.engine.runner import Result, Runner
from clpipe.engine.work import Work
from clpipe.stage import Kind

log = logging.getLogger(__name__)

ENDED = "the run ended before this image was developed"
MAX_STACK = 16  # the most small frames that share launches


@dataclass(frozen=True)
class Frame:
    """A frame to develop, and the results that are wanted.

    Args:
        chain: its chain.
        pixels: the image, as for :meth:`clpipe.engine.runner.Runner.run`. It must not change
            before the frame is developed.
        noise_key: the text from which the noise is seeded.
        keep: the steps whose images are wanted.
        encode: whether the last image is wanted in eight bits.
        final: whether the last image is wanted in float.
        options: boxes, state and other options.
    """

    chain: Chain
    pixels: Array
    noise_key: str
    keep: tuple[str, ...] = ()
    encode: bool = True
    final: bool = False
    options: RunOptions = DEFAULTS

    def runner(self, device: Device | None) -> Runner:
        """Return the runner of the frame on a device; None is NumPy."""
        return Runner(self.chain, device, self.keep, self.encode, self.final)


def picture(
    chain: Chain,
    pixels: Array,
    noise_key: str,
    keep: tuple[str, ...] = (),
    options: RunOptions = DEFAULTS,
) -> Frame:
    """Return a frame with one last image: in eight bits for display values, else in float."""
    encode = chain.result is Kind.DISPLAY
    return Frame(chain, pixels, noise_key, keep, encode, not encode, options)


class Development(Future[Result]):
    """The result of a frame that is developed.

    It raises ImageError and RequestError if the frame fails, and DeviceError if no device is left.

    Attributes:
        frame: the frame.
        device: the device that developed it; None is NumPy.
        began: the time at which its device began, in s of time.perf_counter.
    """

    def __init__(self, frame: Frame) -> None:
        super().__init__()
        self.frame = frame
        self.device: Device | None = None
        self.began = 0.0


# The frames of each call of Service.develop. None ends one thread.
Frames = queue.SimpleQueue[list[Development] | None]


def no_preparation(device: Device | None) -> None:
    """Do nothing."""


class Service:
    """Develops frames on devices. Any thread may use it.

    Args:
        devices: the devices; None is NumPy.
        prepare: called in the thread of each device before its first frame. If it raises an error,
            the device develops nothing.

    >>> import numpy as np
    >>> from clpipe.chain.making import make_chain
    >>> from clpipe.chain.settings import Settings
    >>> service, chain = Service([None]), make_chain(Settings())
    >>> frames = [Frame(chain, np.full((24, 32, 3), 0.2, np.float32), key) for key in "ab"]
    >>> [development.result().image.shape for development in service.develop(frames)]
    [(24, 32, 3), (24, 32, 3)]
    """

    def __init__(
        self,
        devices: Sequence[Device | None],
        prepare: Callable[[Device | None], None] = no_preparation,
    ) -> None:
        self.devices = tuple(devices)
        self._prepare = prepare
        self._lock = threading.Lock()  # guards the threads, and lets no frame follow the end
        self._is_closed = False
        self._reset()

    def _reset(self) -> None:
        self._process = os.getpid()
        self._frames: Frames = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._computing = threading.Lock()  # lets one thread use NumPy, which takes much memory

    @property
    def depth(self) -> int:
        """The number of frames that all devices work on at a time."""
        return sum(map(depth_of, self.devices))

    def start(self) -> None:
        """Start the threads of the devices, which prepare.

        Raises:
            DeviceError: this process was forked from the one that opened a device.
            RuntimeError: the system allows no more threads.
        """
        with self._lock:
            self._start()

    def _start(self) -> None:
        if self._process != os.getpid():
            self._reset()  # a fork has no threads
        if self._threads or self._is_closed:
            return
        for device in self.devices:
            if device:
                device.check_process()
        spare = threading.Semaphore(len(self.devices) - 1)  # devices that may fail
        for number, device in enumerate(self.devices):
            server = _Server(device, self._frames, spare, self._prepare)
            thread = threading.Thread(target=server.run, name=f"device {number}", daemon=True)
            try:
                thread.start()
            except RuntimeError:  # the system allows no more threads
                _end(self._frames, len(self._threads))
                self._reset()
                raise
            self._threads.append(thread)
        SERVICES.add(self)
        weakref.finalize(self, _end, self._frames, len(self._threads)).atexit = False

    def develop(self, frames: Sequence[Frame]) -> list[Development]:
        """Return the developments of frames. Small ones that are passed together share launches.

        Raises:
            DeviceError, RuntimeError: as for :meth:`start`.
        """
        developments = [Development(frame) for frame in frames]
        with self._lock:
            if developments:
                self._start()
            if developments and not self._is_closed:
                self._frames.put(developments)
                return developments
        for development in developments:
            development.set_exception(ImageError(ENDED))
        return developments

    def run(self, frame: Frame) -> Result:
        """Develop one frame, and return its result.

        A single device that needs no preparation is used in the caller's thread. For a frame of
        128x128 pixels, another thread would take a tenth longer.

        Raises:
            ImageError, RequestError, DeviceError, RuntimeError: it cannot be developed.
        """
        device, *others = self.devices
        if others or self._is_closed or self._prepare is not no_preparation:
            return self.develop([frame])[0].result()
        if self._process != os.getpid():
            self._reset()
        with nullcontext() if device else self._computing:
            return frame.runner(device).run(frame.pixels, frame.noise_key, frame.options)

    def close(self) -> None:
        """Finish all frames, and accept no others."""
        with self._lock:
            self._is_closed = True
            threads = self._threads if self._process == os.getpid() else []
            _end(self._frames, len(threads))
        for thread in threads:
            thread.join()
        with suppress(queue.Empty):  # frames of a device that failed when no other was left
            while True:
                for each in self._frames.get_nowait() or ():
                    each.set_exception(ImageError(ENDED))


SERVICES: "weakref.WeakSet[Service]" = weakref.WeakSet()  # with threads


@atexit.register
def close_all() -> None:
    """Close all services, because drivers may crash if the process exits while they are busy."""
    for service in list(SERVICES):
        service.close()


def _end(frames: Frames, threads: int) -> None:
    for _ in range(threads):
        frames.put(None)


def depth_of(device: Device | None) -> int:
    """Return the number of frames that a device works on at a time."""
    return device.depth if device else 1


def is_small(frame: Frame, device: Device | None) -> bool:
    """Return whether a frame may share launches with others."""
    if device is None or frame.options.state or frame.pixels.ndim < 2:
        return False
    return device.can_stack(*frame.pixels.shape[1::-1])


class _Server:
    """The thread of a device. It does not refer to the service, whose end ends it.

    Args:
        device: the device; None is NumPy.
        frames: the frames to develop.
        spare: acquired by a device that fails, as long as another one is left.
        prepare: as for :class:`Service`.
    """

    def __init__(
        self,
        device: Device | None,
        frames: Frames,
        spare: threading.Semaphore,
        prepare: Callable[[Device | None], None],
    ) -> None:
        self._device = device
        self._frames = frames
        self._spare = spare
        self._prepare = prepare
        # Frames that were started together, each with a function that waits for its result.
        self._started: deque[deque[tuple[Development, Callable[[], Result]]]] = deque()

    def run(self) -> None:
        """Develop frames until the end, or until the device fails and another one is left."""
        with CpuTimer("Python"):
            try:
                self._prepare(self._device)
            except BaseException as error:
                if not self._leaves(error, []):
                    for frames in iter(self._frames.get, None):
                        for each in frames:
                            each.set_exception(error)
            else:
                self._develop_all()
            if self._device:
                self._device.drain()

    def _develop_all(self) -> None:
        depth = depth_of(self._device)
        taken: list[Development] = []
        while True:
            try:
                taken = self._take()
                if not taken and not self._started:
                    return
                if not taken or len(self._started) >= depth:
                    self._finish()
                if taken:
                    self._start(taken)
            except BaseException as error:  # callers wait for the frames of this thread
                if self._gives_up(error, taken):
                    return
            taken = []  # it holds images

    def _gives_up(self, error: BaseException, taken: Sequence[Development]) -> bool:
        """Return whether other devices take over the frames of this one; otherwise, fail them."""
        unfinished = [each for group in self._started for each, _ in group]
        unfinished += [each for each in taken if each not in unfinished]
        unfinished = [each for each in unfinished if not each.done()]
        self._started.clear()
        if self._leaves(error, unfinished):
            return True
        for each in unfinished:
            each.set_exception(error)
        return False

    def _leaves(self, error: BaseException, unfinished: Sequence[Development]) -> bool:
        """Return whether other devices develop the frames of this one, which has failed."""
        if not isinstance(error, DeviceError) or not self._spare.acquire(blocking=False):
            return False
        log.warning("%s; the other devices continue", error)
        for each in unfinished:
            self._frames.put([each])
        return True

    def _take(self) -> list[Development]:
        """Return the next frames: one, or several small ones.

        Returns:
            Nothing at the end, or if frames in flight can be finished meanwhile.
        """
        taken: list[Development] = []
        while len(taken) < MAX_STACK:
            try:
                frames = self._frames.get(not (taken or self._started))
            except queue.Empty:
                break
            if frames is None:
                if taken or self._started:
                    self._frames.put(None)  # the next call must also find the end
                break
            taken += frames
            if not is_small(taken[-1].frame, self._device):
                break
        return taken

    def _start(self, taken: Sequence[Development]) -> None:
        """Start frames together.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        ready: list[tuple[Development, Work[Result] | Callable[[], Result]]] = []
        for each in taken:
            each.device, each.began, frame = self._device, time.perf_counter(), each.frame
            try:
                work = frame.runner(self._device).work(frame.pixels, frame.noise_key, frame.options)
            except DeviceError:
                raise
            except BaseException as error:
                each.set_exception(error)
            else:
                ready.append((each, work))
        works = [work for _, work in ready if isinstance(work, Work)]
        try:
            waits = iter(self._device.submit(works) if self._device and works else ())
        except DeviceError:
            raise
        except BaseException as error:  # it does not identify the frame, so each is started alone
            for each, _ in ready:
                if len(ready) > 1:
                    self._start([each])
                else:
                    each.set_exception(error)
        else:
            functions = [next(waits) if isinstance(work, Work) else work for _, work in ready]
            self._started.append(
                deque((each, wait) for (each, _), wait in zip(ready, functions, strict=True))
            )

    def _finish(self) -> None:
        """Wait for the frames that were started first.

        Raises:
            DeviceError: the device cannot be used any more. Unfinished frames stay in place.
        """
        group = self._started[0]
        while group:
            each, wait = group[0]
            try:
                result = wait()
            except DeviceError:
                raise
            except BaseException as error:
                each.set_exception(error)
            else:
                each.set_result(result)
            group.popleft()
        self._started.popleft()
