"""Sequences: the order of frames, draws and drifts, control loops, and runs of them."""

import json
import math
import re
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

import clpipe
from clpipe.base.errors import RequestError
from clpipe.base.memory import FreeMemory
from clpipe.batch import memory_budget, threads
from clpipe.camera.control import AutoExposure, Control, ControlLoop
from clpipe.chain.drawing import draw_values
from clpipe.chain.draws import Drift
from clpipe.chain.files import load_settings
from clpipe.chain.limits import Limits
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.manifest import read_manifest
from clpipe.inputs.metering import write_exposures
from clpipe.inputs.sequences import in_sequences, summary
from clpipe.inputs.subframes import weights_of
from clpipe.reference.geometry import NO_MARGINS
from clpipe.stages import DEFAULT_CHAIN
from clpipe.stages.shutter import Rows
from tests.conftest import ROOT

LOOPS = {"exposure": {"method": "auto"}, "white_balance": {"method": "gray_world"}}


def placed(*names):
    """The sequences of files, each with the keys and places of its frames."""
    found = {}
    for job in in_sequences([Job(Path(name), name) for name in names]):
        found.setdefault(job.place.sequence, []).append((job.key, job.place.index))
    return found


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        # Numbers are sorted as numbers, with their sign.
        (["f.10.exr", "f.9.exr"], {"f": [("f.9.exr", 0), ("f.10.exr", 1)]}),
        (["f_-1.exr", "f_0.exr", "f_-2.exr"], {"f": [(f"f_{n}.exr", n + 2) for n in (-2, -1, 0)]}),
        (["f-1.exr", "f-2.exr"], {"f": [("f-1.exr", 0), ("f-2.exr", 1)]}),
        # Every second frame is a sequence without gaps.
        (["1.exr", "5.exr", "3.exr"], {"frames": [("1.exr", 0), ("3.exr", 1), ("5.exr", 2)]}),
        (["1.exr", "4.exr", "2.exr"], {"frames": [("1.exr", 0), ("2.exr", 1), ("4.exr", 3)]}),
        # A directory gives its name to its only sequence.
        (["a/x1.exr", "b/x1.exr"], {"a": [("a/x1.exr", 0)], "b": [("b/x1.exr", 0)]}),
        (
            ["a/l1.exr", "a/r1.exr", "a/l2.exr"],
            {"a/l": [("a/l1.exr", 0), ("a/l2.exr", 1)], "a/r": [("a/r1.exr", 0)]},
        ),
        # The number with the most values counts frames, or else the one with the most digits.
        (
            ["t1_cam0.exr", "t2_cam0.exr", "t3_cam0.exr", "t1_cam1.exr"],
            {
                "t_cam0": [("t1_cam0.exr", 0), ("t2_cam0.exr", 1), ("t3_cam0.exr", 2)],
                "t_cam1": [("t1_cam1.exr", 0)],
            },
        ),
        (
            [f"f{n:04}_c{c}.exr" for n in (1, 2) for c in (0, 1)],
            {f"f_c{c}": [(f"f000{n}_c{c}.exr", n - 1) for n in (1, 2)] for c in (0, 1)},
        ),
        (["b.exr", "a.exr"], {"frames": [("b.exr", 0), ("a.exr", 1)]}),
    ],
)
def test_names_give_frames_their_places(names, expected):
    assert placed(*names) == expected


def test_two_frames_of_one_number_are_rejected():
    with pytest.raises(RequestError, match=r"f_1.exr and f_01.exr are both frame 1 of .* f; rem"):
        placed("f_1.exr", "f_01.exr")


def test_gaps_are_reported(caplog):
    placed(*(f"f{n}.exr" for n in (1, 2, 4, 5, 9)))
    assert "f: 4 of 9 frames are missing: 3, 6 to 8" in caplog.text


def test_a_loop_follows_with_delay_smoothing_and_limit():
    step = [0.0] * 3 + [4.0] * 200
    loop = ControlLoop(Control(delay=3, smoothing=5.0, speed=0.0, hysteresis=0.0))
    found = [loop.next(value) for value in step]
    expected = [0.0] * 6 + [4 * (1 - math.exp(-n / 5)) for n in range(1, 198)]
    assert found == pytest.approx(expected)
    loop = ControlLoop(Control(delay=0, smoothing=0.0, speed=0.25, hysteresis=0.0))
    assert max(np.diff([loop.next(value) for value in step])) == pytest.approx(0.25)


