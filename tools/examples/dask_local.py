"""A Dask cluster of this machine's processors, and a run of clpipe on it.

    pip install distributed
    python tools/examples/dask_local.py frames/ -o out --iso 3200

All arguments go to clpipe run. On one machine clpipe alone does the same with less ado: this shows
what a cluster needs, and a worker that dies (try: kill -9 it) takes nothing with it.
"""

import sys

from distributed import LocalCluster

from clpipe.base.processors import available_processors
from clpipe.commands.main import main

if __name__ == "__main__":  # the workers import this file
    processors = available_processors()
    # Processes, each with its own OpenCL device; their threads are for decoding and encoding.
    with LocalCluster(
        n_workers=max(1, processors // 4),
        threads_per_worker=min(4, processors),
        dashboard_address=":0",
    ) as cluster:
        main(["run", *sys.argv[1:], "--dask", cluster.scheduler_address])
