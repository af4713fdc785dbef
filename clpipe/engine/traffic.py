"""How many bytes the launches of a plan move. Pure."""

from clpipe.engine.plan import AnyLaunch, Launch, Plan, Reduce, reads_of
from clpipe.stage import Access


def launch_bytes(plan: Plan, launch: AnyLaunch, lanes: int) -> float:
    """Bytes per pixel that a launch reads and writes in device memory, each sample once."""
    if isinstance(launch, Reduce) and launch.op.pass_.access is Access.SUMS:
        return 16 / (lanes * 4) * plan.share(launch.level)
    images = [read.image for read in reads_of(launch)]
    total = sum(4 * len(i.kind.channels) * plan.share(i.level) for i in images)
    if not isinstance(launch, Launch):
        return total
    if not launch.reads:
        total += len(plan.source.channels) * (2 if plan.half else 4)
    written = 0.0
    if launch.writes:
        written += 4 * len(launch.writes.kind.channels)
    if launch.encodes and plan.encoded:
        written += len(plan.encoded.channels)
    if launch.sums:
        written += 16 / (lanes * launch.rows)
    return total + written * plan.share(launch.level)