def test_a_loop_ignores_changes_within_its_hysteresis():
    loop = ControlLoop(Control(delay=0, smoothing=0.0, speed=0.0, hysteresis=0.2))
    assert [loop.next(v) for v in (1.0, 1.15, 0.85, 1.25, 1.1)] == [1.0, 1.0, 1.0, 1.25, 1.25]


def isos_of(auto, evs):
    return [auto.next(ev, 200.0, 0.01).iso for ev in evs]


def test_auto_iso_is_in_thirds_of_a_stop_and_does_not_flutter():
    auto = AutoExposure((50, 6400), Control(iso_max=3200.0, iso_min=100.0))
    isos = isos_of(auto, np.linspace(-3, 6, 400))
    assert (min(isos), max(isos)) == pytest.approx((100, 3200))
    assert {round(3 * math.log2(iso / 100), 6) % 1 for iso in isos} == {0}
    [highest] = isos_of(AutoExposure((200, 1600), Control(iso_max=3200.0)), [9.0])
    assert highest == pytest.approx(1600)
    auto = AutoExposure((50, 6400), Control(iso_max=3200.0))
    assert len({*isos_of(auto, [0.5 + 0.08 * (-1) ** n for n in range(20)])}) == 1


EVS = np.linspace(-6, 12, 700)


@pytest.mark.parametrize("mains", [None, 50.0, 60.0])
@pytest.mark.parametrize("time_max", [None, 0.004, 0.01, 0.033])
def test_auto_exposure_lengthens_the_time_and_then_raises_the_iso(mains, time_max):
    control = Control(iso_max=3200.0, time_max=time_max, mains=mains)
    auto = AutoExposure((50, 6400), control)
    iso, time = 200.0, 0.01
    for ev in EVS:
        found = auto.next(float(ev), iso, time)
        light = math.log2(found.time / time * found.iso / iso)
        assert light == pytest.approx(found.ev)  # time and ISO supply all of the exposure
        assert 200 <= found.iso <= 3200.001
        longest = time_max or time
        if time_max:
            assert found.time <= longest * (1 + 1e-9)
        else:
            assert found.ev == pytest.approx(ev)
        halves = found.time * 2 * (mains or 0)
        assert halves < 1 or halves == pytest.approx(round(halves))
        longest_used = (
            longest - longest % (0.5 / mains) if mains and longest * mains > 0.5 else longest
        )
        if found.ev < ev - 1e-9:  # as bright as it gets
            assert found.iso == pytest.approx(3200) and found.time == pytest.approx(longest_used)
        if found.iso > 401:  # less than a stop makes up for steps of the time
            assert found.time >= longest_used * 2 ** (-2 / 3) * (1 - 1e-9)


def test_mains_needs_auto_iso():
    with pytest.raises(RequestError, match="mains needs iso_max"):
        clpipe.Stream(device="numpy", control={"mains": 50.0})


BANDED = {"line_time": 1e-3, "flicker_depth": 1.0, "flicker_frequency": 100.0}


def test_anti_flicker_leaves_no_bands():
    scene = np.full((24, 32, 3), 0.01, np.float32)
    options = {"exposure": {"method": "auto"}, "shutter": BANDED, "iso": 100, "device": "numpy"}
    options |= {"render": {"exposure_time": 0.004}, "stages": ["shutter", "exposure", "gamma"]}
    loops = {"iso_max": 3200.0, "time_max": 0.015}
    bands, times = [], []
    for mains in ({}, {"mains": 50.0}):
        with clpipe.Stream(control={**loops, **mains}, **options) as stream:
            shot = stream(scene)
        bands.append(np.ptp(shot.image[:, 16, 1].astype(int)))
        times.append(shot.camera.exposure_time)
        assert shot.settings["render"]["exposure_time"] == pytest.approx(times[-1])
        assert shot.camera.row_time == 1e-3
    assert bands[0] > 10 and bands[1] <= 1
    assert 0.0094 < times[0] <= 0.015 and times[1] == pytest.approx(0.01)


