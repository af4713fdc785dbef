"""Numbers of work items and of lanes, and where planes begin for them. Pure."""

from clpipe.engine.ir import AnyLaunch, Border, Launch

PARTIALS = 256  # sums or histograms that a reduction's first half leaves
RUN = 64  # bins of a histogram that are also added up


def round_up(value: int, step: int) -> int:
    """The smallest multiple of ``step`` that is not below ``value``."""
    return -(-value // step) * step


def local_size(lanes: int) -> int:
    """Work items of a work-group. On a GPU, 64 would not fill a multiprocessor."""
    return 128 if lanes == 1 else 64


def summed_together(lanes: int) -> int:
    """Work items that store one sum: on a GPU a work-group, on a CPU, where they are few, one."""
    return local_size(lanes) if lanes == 1 else 1


def columns_of(launch: AnyLaunch | Border, lanes: int) -> int:
    """Vectors side by side in a work item's block: on a GPU one, so that work items share lines."""
    return launch.columns if isinstance(launch, Launch) and lanes > 1 else 1
