"""The results that files need of a chain, so that nothing else is computed."""

from collections.abc import Sequence
from typing import NamedTuple

from clpipe.chain.chain import Chain
from clpipe.chain.formats import DNG, FORMATS


class Results(NamedTuple):
    """What a runner makes: images of steps, the last image in eight bits, the last one in float."""

    keep: tuple[str, ...]
    encode: bool
    final: bool


def results_of(chain: Chain, formats: Sequence[str], keep: Sequence[str]) -> Results:
    """The results that formats and kept steps need.

    Args:
        chain: the chain.
        formats: of the last image, and of the raw.
        keep: names of steps; those that the chain has not are left out.

    Raises:
        RequestError: a DNG is needed, and the chain has no raw for one.
    """
    last = [FORMATS[name] for name in formats if name != DNG]
    steps = [step.name for step in chain.steps if step.name in keep]
    if DNG in formats:
        from clpipe.outputs.negative import dng_of  # and all that writes DNGs

        if raw := dng_of(chain).step:
            steps.append(raw)
    return Results(
        tuple(dict.fromkeys(steps)),
        encode=any(each.bits == 8 for each in last),
        final=any(each.bits > 8 for each in last),
    )
