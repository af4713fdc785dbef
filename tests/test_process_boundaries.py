"""Objects in other processes: fork is rejected at once, spawn and forkserver work."""

import os
import pickle

import numpy as np
import pytest

from clpipe import Pipeline, Stream
from tests.conftest import STILL_LIFE, run_python
from tests.test_registry import OPENCL, PYTHON

RENDER = np.full((16, 24, 3), 0.2, np.float32)

POOL = """
import multiprocessing, sys
import numpy as np
import clpipe

render = np.full((16, 24, 3), 0.2, np.float32)

def develop(camera, key):
    return camera(render, key).image.tobytes()

def sample(samples):
    return samples[0]["image"].tobytes()

if __name__ == "__main__":
    method, path = sys.argv[1:]
    camera = clpipe.Pipeline(iso=1600, stages=["exposure", "mosaic", "sensor_noise", "quantize"])
    samples = clpipe.Dataset(path, stages=["exposure", "mosaic", "sensor_noise", "quantize"])
    mine = [develop(camera, key) for key in "ab"], sample(samples)
    with multiprocessing.get_context(method).Pool(1) as pool:
        shots = pool.starmap(develop, [(camera, key) for key in "ab"])
        assert mine == (shots, pool.apply(sample, (samples,)))
    print("equal")
"""

FORK = """
import os, pickle, signal, sys
import numpy as np
import clpipe

path = sys.argv[1]
render = np.full((16, 24, 3), 0.2, np.float32)
stages = ["exposure", "mosaic", "sensor_noise", "quantize"]
camera = clpipe.Pipeline(stages=stages)
samples = clpipe.Dataset(path, stages=stages)
stream = clpipe.Stream(stages=stages)
alone = clpipe.Stream(device="numpy", stages=stages)
camera(render), samples[0], stream(render), alone.put(render), alone.get()
data = pickle.dumps(camera)
calls = {
    "process": lambda: camera(render),
    "process_many": lambda: list(camera.process_many([render])),
    "carry": lambda: camera.carry(render[..., 0], "depth"),
    "pickle": lambda: pickle.loads(data),
    "Pipeline": lambda: clpipe.Pipeline(stages=stages),
    "sample": lambda: samples[0],
    "iterate": lambda: list(samples),
    "Stream": lambda: clpipe.Stream(stages=stages),
    "call": lambda: stream(render),
    "put": lambda: stream.put(render),
    "get": lambda: stream.get(),
    "warm_up": lambda: stream.warm_up(render.shape),
    "finish": lambda: stream.finish(),
    "NumPy's": lambda: alone.get(),
    "run": lambda: list(clpipe.run(path, "out")),
}
child = os.fork()
if child:
    sys.exit(os.waitpid(child, 0)[1])
signal.alarm(120)  # a hang ends the child
for name, call in calls.items():
    try:
        call()
        print(name, "no error")
    except clpipe.ClpipeError as error:
        print(name, error)
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_pipelines_and_datasets_work_in_other_processes(device, tmp_path, method):
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    assert run_python(script, method, STILL_LIFE).stdout == "equal\n"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork (Linux or macOS)")
def test_every_entry_point_rejects_a_fork_at_once(device, tmp_path):
    script = tmp_path / "fork.py"
    script.write_text(FORK)
    lines = run_python(script, STILL_LIFE, cwd=tmp_path).stdout.splitlines()
    assert len(lines) == FORK.count('": lambda')
    assert [line for line in lines if "this process was forked from" not in line] == []


def test_a_copy_of_a_pipeline_gives_the_same_bits(device):
    draws = {"iso": {"choice": [100, 800, 6400]}, "exposure": {"ev": {"uniform": [0, 1]}}}
    camera = Pipeline("training", until="quantize", keep="mosaic", seed=4, **draws)
    list(camera.process_many([RENDER]))
    copied = pickle.loads(pickle.dumps(camera))
    assert copied.settings.record() == camera.settings.record()
    for shot, other in zip(
        camera.process_many([RENDER] * 3), copied.process_many([RENDER] * 3), strict=True
    ):
        np.testing.assert_array_equal(shot.image, other.image)
        np.testing.assert_array_equal(shot.kept["mosaic"], other.kept["mosaic"])


def test_a_stream_says_why_it_cannot_be_pickled():
    with Stream(device="numpy") as stream, pytest.raises(TypeError, match="in each process"):
        pickle.dumps(stream)


@pytest.mark.slow
def test_a_pickled_pipeline_loads_its_stage_file(tmp_path):
    (tmp_path / "vignette.py").write_text(PYTHON)
    (tmp_path / "vignette.cl").write_text(OPENCL)
    config = tmp_path / "pipeline.toml"
    config.write_text('stage_files = ["vignette.py"]\nstages = ["exposure", "vignette"]\n')
    pickled = tmp_path / "camera.pickle"
    save = f"""
import pickle, clpipe
camera = clpipe.Pipeline({str(config)!r}, device="numpy")
open({str(pickled)!r}, "wb").write(pickle.dumps(camera))
print(camera.chain.step_names)"""
    load = f"""
import pickle
print(pickle.load(open({str(pickled)!r}, "rb")).chain.step_names)"""
    assert run_python("-c", save).stdout == run_python("-c", load).stdout
