"""Spectral renders whose pixels have only the sums that a mosaic needs."""

from dataclasses import replace

from clpipe.base.errors import KeyedError
from clpipe.chain.chain import Chain, Step
from clpipe.stage import Pointwise, StageRole
from clpipe.stages.spectral_response import CameraResponse


def steps_to_mosaic(chain: Chain) -> tuple[Step, ...] | None:
    """Return the steps from the spectral response to the mosaic, without both; None without them.

    The chain begins with the spectral response of the camera.
    """
    if not chain.bands or not isinstance(chain.steps[0].method, CameraResponse):
        return None
    roles = [step.stage.role for step in chain.steps]
    return chain.steps[1 : roles.index(StageRole.PATTERN)] if StageRole.PATTERN in roles else None


def _is_by_pixel(step: Step) -> bool:
    """Return whether a step scales all colours of a pixel alike, without regard to others."""
    scales = step.stage.role in (StageRole.EXPOSURE, StageRole.FALLOFF)
    return not step.passes or (
        scales and all(isinstance(each.access, Pointwise) for each in step.passes)
    )


def with_site_sums(chain: Chain, keep: tuple[str, ...] = ()) -> Chain:
    """Return the chain with only the sum for each pixel that its site in the mosaic needs.

    The mosaic is the same. The chain itself is returned if a step mixes pixels or colours before
    the mosaic, or if an image before it is kept.
    """
    between = steps_to_mosaic(chain)
    if between is None or not all(map(_is_by_pixel, between)):
        return chain
    first = chain.steps[0]
    if {first.name, *(step.name for step in between)} & {*keep}:
        return chain
    method = first.method
    assert isinstance(method, CameraResponse)
    found = chain.with_methods({first.name: method.at_sites(first.context.array_ahead)})
    return replace(found, names=chain.names)


def with_enough_planes(chain: Chain) -> Chain:
    """Return the chain with one sum for each site if the filter array has too many channels.

    Raises:
        KeyedError: a step before the mosaic needs all channels of a pixel, or the chain reads bands
            after its first step.
    """
    for step in chain.steps[1:]:
        if step.stage.role is StageRole.SPECTRUM and step.passes:
            raise KeyedError(
                step.name, f"{step.name}: it reads the render itself; list it as the first stage"
            )
    first = chain.steps[0]
    if not chain.bands or first.method.next_context(first.context).planes:
        return chain
    array, between = first.context.array_ahead, steps_to_mosaic(chain)
    channels = ", ".join(array.channels)
    if between is None:
        last = chain.steps[-1].name
        raise KeyedError(
            last,
            f"{last}: of a spectral render at most three channels are computed before the mosaic, "
            f"and {array.name} has {channels}; end the chain at the mosaic or later",
        )
    for step in between:
        if not _is_by_pixel(step):
            raise KeyedError(
                step.name,
                f"{step.name}.method={step.method.method}: this step before the mosaic needs all "
                f"channels of a pixel, but of a spectral render at most three are computed, and "
                f"{array.name} has {channels}; skip {step.name}",
            )
    return with_site_sums(chain)
