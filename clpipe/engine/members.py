"""The members of a pass through a device: what each stores of its source, and where results go.

A tile or a patch that goes by itself is the one member of its pass; a stack has several.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import Bind, slot_buffer, step_buffer
from clpipe.engine.buffers import HostImages, copy_encoded, copy_plane, core_of
from clpipe.engine.extents import Extent, Extents
from clpipe.engine.ir import Plan
from clpipe.engine.options import RunOptions

if TYPE_CHECKING:
    from clpipe.engine.flow import DeviceTile, Flow


@dataclass(frozen=True)
class ImageTask:
    """The work that is to be done to one image.

    Args:
        plan: the plan.
        source: the image, (height, width[, channel]).
        bind: gives the values of kernel parameters.
        output: where the results go.
        options: how, see :class:`RunOptions`.
    """

    plan: Plan
    source: Array
    bind: Bind
    output: HostImages
    options: RunOptions


@dataclass(frozen=True)
class Member:
    """A member of a pass.

    Args:
        extents: its place on each level.
        task: of its image.
        patch: which of the image's patches it is; None is the image, or a tile of it.
    """

    extents: Extents
    task: ImageTask
    patch: int | None = None

    @property
    def pixels(self) -> Array:
        """What it stores of the source, as the plan reads it."""
        box = self.extents[0].stored
        pixels = self.task.source[box.top : box.bottom, box.left : box.right]
        return pixels.transpose(2, 0, 1) if self.task.plan.planar else pixels

    @property
    def dtype(self) -> Any:
        """The type of the source's samples on the device."""
        return np.float16 if self.task.plan.half else np.float32

    def room(self, result: Array, extent: Extent) -> Array:
        """Where what it makes belongs in its image's result."""
        return core_of(extent, result) if self.patch is None else result[self.patch]


def fetch_results(
    flow: "Flow",
    sent: "DeviceTile",
    members: Sequence[Member],
    strides: Mapping[str, int],
    ends: Mapping[str, Any],
    after: list[Any],
    estimates: bool = True,
) -> None:
    """Fetch the results of members of one plan, when launches are done.

    Args:
        flow: whose buffers hold them.
        sent: gets the copies that are to be made when it lands.
        members: the members.
        strides: bytes from a member to the next in each buffer; one has none.
        ends: the buffers that are no pool's, "dst" of them.
        after: the events of the launches.
        estimates: whether what was estimated from the image is fetched, too.
    """
    plan, output = members[0].task.plan, members[0].task.output
    buffers = {**flow.pool.buffers, **ends}

    def parts(name: str, sizes: Sequence[int]) -> list[Array]:
        stride = strides.get(name, 0)
        size = stride * (len(members) - 1) + sizes[-1]
        whole = flow.fetch(sent, name, buffers[name], size, after)
        return [whole[n * stride : n * stride + own] for n, own in enumerate(sizes)]

    last = [member.extents[-1] for member in members]
    if plan.encoded and not last[0].core.is_empty:
        samples = len(plan.encoded.channels)
        sizes = [each.stored.width * each.stored.height * samples for each in last]
        for member, extent, pixels in zip(members, last, parts("dst", sizes), strict=True):
            encoded = member.task.output.encoded
            assert encoded is not None
            room = member.room(encoded, extent)
            sent.copies.append(partial(copy_encoded, extent, pixels, room))
    for number in output.images:
        own = [member.extents[plan.level_of(number)] for member in members]
        if own[0].core.is_empty:
            continue
        sizes = [extent.plane_bytes for extent in own]
        for channel, slot in enumerate(plan.slots[number]):
            found = parts(slot_buffer(slot), sizes)
            for member, extent, plane in zip(members, own, found, strict=True):
                room = member.room(member.task.output.images[number], extent)
                copy = partial(copy_plane, extent, plane.view(np.float32), room, channel)
                sent.copies.append(copy)
    for step, values in output.estimates.items() if estimates else ():
        found = parts(step_buffer("estimates", step), [values.nbytes] * len(members))
        for member, part in zip(members, found, strict=True):
            to = member.task.output.estimates[step]
            sent.copies.append(partial(np.copyto, to, part.view(to.dtype)))