def test_the_time_of_auto_exposure_is_written_and_read_back(frames, tmp_path):
    """The manifest of a run repeats its pictures, and all that states the time is changed."""
    control = {"delay": 1, "smoothing": 1.0, "iso_max": 800.0, "time_max": 0.02}
    options = {"control": control, "shutter": {**BANDED, "exposure_time": 0.01}, **LOOPS}
    options |= {"dark_current": {"exposure_time": 0.01}, "iso": 200}
    run(tmp_path, "out", sequence=True, **options)
    times = set()
    for path in sorted((tmp_path / "out/a").glob("*.json")):
        steps, sidecar = chain_of(path), json.loads(path.read_text())
        found = {steps[name]["parameters"]["exposure_time"] for name in ("shutter", "dark_current")}
        found |= {sidecar["camera_info"]["exposure_time"]}
        assert max(found) == pytest.approx(min(found), rel=1e-6), found
        times |= found
    assert len(times) > 3
    del options["control"]
    list(clpipe.run(tmp_path / "out/run.csv", tmp_path / "again", device="numpy", **options))
    assert pictures(tmp_path / "again") == pictures(tmp_path / "out")


def test_rows_of_sub_frames_follow_the_time_of_auto_exposure():
    lights = [np.full((16, 16, 3), level, np.float32) for level in (0.01, 0.03, 0.06)]
    options = {"exposure": {"method": "auto"}, "device": "numpy", "iso": 100}
    options |= {"stages": ["shutter", "exposure", "gamma"], "until": "exposure"}
    shutter = {"subframes": 3, "line_time": 1e-3, "exposure_time": 0.004}
    with clpipe.Stream(control={"time_max": 0.03}, shutter=shutter, **options) as stream:
        shot = stream(lights)
    own = Rows(**{**shutter, "exposure_time": shot.camera.exposure_time})
    rows = weights_of(own, 3, 16, NO_MARGINS).T @ [0.01, 0.03, 0.06]
    expected = rows * 2 ** (shot.settings["exposure"]["ev"] - 1)
    assert shot.camera.exposure_time > 0.0055
    assert shot.image[:, 8, 1] == pytest.approx(expected, rel=1e-4)


def test_a_drift_is_uniform_and_slow():
    draws = {"iso": Drift(drift=(100, 200), frames=20)}
    drawn = np.array(
        [
            [draw_values(draws, {}, lambda _: Limits(), f"draw:{s}", n)["iso"] for n in range(61)]
            for s in range(300)
        ]
    )
    assert np.histogram(drawn[:, ::20], 4, (100, 200))[0] == pytest.approx(300, abs=60)
    assert np.histogram(drawn[:, 10], 4, (100, 200))[0] == pytest.approx(75, abs=30)
    assert abs(np.diff(drawn)).max() < 20
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 60])[0, 1]) < 0.2


def test_the_documented_defaults_of_the_loops_are_those_of_the_code():
    page = (ROOT / "docs" / "sequences.md").read_text()
    table = page[page.index("| parameter |") : page.index("loops.toml")]
    rows = dict(re.findall(r"^\| `(\w+)` \| .* \| ([^|]+) \|$", table, re.MULTILINE))
    defaults = {name: field.default for name, field in Control.model_fields.items()}
    in_words = {"iso_max": "none", "iso_min": "the ISO that is set", "mains": "none"}
    in_words["time_max"] = "the time that is set"
    assert rows == {
        name: in_words[name] if default is None else f"{default:g}"
        for name, default in defaults.items()
    }


def test_video_is_the_default_chain_with_temporal_denoising():
    stages = [*load_settings("video").stages]
    stages.remove("temporal_denoise")
    assert tuple(stages) == DEFAULT_CHAIN


@pytest.fixture
def frames(write_exr):
    """Ten frames of two cameras, which become brighter, without one."""
    scene = np.random.default_rng(0).uniform(0.01, 0.2, (24, 32, 3))
    for camera in "ab":
        for number in {*range(10)} - {6}:
            light = 4 if number > 2 else 1
            colour = np.float32([1, 1, 1 + 0.1 * number])
            write_exr(f"frames/{camera}/{number}.exr", scene * light * colour)


