"""A training loop never repeats its noise: workers, epochs, ranks, processes and checkpoints."""

import copy
import itertools
import os
import pickle
import subprocess
import sys
import tarfile
from types import SimpleNamespace

import numpy as np
import pytest

import clpipe as api
from clpipe.base import workers
from clpipe.base.errors import RequestError
from clpipe.dataset import passes
from clpipe.dataset.passes import Passes
from clpipe.dataset.streaming import expand_braces
from tests.conftest import ROOT, run_python

STAGES = ["exposure", "mosaic", "sensor_noise", "quantize"]
OPTIONS = {"iso": 3200, "stages": STAGES, "cache": 0, "device": "numpy"}
TARS = 4


@pytest.fixture
def tars(write_exr, tmp_path, monkeypatch):
    """Tars with a render each, in the working directory; the renders are in "in"."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    for number in range(TARS):
        write_exr(f"in/r{number}.exr", np.full((8, 8, 3), 0.1 + 0.1 * number, np.float32))
        with tarfile.open(f"t-{number:02}.tar", "w") as tar:
            tar.add(f"in/r{number}.exr", f"r{number}.exr")
    return "t-{00..03}.tar"


def keys(samples):
    return [(sample["key"], sample["epoch"]) for sample in samples]


def noise(samples):
    return {sample["image"].tobytes() for sample in samples}


def in_worker(monkeypatch, number, count):
    """Make this process a worker of its own, as far as clpipe can see."""
    info = SimpleNamespace(id=number, num_workers=count, seed=70 + number)
    monkeypatch.setattr(workers, "_worker_info", lambda: info)
    monkeypatch.setattr(passes, "trainer", os.getpid)


def test_workers_that_end_after_each_pass_continue_to_count(tars, monkeypatch):
    dataset = api.StreamingDataset(tars, **OPTIONS)
    seen = [keys(dataset)]  # without workers
    for count in (1, 2, 2, 1):
        epoch = []
        for number in range(count):
            worker = pickle.loads(pickle.dumps(dataset))  # a new process each time
            with monkeypatch.context() as patch:
                in_worker(patch, number, count)
                epoch += keys(worker)
        seen.append(sorted(epoch))
    names = [f"t-{number:02}/r{number}.exr" for number in range(TARS)]
    assert seen == [[(name, epoch) for name in names] for epoch in range(5)]
    worker = pickle.loads(pickle.dumps(dataset))
    dataset.set_epoch(9)
    assert {epoch for _, epoch in keys(worker)} == {9}  # a persistent worker sees it
    assert {epoch for _, epoch in keys(dataset)} == {10}


def test_persistent_workers_of_a_dataset_see_the_epoch(tars):
    dataset = api.Dataset("in", **OPTIONS)
    worker = pickle.loads(pickle.dumps(dataset))
    first = worker[0]
    dataset.set_epoch(3)
    assert worker[0]["epoch"] == 3 and worker[0]["image"].tobytes() not in noise([first])
    part = dataset.shard(0, 2)
    part.set_epoch(5)
    assert (dataset[0]["epoch"], part[0]["epoch"]) == (3, 5)


def test_other_processes_count_for_themselves(monkeypatch):
    mine = Passes(2)
    other = pickle.loads(pickle.dumps(mine))
    with monkeypatch.context() as patch:
        patch.setattr(passes, "trainer", lambda: os.getpid() + 1)
        assert [other.begin(0, 1) for _ in range(3)] == [2, 3, 4]
    assert mine.epoch == 2
    with monkeypatch.context() as patch:
        patch.setattr(passes, "process_folder", lambda: None)
        assert [each.begin(0, 1) for each in (Passes(1), mine.copy())] == [1, 2]


def test_ranks_share_the_tars(tars, monkeypatch):
    dataset = api.StreamingDataset(tars, **OPTIONS)
    parts = [[key for key, _ in keys(dataset.shard(number, 3))] for number in range(3)]
    assert sorted(itertools.chain(*parts)) == [key for key, _ in keys(dataset)]
    assert [len(part) for part in parts] == [2, 1, 1]
    distributed = SimpleNamespace(
        is_available=lambda: True,
        is_initialized=lambda: True,
        get_rank=lambda: 1,
        get_world_size=lambda: 3,
    )
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "torch.distributed", distributed)
        assert [key for key, _ in keys(dataset)] == parts[1]
        spawned = pickle.dumps(dataset)
        in_order = api.Dataset("in", **OPTIONS)
        assert [key for key, _ in keys(in_order.shard())] == ["r1.exr"]
        assert len(in_order) == TARS  # PyTorch's sampler divides it
    assert [key for key, _ in keys(pickle.loads(spawned))] == parts[1]  # in a worker
    for arguments in ((3, 3), (None, 2), (1, None)):
        with pytest.raises(RequestError, match=r"found shard .*; expected"):
            dataset.shard(*arguments)
    with pytest.raises(RequestError, match="found 4 tars for 5 ranks"):
        list(dataset.shard(0, 5))


def test_more_workers_than_tars(tars, monkeypatch):
    dataset = api.StreamingDataset(tars, **OPTIONS)
    seen = []
    for number in range(TARS + 2):
        in_worker(monkeypatch, number, TARS + 2)
        seen.append(len(list(dataset)))
    assert seen == [1] * TARS + [0, 0]


@pytest.mark.parametrize("stop", [0, 1, 3, 4])
def test_a_stream_continues_where_its_state_was_saved(tars, stop):
    expected = [list(api.StreamingDataset(tars, epoch=2, **OPTIONS))]
    dataset = api.StreamingDataset(tars, epoch=2, **OPTIONS)
    expected.append(list(api.StreamingDataset(tars, epoch=3, **OPTIONS)))
    iteration = iter(dataset)
    for _ in range(stop):
        next(iteration)
    state = pickle.loads(pickle.dumps(dataset.state_dict()))
    resumed = api.StreamingDataset(tars, **OPTIONS)
    resumed.load_state_dict(state)
    assert resumed.state_dict() == state
    rest = list(resumed)
    assert keys(rest) == keys(expected[0][stop:])
    assert noise(rest) == noise(expected[0][stop:])
    assert keys(resumed) == keys(expected[1])
    iteration.close()
    assert keys(dataset) == keys(expected[bool(stop)])  # a pass that was ended early counts
    with pytest.raises(RequestError, match="belongs to a dataset with other tars"):
        api.StreamingDataset("t-00.tar", **OPTIONS).load_state_dict(state)


def test_workers_load_states_of_their_own(tars, monkeypatch):
    """As torchdata's StatefulDataLoader calls them, one after the other begins."""
    dataset, states, parts, expected = api.StreamingDataset(tars, epoch=4, **OPTIONS), [], [], []
    for number in range(2):
        worker = pickle.loads(pickle.dumps(dataset))
        in_worker(monkeypatch, number, 2)
        iteration = iter(worker)
        parts += [next(iteration)]
        states.append(worker.state_dict())
        expected += [*parts[-1:], *iteration]
    for number, state in enumerate(states):
        worker = pickle.loads(pickle.dumps(dataset))
        in_worker(monkeypatch, number, 2)
        worker.load_state_dict(state)
        parts += list(worker)
    assert sorted(keys(parts)) == sorted(keys(expected)) and noise(parts) == noise(expected)
    for number in range(2):
        in_worker(monkeypatch, number, 2)
        assert {epoch for _, epoch in keys(dataset)} == {5}


