"""The recipe for ROS 2 bags, read back."""

import numpy as np
from rosbags.highlevel import AnyReader

import clpipe
from clpipe.camera.profile import load_camera
from tests.conftest import ROOT
from tests.markdown import blocks

PAGE = ROOT / "docs" / "robotics.md"


def test_a_bag_has_the_raws_and_their_camera(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    [recipe] = [block.text for block in blocks(PAGE) if "rosbags" in block.text]
    exec(compile(recipe, str(PAGE), "exec"), {"np": np, "clpipe": clpipe})
    lens = {"method": "brown_conrady", "fx": 110, "k1": 0.05}
    with (
        AnyReader([tmp_path / "bag"]) as bag,
        clpipe.Stream(until="quantize", iso=800, distortion=lens) as camera,
    ):
        read = {topic: [] for topic in ("/camera/image_raw", "/camera/camera_info")}
        for connection, time, data in bag.messages():
            read[connection.topic].append((time, bag.deserialize(data, connection.msgtype)))
        for step, ((time, image), (_, info)) in enumerate(zip(*read.values(), strict=True)):
            shot = camera(np.full((72, 128, 3), 0.1, np.float32))
            stamp = image.header.stamp
            assert time == stamp.sec * 10**9 + stamp.nanosec == round(step / 30 * 1e9)
            assert image.encoding == "bayer_rggb16" and image.step == 256
            raw = image.data.view(np.uint16).reshape(image.height, image.width)
            assert np.array_equal(raw, shot.image)
            assert info.distortion_model == "plumb_bob"
            assert info.k.tolist() == [110, 0, 63.5, 0, 110, 35.5, 0, 0, 1]
            assert info.p.reshape(3, 4)[:, :3].ravel().tolist() == info.k.tolist()
            assert info.d.tolist() == [0.05, 0, 0, 0, 0]
        assert step == 4
    assert raw.mean() > load_camera("sony-a7r2").black_level
