"""The recipe for LeRobot datasets, read back as LeRobot's layout v3.0 says."""

import json

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

import clpipe
from tests.conftest import ROOT
from tests.markdown import blocks

PAGE = ROOT / "docs" / "robotics.md"
VIDEO = "observation.images.front"


def test_a_dataset_has_the_pictures_and_tables(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    [recipe] = [block.text for block in blocks(PAGE) if "pyarrow" in block.text]
    assert len(recipe.splitlines()) < 80
    exec(compile(recipe, str(PAGE), "exec"), {"np": np, "clpipe": clpipe})
    folder = tmp_path / "dataset"
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == (
        "v3.0",
        2,
        30,
    )
    place = {"chunk_index": 0, "file_index": 0}
    rows = pq.read_table(folder / info["data_path"].format(**place)).to_pylist()
    assert set(rows[0]) == set(info["features"]) - {VIDEO}
    assert [row["index"] for row in rows] == list(range(30))
    assert rows[16]["timestamp"] == pytest.approx(1 / 30) and rows[16]["episode_index"] == 1
    file = folder / info["video_path"].format(video_key=VIDEO, **place)
    with av.open(str(file)) as video:
        frames = [each.to_ndarray(format="rgb24") for each in video.decode(video=0)]
    assert len(frames) == 30 and frames[0].shape == (96, 128, 3)
    with clpipe.Stream(name="episode1", iso=800) as camera:
        for step in range(15):
            shot = camera(np.full((96, 128, 3), 0.02 * step, np.float32))
            difference = np.abs(shot.image.astype(float) - frames[15 + step])
            assert difference.mean() < 8, step
    [episodes] = [
        pq.read_table(path) for path in sorted((folder / "meta/episodes").rglob("*.parquet"))
    ]
    assert episodes["dataset_to_index"].to_pylist() == [15, 30]
    assert episodes[f"videos/{VIDEO}/from_timestamp"].to_pylist() == [0, 0.5]
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert tasks["task"].to_pylist() == ["push the block"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    stats = json.loads((folder / "meta/stats.json").read_text())
    assert stats["action"]["mean"] == [1.0, 0.5] and stats["action"]["count"] == [30]