def test_a_state_belongs_to_its_worker(tars, monkeypatch):
    dataset = api.StreamingDataset(tars, **OPTIONS)
    next(iter(dataset))
    state = dataset.state_dict()
    in_worker(monkeypatch, 0, 2)
    dataset.load_state_dict(state)
    with pytest.raises(
        RequestError, match=r"worker 0 of 1, but this is rank 0 of 1, worker 0 of 2"
    ):
        list(dataset)


def test_braces_name_tars(tars):
    assert expand_braces("s-{9..11}{,b}.tar") == [
        f"s-{number}{end}.tar" for number in (9, 10, 11) for end in ("", "b")
    ]
    assert expand_braces("{2..0}") == ["2", "1", "0"] and expand_braces("{x}") == ["{x}"]
    os.rename("t-00.tar", "{0,1}.tar")  # a name that exists is not expanded
    assert len(list(api.StreamingDataset("{0,1}.tar", **OPTIONS))) == 1


CLEAN = np.full((16, 16), 0.3, np.float32)


def test_a_seeded_transform_draws_others_in_each_worker_epoch_and_process(monkeypatch):
    noisy = api.RawNoise("sony-a7r2", 3200, seed=4, device="numpy")
    first = noisy(CLEAN)
    seen = [first.tobytes(), noisy(CLEAN).tobytes()]
    for seed in (70, 71, 90):  # of two workers, and of one in the next epoch
        worker = pickle.loads(pickle.dumps(noisy))
        with monkeypatch.context() as patch:
            patch.setattr(workers, "_worker_info", lambda seed=seed: SimpleNamespace(seed=seed))
            seen.append(worker(CLEAN).tobytes())
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: 1)  # as after a fork
        seen.append(noisy(CLEAN).tobytes())
    with monkeypatch.context() as patch:
        process = SimpleNamespace(name="ForkPoolWorker-2")
        patch.setattr(workers, "current_process", lambda: process)
        seen.append(noisy(CLEAN).tobytes())
    monkeypatch.setenv("RANK", "1")
    seen.append(noisy(CLEAN).tobytes())
    assert len(set(seen)) == len(seen) == 8
    monkeypatch.delenv("RANK")
    assert noisy(CLEAN).tobytes() == seen[0]  # the main process starts again
    again = api.RawNoise("sony-a7r2", 3200, seed=4, device="numpy")
    np.testing.assert_array_equal(again(CLEAN), first)


