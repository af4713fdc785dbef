"""Run clpipe on a Dask cluster of machines that you reach by SSH.

    pip install distributed asyncssh
    HOSTS="node1 node2 node3" python tools/examples/dask_ssh.py /data/frames -o /data/out --iso 3200

All arguments go to clpipe run. Each host starts a worker, and the first one also the scheduler. The
hosts need:

- a login by key, and an entry in known_hosts
- the same versions of clpipe and distributed, in a Python at the same path as here
- the inputs, the output directory and the current folder at the same paths
- OpenCL devices of the same kind
"""

import argparse
import os
import sys

from clpipe.commands.main import main

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="Run clpipe on a Dask cluster of the machines in HOSTS.",
        epilog="All arguments go to clpipe run.",
    )
    arguments = parser.parse_known_args()[1]

    from distributed import SSHCluster

    first, *others = os.environ["HOSTS"].split()
    with SSHCluster(
        [first, first, *others],  # the first is for the scheduler
        remote_python=sys.executable,
        worker_options={"nthreads": 4},  # for decoding and encoding
        scheduler_options={"port": 8786, "dashboard_address": ":0"},
    ) as cluster:
        main(["run", *arguments, "--dask", cluster.scheduler_address])
