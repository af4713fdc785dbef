"""Run clpipe on a Dask cluster of this machine's processors.

    pip install distributed
    python tools/examples/dask_local.py frames/ -o out --iso 3200

All arguments go to clpipe run. On one machine, clpipe run without Dask is simpler. This example
shows what a cluster needs. If a worker dies (try kill -9), no image is lost.
"""

import argparse

from clpipe.base.processors import available_processors
from clpipe.commands.main import main

if __name__ == "__main__":  # the workers import this file
    parser = argparse.ArgumentParser(
        description="Run clpipe on a Dask cluster of this machine.",
        epilog="All arguments go to clpipe run.",
    )
    arguments = parser.parse_known_args()[1]

    from distributed import LocalCluster

    processors = available_processors()
    # Each process has its own OpenCL device. Its threads decode and encode.
    with LocalCluster(
        n_workers=max(1, processors // 4),
        threads_per_worker=min(4, processors),
        dashboard_address=":0",
    ) as cluster:
        main(["run", *arguments, "--dask", cluster.scheduler_address])