def run(tmp_path, out, **options):
    made = clpipe.run(tmp_path / "frames", tmp_path / out, device="numpy", **options)
    statuses = [outcome.status for outcome in made]
    assert not made.summary.counts["failed"]
    return statuses


def chain_of(sidecar):
    return {step["name"]: step for step in json.loads(sidecar.read_text())["stages"]}


def pictures(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*.jpg"))}


def test_without_loops_and_draws_frames_are_those_of_single_images(frames, tmp_path):
    run(tmp_path, "one", iso=800)
    run(tmp_path, "two", iso=800, sequence=True)
    assert pictures(tmp_path / "one") == pictures(tmp_path / "two")


def test_the_loops_of_a_run_are_those_of_the_formula(frames, tmp_path):
    control = {"delay": 1, "smoothing": 2.0, "speed": 0.0, "hysteresis": 0.0, "iso_max": 800.0}
    run(tmp_path, "single", **LOOPS)
    run(tmp_path, "out", sequence=True, control=control, iso=400, **LOOPS)
    loop = ControlLoop(Control(**control))
    for number in range(10):
        # Frame 6 is missing, and counts like frame 5.
        single = chain_of(tmp_path / f"single/a/{5 if number == 6 else number}.json")
        expected = loop.next(single["exposure"]["estimates"]["metered_ev"])
        if number != 6:
            own = chain_of(tmp_path / f"out/a/{number}.json")
            assert own["exposure"]["parameters"]["ev"] == pytest.approx(expected, abs=1e-4)
            assert own["white_balance"]["method"] == "gains"
    assert expected < -1  # the loop has moved


def test_a_run_is_resumed_and_its_manifest_has_its_settings(frames, tmp_path):
    drawn = {"dark_current": {"temperature": {"drift": [20, 60], "frames": 3}}}
    options = {"sequence": True, "iso": {"choice": [200, 800, 3200]}, **LOOPS, **drawn}
    run(tmp_path, "out", **options)
    first = pictures(tmp_path / "out")
    assert len(first) == 18
    for name in ("a/4", "b/9", "b/0"):
        (tmp_path / f"out/{name}.jpg").unlink()
    assert sorted(run(tmp_path, "out", **options)) == ["done"] * 3 + ["skipped"] * 15
    assert pictures(tmp_path / "out") == first
    list(clpipe.run(tmp_path / "out/run.csv", tmp_path / "again", device="numpy"))
    for name in ("a/4", "b/9", "b/0"):
        assert chain_of(tmp_path / f"again/{name}.json") == chain_of(tmp_path / f"out/{name}.json")


def test_draws_are_of_a_sequence_and_drifts_of_a_frame(frames, tmp_path):
    temperature = {"drift": [20, 60], "frames": 3}
    run(
        tmp_path,
        "out",
        sequence=True,
        iso={"log_uniform": [100, 6400]},
        dark_current={"temperature": temperature},
    )
    rows = [line.split(",") for line in (tmp_path / "out/run.csv").read_text().splitlines()]
    column = {name: [row[n] for row in rows[1:]] for n, name in enumerate(rows[0])}
    assert len(set(column["iso"])) == 2
    assert len(set(column["dark_current.temperature"])) == 18


def test_a_drawn_iso_may_exceed_the_range_of_the_camera(frames, tmp_path):
    options = {"camera": "google-pixel", "iso": {"choice": [6400]}}
    run(tmp_path, "out", sequence=True, **options)
    sidecar = json.loads((tmp_path / "out/a/0.json").read_text())
    assert sidecar["iso"] == 6400
    with clpipe.Stream(device="numpy", **options) as camera:
        assert camera(np.full((24, 32, 3), 0.1, np.float32)).index == 0


def test_shards_are_whole_sequences(frames, tmp_path):
    assert len(run(tmp_path, "out", sequence=True, shard="2/2")) == 9
    assert {name[0] for name in pictures(tmp_path / "out")} == {"b"}
    with pytest.raises(RequestError, match="shard: a tar may hold frames of two sequences"):
        run(tmp_path, "tars", sequence=True, shard="1/2", webdataset=4)


def test_a_frame_that_cannot_be_read_fails_alone(frames, tmp_path):
    (tmp_path / "frames/a/4.exr").write_bytes(b"no picture")
    made = clpipe.run(tmp_path / "frames", tmp_path / "out", device="numpy", sequence=True, **LOOPS)
    failed = [outcome.job.key for outcome in made if outcome.status == "failed"]
    assert failed == ["a/4.exr"]
    assert len(pictures(tmp_path / "out")) == 17


@pytest.fixture
def reads(monkeypatch):
    """The keys of the images that were read, in order."""
    found, read = [], ImageLoader.read

    def reading(self, job):
        found.append(job.key)
        return read(self, job)

    monkeypatch.setattr(ImageLoader, "read", reading)
    return found


@pytest.mark.parametrize("budget", [1, 2**30], ids=["small", "large"])
@pytest.mark.parametrize("has_state", [False, True])
def test_each_frame_is_decoded_once(frames, reads, tmp_path, monkeypatch, budget, has_state):
    monkeypatch.setattr(threads, "default_budget", lambda: budget)
    options = {"sequence": True, **LOOPS}
    if has_state:
        options["config"] = "video"
    keys = [f"{camera}/{n}.exr" for camera in "ab" for n in range(10) if n != 6]
    assert run(tmp_path, "out", **options) == ["done"] * 18
    assert reads == keys
    first = pictures(tmp_path / "out")
    reads.clear()
    assert run(tmp_path, "out", **options) == ["skipped"] * 18
    assert reads == keys
    reads.clear()
    (tmp_path / "out/a/5.jpg").unlink()
    statuses = run(tmp_path, "out", **options)
    assert pictures(tmp_path / "out") == first
    # With state, the frames before the missing one are made again. They did not stay in memory.
    again = keys[:6] if has_state else []
    assert statuses.count("done") == (9 if has_state else 1)
    assert sorted(reads) == sorted([*keys, *again])


def test_a_frame_that_no_memory_suffices_for_fails_alone(
    frames, reads, tmp_path, monkeypatch, write_exr
):
    write_exr("frames/a/4.exr", np.full((900, 1200, 3), 0.1, np.float32))
    monkeypatch.setattr(memory_budget, "free_memory", lambda: FreeMemory(150 * 2**20, "a limit"))
    made = clpipe.run(tmp_path / "frames", tmp_path / "out", device="numpy", sequence=True, **LOOPS)
    failed = [outcome for outcome in made if outcome.status == "failed"]
    assert [outcome.job.key for outcome in failed] == ["a/4.exr"]
    assert "a limit" in failed[0].error
    assert "a/4.exr" not in reads


def test_a_run_that_stops_keeps_no_frame(frames, tmp_path):
    made = clpipe.run(tmp_path / "frames", tmp_path / "out", device="numpy", sequence=True, **LOOPS)
    for _ in made:
        made.stop()
    assert made.summary.interrupted
    assert not (tmp_path / "out/run.csv").exists()
    run(tmp_path, "out", sequence=True, **LOOPS)
    run(tmp_path, "whole", sequence=True, **LOOPS)
    assert pictures(tmp_path / "out") == pictures(tmp_path / "whole")


def evs(folder):
    """The exposure and the gain of red that the loops have set, by frame of camera a."""
    found = {}
    for path in sorted((folder / "a").glob("*.json")):
        steps = chain_of(path)
        ev = steps["exposure"]["parameters"]["ev"]
        found[path.stem] = ev, steps["white_balance"]["parameters"]["red_gain"]
    return found


def black(tmp_path, write_exr, monkeypatch):
    write_exr("frames/a/4.exr", np.zeros((24, 32, 3)))


def unreadable(tmp_path, write_exr, monkeypatch):
    (tmp_path / "frames/a/4.exr").write_bytes(b"no picture")


@pytest.mark.parametrize("fault", [black, unreadable])
def test_a_frame_that_cannot_be_metered_holds_the_loops(
    frames, tmp_path, write_exr, monkeypatch, fault
):
    control = {"delay": 1, "smoothing": 2.0, "iso_max": 3200.0}
    options = {"device": "numpy", "sequence": True, "control": control, **LOOPS}
    fault(tmp_path, write_exr, monkeypatch)
    list(clpipe.run(tmp_path / "frames", tmp_path / "out", **options))
    monkeypatch.undo()
    (tmp_path / "frames/a/4.exr").unlink()
    list(clpipe.run(tmp_path / "frames", tmp_path / "without", **options))
    found, expected = evs(tmp_path / "out"), evs(tmp_path / "without")
    if fault is not unreadable:
        held = ControlLoop(Control(**control))
        metered = [levels(tmp_path)[name] for name in "01233"]
        assert found.pop("4")[0] == pytest.approx([held.next(ev) for ev in metered][-1], abs=1e-4)
    assert found == expected
    assert len({ev for ev, _ in found.values()}) > 4  # the loop has moved


def levels(tmp_path):
    """The EV that is metered for each frame of camera a, by itself."""
    run(tmp_path, "single", exposure={"method": "auto"})
    steps = {path.stem: chain_of(path) for path in (tmp_path / "single/a").glob("*.json")}
    return {name: each["exposure"]["estimates"]["metered_ev"] for name, each in steps.items()}


@pytest.mark.parametrize("rule", ["log_average", "percentile"])
def test_loops_start_at_the_first_frame_with_light(rule):
    exposure = {"method": "auto", "rule": rule, "target": 0.18}
    control = {"delay": 0, "smoothing": 0.0, "speed": 0.0, "hysteresis": 0.0, "iso_max": 6400.0}
    dark, grey = np.zeros((24, 32, 3), np.float32), np.full((24, 32, 3), 0.1799, np.float32)
    with clpipe.Stream(device="numpy", iso=200, exposure=exposure, control=control) as stream:
        shots = [stream(frame) for frame in (dark, grey / 4, dark, grey, dark)]
    assert [round(shot.settings["exposure"]["ev"], 2) for shot in shots] == [0, 2, 2, 0, 0]
    assert [shot.settings.get("iso") for shot in shots] == [None, 800, 800, 200, 200]
    assert [round(shot.metered.get("metered_ev", 9), 2) for shot in shots] == [9, 2, 9, 0, 9]


def test_without_light_white_balance_waits():
    control = {"delay": 0, "smoothing": 0.0, "speed": 0.0, "hysteresis": 0.0}
    balance = {"method": "gray_world", "limit": False}
    red = np.full((24, 32, 3), (0.4, 0.1, 0.1), np.float32)
    with clpipe.Stream(device="numpy", white_balance=balance, control=control) as stream:
        gains = [stream(red * light).settings["white_balance"] for light in (0, 1, 0, 0.5)]
    assert gains[0] == {"method": "gains", "red_gain": 1.0, "blue_gain": 1.0}
    assert gains[2] == gains[1]
    assert gains[1]["red_gain"] < gains[1]["blue_gain"] and gains[3] != gains[2]


@pytest.mark.parametrize(
    ("options", "own"),
    [
        ({"iso": 800, "camera": "nikon-d800"}, LOOPS),
        ({"camera": "nikon-d800"}, {**LOOPS, "iso": [200, 800]}),
        ({"shutter": {"subframes": 3}}, LOOPS),
        # A chain with state needs the order of the frames.
        ({"config": "video", "sequence": True}, {"iso": {"choice": [200, 800, 3200]}}),
    ],
    ids=["single", "series", "subframes", "video"],
)
def test_a_run_of_the_manifest_makes_the_same_pictures(frames, tmp_path, options, own):
    run(tmp_path, "out", **{"sequence": True, **options, **own})
    list(clpipe.run(tmp_path / "out/run.csv", tmp_path / "again", device="numpy", **options))
    made = pictures(tmp_path / "out")
    assert len(made) == {"shutter": 6, "camera": 36}.get(next(iter(options)), 18)
    assert pictures(tmp_path / "again") == made


def test_the_manifest_has_the_keys_of_all_files(tmp_path):
    files = [tmp_path / f"in/a_{view}.exr" for view in ("front", "back", "left")]
    panorama = Job(files[0], "v/a.exr", subframes=(files[1],), is_panorama=True)
    write_exposures(tmp_path / "out/run.csv", [panorama, Job(files[2], "v/a_left.exr", "iso100/b")])
    rows = read_manifest(tmp_path / "out/run.csv")
    assert [(row.path.resolve(), row.key, row.stem) for row in rows] == [
        (files[0], "v/a_front.exr", "v/a_front"),
        (files[1], "v/a_back.exr", "v/a_back"),
        (files[2], "v/a_left.exr", "iso100/b"),
    ]


def test_a_key_stays_in_the_output_directory(tmp_path):
    (tmp_path / "a.csv").write_text("path,key\na.exr,../a.exr\n")
    with pytest.raises(RequestError, match=r"key: found '\.\./a.exr', but expected a path in the"):
        clpipe.run(tmp_path / "a.csv", tmp_path / "out")


def test_the_number_of_a_frame_is_not_that_of_a_camera_or_a_version():
    rig = [f"cam{camera}_f{frame}.exr" for camera in range(5) for frame in (1, 2, 3)]
    found = placed(*rig)
    assert len(found) == 5 and all(len(frames) == 3 for frames in found.values())
    versions = [f"shot_v{version}_{frame}.exr" for version in (1, 2, 10, 11) for frame in (1, 2)]
    assert [len(frames) for frames in placed(*versions).values()] == [2] * 4
    first = [f"frame_{frame:04}_cam{camera}.exr" for frame in (1, 2, 3) for camera in range(5)]
    assert [len(frames) for frames in placed(*first).values()] == [3] * 5
    padded = [f"left{eye}.{frame:04}.exr" for eye in (0, 1) for frame in (9, 10)]
    assert [len(frames) for frames in placed(*padded).values()] == [2] * 2


def test_numbers_of_frames_have_decimals():
    names = [f"f.{number}.exr" for number in ("1.25", "1.5", "1.75", "2.0")]
    [frames] = placed(*names).values()
    assert frames == list(zip(names, range(4), strict=True))


@pytest.mark.parametrize(
    "stamps",
    [
        ("1305031102.175304", "1305031102.211214", "1305031102.243211"),
        ("1305031102175304000", "1305031102211214123", "1305031102243211777"),
        ("1305031102175", "1305031102211", "1305031102243"),
    ],
)
def test_time_stamps_are_times(stamps):
    """Intervals of 36 and 32 ms, whose mean is the unit."""
    names = [f"{stamp}.exr" for stamp in stamps]
    [frames] = placed(*names[::-1]).values()
    assert [name for name, _ in frames] == names
    assert [place for _, place in frames] == pytest.approx([0, 36 / 34, 2], abs=2e-3)


def test_a_gap_between_time_stamps_is_named(caplog):
    stamps = [1_403_636_579_763_555_584 + n * 50_000_000 for n in (0, 1, 2, 5, 6)]
    jobs = in_sequences([Job(Path(f"{each}.png"), f"{each}.png") for each in stamps])
    assert [job.place.index for job in jobs] == [0, 1, 2, 5, 6]
    assert {job.place.interval for job in jobs} == {0.05}
    assert "2 of 7 frames are missing: 2 after 0.1 s" in caplog.text
    assert "5 frames, 20 frames per second from their times" in summary(jobs)


def test_numbers_that_are_dates_are_no_time_stamps():
    names = ("20231128123045.exr", "20231128123046.exr")
    jobs = in_sequences([Job(Path(name), name) for name in names])
    assert [(job.place.index, job.place.interval) for job in jobs] == [(0, None), (1, None)]


def test_a_large_gap_is_no_time_stamp(caplog):
    [frames] = placed("f.1.exr", "f.2.exr", "f.3.exr", "f.1000.exr").values()
    assert frames[-1] == ("f.1000.exr", 999)
    assert "996 of 1000 frames are missing: 4 to 999" in caplog.text


def test_a_run_names_its_sequences(clpipe, write_exr):
    for name in ("rig/cam0_f1", "rig/cam0_f2", "rig/cam1_f1", "rig/cam1_f2"):
        write_exr(f"{name}.exr", np.full((8, 8, 3), 0.2))
    stderr = clpipe("run", "rig", "-o", "out", "--sequence", "--device", "numpy").stderr
    assert "clpipe: 2 sequences of 2 frames: cam0_f, cam1_f" in stderr


def test_all_frames_of_a_sequence_have_one_layer(clpipe, tmp_path):
    for number in range(1, 5):
        combined = {f"Combined.{c}": np.full((8, 8), 0.6, np.float32) for c in "RGB"}
        noisy = {f"beauty.{c}": np.full((8, 8), 0.1, np.float32) for c in "RGB"}
        Path("in").mkdir(exist_ok=True)
        OpenEXR.File({}, noisy | (combined if number < 3 else {})).write(f"in/f.{number}.exr")
    run = ("run", "in", "-o", "out", "--sequence", "--device", "numpy")
    stderr = clpipe(*run, status=1).stderr
    message = "f.4.exr: its picture is the layer 'beauty', but that of the first frame of its"
    assert message in stderr and "choose one for all frames with --layer" in stderr
    assert sorted(path.stem for path in Path("out").glob("*.jpg")) == ["f.1", "f.2"]
    clpipe(*run, "--layer", "beauty", "--redo", "all")
    assert len(list(Path("out").glob("*.jpg"))) == 4


def test_a_frame_without_a_picture_fails_if_the_first_has_one(clpipe):
    Path("in").mkdir()
    for number in range(1, 4):
        name = "Combined" if number < 3 else "Depth"
        planes = {f"{name}.{c}": np.full((8, 8), 0.6, np.float32) for c in "RGB"}
        OpenEXR.File({}, planes).write(f"in/f.{number}.exr")
        OpenEXR.File({}, {"Depth.Z": planes[f"{name}.R"]}).write(f"in/f.{number}_depth.exr")
    result = clpipe("run", "in", "-o", "out", "--sequence", "--device", "numpy", status=1)
    assert "f.3.exr: has no layer with the finished picture" in result.stderr
    assert "2 of 3 images done, 1 failed" in result.stderr


STAMPS = [1_403_636_579_763_555_584 + n * 50_000_000 for n in (0, 1, 2, 4)]


@pytest.mark.parametrize(
    ("name", "folder", "row"),
    [
        ("rgb.txt", "rgb", "{seconds:.6f} rgb/{stamp}.exr"),
        ("cam0/data.csv", "cam0/data", "{stamp},{stamp}.exr"),
    ],
)
def test_lists_of_datasets_have_times(clpipe, write_exr, name, folder, row):
    for stamp in STAMPS:
        write_exr(f"{folder}/{stamp}.exr", np.full((8, 8, 3), 0.2, np.float32))
    rows = [row.format(stamp=each, seconds=each / 1e9) for each in STAMPS[::-1]]
    Path(name).write_text("\n".join(["#timestamp [ns],filename", *rows, ""]))
    result = clpipe("run", name, "-o", "out", "--sequence", "--device", "numpy")
    assert "1 sequence of 4 frames, 20 frames per second from their times" in result.stderr
    assert "1 of 5 frames are missing: 1 after 0.1 s" in result.stderr
    assert len([*Path("out").rglob("*.jpg")]) == 4


def test_other_lists_are_rejected(clpipe):
    Path("groundtruth.txt").write_text("1305031098.6659 1.35 0.63 1.63 0.65 0.61 -0.29 -0.32\n")
    stderr = clpipe("run", "groundtruth.txt", "-o", "out", "--sequence", status=2).stderr
    assert "groundtruth.txt, row 1: found '1305031098.6659 1.35 0.63" in stderr
    assert "expected a time stamp and the path of an image" in stderr


def test_loops_follow_the_time_between_frames():
    """Half an interval, twice, changes as much as a whole one, also at the highest speed."""
    for speed in (0.0, 0.1):
        control = Control(delay=0, smoothing=4.0, speed=speed, hysteresis=0.0)
        whole, halves = ControlLoop(control), ControlLoop(control)
        assert whole.next(0.0) == halves.next(0.0) == 0
        halves.next(2.0, 0.5)
        assert halves.next(2.0, 0.5) == pytest.approx(whole.next(2.0), rel=1e-12)


def test_a_long_gap_takes_no_time():
    loop = ControlLoop(Control())
    loop.next(0.0)
    loop.next(1.0)
    loop.hold(10**12)
    assert loop.next(1.0) == pytest.approx(1)


def test_names_with_a_number_and_a_time_stamp():
    names = [f"frame{n:04}_{1305031102000 + 40 * n}.exr" for n in (0, 1, 3)]
    jobs = in_sequences([Job(Path(name), name) for name in names])
    assert [job.place.index for job in jobs] == [0, 1, 3]
    assert {(job.place.sequence, job.place.interval) for job in jobs} == {("frame", 0.04)}