LOADERS = """
import hashlib, itertools, sys
import torch
from torch.utils.data import DataLoader
import clpipe
from clpipe.torch import RawNoise

OPTIONS = {"iso": 3200, "stages": ["exposure", "mosaic", "sensor_noise", "quantize"], "cache": 0,
           "device": "numpy"}

class Planes(torch.utils.data.Dataset):
    def __init__(self, seed):
        self.noise = RawNoise("sony-a7r2", 3200, seed=seed)
    def __len__(self):
        return 4
    def __getitem__(self, index):
        return self.noise(torch.full((1, 8, 8), 0.2)).numpy().tobytes()

def same(batch):
    return batch

def loader(dataset, count, persistent, method, size=None):
    return DataLoader(dataset, batch_size=size, num_workers=count, collate_fn=same,
        persistent_workers=persistent, multiprocessing_context=method if count else None)

def digest(image):
    return hashlib.sha256(image.tobytes()).hexdigest()

def samples(each):
    return sorted((s["key"], s["epoch"], digest(s["image"])) for s in each)

if __name__ == "__main__":
    method = sys.argv[1]
    expected = None
    every = ((0, False), (1, False), (1, True), (2, False), (2, True))
    # Other methods than fork start slowly.
    settings = {"fork": every, "spawn": every[3:4], "forkserver": every[4:]}[method]
    for count, persistent in settings:
        setting = method, count, persistent
        stream = loader(clpipe.StreamingDataset("t-*.tar", **OPTIONS), count, persistent, method)
        dataset = clpipe.Dataset("in", **OPTIONS)
        indexed = loader(dataset, count, persistent, method)
        table = {"stream": [samples(stream) for _ in range(3)], "set_epoch": []}
        for epoch in (0, 1, 2):
            dataset.set_epoch(epoch)
            table["set_epoch"].append(samples(indexed))
        stream.dataset.set_epoch(1)
        assert samples(stream) == table["stream"][1], setting
        for epochs in table.values():
            assert [{e for _, e, _ in epoch} for epoch in epochs] == [{0}, {1}, {2}], setting
            assert len({d for epoch in epochs for _, _, d in epoch}) == 12, setting
        assert expected in (None, table), setting
        expected = table
        for seed in (None, 3) if method == "fork" else (None,):
            runs = []
            for _ in range(2):
                torch.manual_seed(5)
                planes = loader(Planes(seed), count, persistent, method)
                runs.append([list(planes) for _ in range(2)])
            assert len({p for epoch in runs[0] for p in epoch}) == 8, (setting, seed)
            assert runs[0] == runs[1], (setting, seed)  # torch.manual_seed determines it
    print("never the same twice")
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_loaders_epochs_and_workers(tars, method):
    pytest.importorskip("torch", reason="needs PyTorch, in the extra train")
    with open("loaders.py", "w") as file:
        file.write(LOADERS)
    assert run_python("loaders.py", method).stdout == "never the same twice\n"


RANK = """
import sys
import torch
import clpipe
from clpipe.torch import RawNoise
rank, port = map(int, sys.argv[1:])
torch.distributed.init_process_group("gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
torch.manual_seed(0)
names = [s["key"] for s in clpipe.StreamingDataset("t-*.tar", cache=0, device="numpy")]
noisy = RawNoise("sony-a7r2", 3200)(torch.full((1, 1, 8, 8), 0.2))
torch.distributed.barrier()
print(names, hash(noisy.numpy().tobytes()))
"""


@pytest.mark.slow
def test_two_ranks(tars, unused_port):
    pytest.importorskip("torch", reason="needs PyTorch, in the extra train")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "0"}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", RANK, str(rank), str(unused_port)],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    outputs = [process.communicate(timeout=300)[0] for process in processes]
    names, hashes = zip(*(output.strip().rsplit(" ", 1) for output in outputs), strict=True)
    assert names == ("['t-00/r0.exr', 't-02/r2.exr']", "['t-01/r1.exr', 't-03/r3.exr']")
    assert len(set(hashes)) == 2


@pytest.fixture
def unused_port():
    import socket

    with socket.socket() as opened:
        opened.bind(("127.0.0.1", 0))
        return opened.getsockname()[1]


def test_a_module_of_pytorch():
    torch = pytest.importorskip("torch", reason="needs PyTorch, in the extra train")
    from clpipe.torch import RawNoise

    add = RawNoise("sony-a7r2", {"log_uniform": [800, 3200]})
    clean = torch.full((2, 1, 16, 16), 0.3)
    model = torch.nn.Sequential(add, torch.nn.Identity()).eval().train()
    assert isinstance(add, torch.nn.Module) and not list(model.parameters())
    torch.manual_seed(1)
    first, second = model(clean), model(clean)
    torch.manual_seed(1)
    assert torch.equal(model(clean), first) and not torch.equal(first, second)
    for other in (pickle.loads(pickle.dumps(add)), copy.deepcopy(add)):
        torch.manual_seed(1)
        assert torch.equal(other(clean), first)
    for dtype in (torch.float16, torch.bfloat16, torch.float64):
        torch.manual_seed(1)
        noisy = model(clean.to(dtype))
        assert noisy.dtype == dtype
        assert torch.allclose(noisy.float(), first, atol=3 * torch.finfo(dtype).eps)
    with torch.autocast("cpu", torch.bfloat16):
        torch.manual_seed(1)
        assert torch.equal(model(clean), first)
    with pytest.raises(AttributeError, match="cannot set iso: a RawNoise is read-only"):
        add.iso = 100
