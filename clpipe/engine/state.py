"""State: what the frames of a sequence leave on a device, or in NumPy, for the next frame."""

from typing import Any, Protocol

from clpipe.base.errors import DeviceFailedError
from clpipe.base.types import Floats
from clpipe.chain.chain import Chain, Step, cached_by_structure
from clpipe.engine.bindings import slot_buffer
from clpipe.engine.extents import Extent, Extents
from clpipe.engine.ir import Plan
from clpipe.stage import PREVIOUS

Layout = tuple[tuple[str, Extent], ...]


class Queue(Protocol):
    """The commands and buffers of a device, :class:`clpipe.engine.flow.Flow`."""

    def drain(self) -> None:
        """Wait for all commands."""

    def new_buffer(self, size: int) -> Any:
        """Return a new buffer of a size in bytes."""


def keeps_state(step: Step) -> bool:
    """Return whether a step reads its result for the frame before."""
    return any(PREVIOUS in pass_.reads for pass_ in step.passes)


@cached_by_structure
def has_state(chain: Chain) -> bool:
    """Return whether a step of a chain reads its result for the frame before."""
    return any(keeps_state(step) for step in chain.steps)


def layout_of(plan: Plan, extents: Extents) -> Layout:
    """Return the steps with state, each with the extent of its result."""
    return tuple((step, extents[after.level]) for step, _, after in plan.states)


class State:
    """The last results of the stages with state, for one sequence and one rendition of its frames.

    Run the frames one by one, in temporal order, on one device. A frame whose results differ in
    size from those of the frame before starts again, like the first one. If the device fails for a
    frame, the later ones fail as well, because their results depend on it.

    >>> import numpy as np
    >>> from clpipe.chain.making import make_chain
    >>> from clpipe.chain.settings import Settings
    >>> from clpipe.engine.options import RunOptions
    >>> from clpipe.engine.runner import Runner
    >>> chain = make_chain(Settings(iso=3200, stages=("temporal_denoise",)))
    >>> runner, state = Runner(chain, None, encode=False, final=True), State()
    >>> frames = 0.2 + 0.005 * np.random.default_rng(0).normal(size=(20, 24, 32, 3))
    >>> results = [runner.run(frame, "", RunOptions(state=state)).image for frame in frames]
    >>> bool(results[-1].std() < 0.5 * frames.std())
    True

    Attributes:
        buffers: the buffers of the frame that is enqueued, by their names in its plan.
        is_lost: whether the device failed for a frame.
    """

    def __init__(self) -> None:
        self.buffers: dict[str, Any] = {}
        self.is_lost = False
        self._arrays: dict[str, Floats] = {}  # in NumPy, by step
        self._flow: Queue | None = None
        # The layout of the planes, which is () before the first frame.
        self._layout: Layout = ()
        # A frame reads one set of planes and writes the other, because a stencil reads neighbours.
        self._read: dict[str, Any] = {}
        self._written: dict[str, Any] = {}

    @property
    def bytes(self) -> int:
        """The bytes of all planes on the device."""
        return sum(plane.size for each in (self._read, self._written) for plane in each.values())

    def array(self, step: Step, shape: tuple[int, ...]) -> Floats | None:
        """Return a step's result for the frame before, in NumPy; None if none has this shape."""
        found = self._arrays.get(step.name)
        return found if found is not None and found.shape == shape else None

    def keep_array(self, step: Step, image: Floats) -> None:
        """Keep a step's result in NumPy, if the step has state."""
        if keeps_state(step):
            self._arrays[step.name] = image

    def is_first(self, plan: Plan, extents: Extents) -> bool:
        """Return whether the next frame is the first one, or differs in layout from the last."""
        return self._layout != layout_of(plan, extents)

    def begin_frame(self, flow: Queue, plan: Plan, extents: Extents) -> None:
        """Set :attr:`buffers` for a frame that is enqueued next. The next one reads its results.

        Raises:
            DeviceFailedError: the frame before is lost.
        """
        if self._flow not in (None, flow):
            self.is_lost = True
        self.check()
        if self.is_first(plan, extents):
            flow.drain()  # no command may use a buffer that is released
            self._read, self._written = {}, {}
        self._layout, self._flow, self.buffers = layout_of(plan, extents), flow, {}
        for step, before, after in plan.states:
            for image, planes in ((before, self._read), (after, self._written)):
                for channel, slot in enumerate(plan.slots[image.number] if image else ()):
                    name = f"{step} {channel}"
                    if name not in planes:
                        planes[name] = flow.new_buffer(extents[after.level].plane_bytes)
                    self.buffers[slot_buffer(slot)] = planes[name]
        self._read, self._written = self._written, self._read

    def check(self) -> None:
        """Check that the frame before is on the device.

        Raises:
            DeviceFailedError: it is not.
        """
        if self.is_lost:
            raise DeviceFailedError(
                "the device failed for an earlier frame of this sequence, whose result this frame "
                "needs. Run the sequence again"
            )
