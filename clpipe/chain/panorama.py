"""Chains whose image is the atlas of a panorama, seen through a wide lens."""

from clpipe.chain.chain import Chain
from clpipe.reference.panorama import Panorama
from clpipe.reference.projection import Projection
from clpipe.stages.projection import WideAngle


def with_panorama(chain: Chain, panorama: Panorama) -> Chain:
    """Return the chain for an image that is the atlas of a panorama.

    Plans and kernels differ from the ones for ``chain`` only in numbers.
    """
    methods = {s.name: s.method for s in chain.steps}
    wide = {k: m.with_panorama(panorama) for k, m in methods.items() if isinstance(m, WideAngle)}
    return chain.with_methods(wide)


def projection_of(chain: Chain) -> Projection | None:
    """Return the projection that is a chain's first move of pixels; None if there is none."""
    parts = chain.geometry.parts if chain.geometry else ()
    return parts[0] if parts and isinstance(parts[0], Projection) else None
