"""The sizes of work-groups, blocks and reductions, by the lanes of a device. Pure."""

from clpipe.engine.ir import AnyLaunch, Border, Finalize, Launch

PARTIALS = 256  # the number of partial sums or partial histograms of a reduction
RUN = 64  # the number of consecutive histogram bins whose sum is also stored


def round_up(value: int, step: int) -> int:
    """Return the smallest multiple of ``step`` that is at least ``value``."""
    return -(-value // step) * step


def local_size(lanes: int) -> int:
    """Return the work items per work-group. On a GPU, 64 would not fill a multiprocessor."""
    return 128 if lanes == 1 else 64


def group_size(launch: AnyLaunch | Border, lanes: int) -> int:
    """Return the work items per work-group of a launch. A strip of bands is a group by itself."""
    is_one = isinstance(launch, Finalize) or (isinstance(launch, Launch) and launch.bands)
    return 1 if is_one else local_size(lanes)


def summed_together(lanes: int) -> int:
    """Return the work items that share one sum: a work-group on a GPU, one work item on a CPU."""
    return local_size(lanes) if lanes == 1 else 1


def columns_of(launch: AnyLaunch | Border, lanes: int) -> int:
    """Return the vectors per row of a work item's block: on a GPU one, for coalesced accesses."""
    return launch.columns if isinstance(launch, Launch) and lanes > 1 else 1
