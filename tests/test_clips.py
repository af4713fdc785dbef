"""Clips: video files of sequences, their records, and resuming."""

import json
import shutil
from fractions import Fraction
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import clpipe as api
from clpipe.base.errors import RequestError
from clpipe.batch import clip_sink
from clpipe.batch.clips import ClipOptions, parse_bit_rate, parse_rate
from clpipe.images.video import VideoOptions
from clpipe.images.video_reading import read_video, video_info
from clpipe.inputs.find import Job, Place
from clpipe.stages import DEFAULT_CHAIN
from tests.conftest import stamps, statuses, written

pytest.importorskip("av", reason="needs PyAV: pip install av")

RUN = ("-o", "out", "--format", "mkv", "--codec", "ffv1", "--iso", 3200, "--device", "numpy")
OUT = Path("out")


@pytest.fixture
def frames(write_exr, clpipe):
    """Small renders of sequences that differ in each frame."""

    def write(*folders, numbers=range(5), size=(16, 24)):
        rng = np.random.default_rng(0)
        for folder in folders or ["in/cam0"]:
            for n in numbers:
                write_exr(f"{folder}/f{n}.exr", rng.random((*size, 3)).astype(np.float32))
        return "in"

    return write


def records(path):
    return [json.loads(line) for line in Path(path).read_text().splitlines()]


def test_a_clip_contains_the_pictures_in_temporal_order(clpipe, frames):
    frames("in/cam0", numbers=[8, 9, 10])
    clpipe("run", "in", *RUN, "--truth", "clean")
    clpipe(
        "run", "in", "-o", "plain", "--sequence", "--format", "png", *RUN[6:], "--truth", "clean"
    )
    names = [f"cam0{each}" for each in (".mkv", ".mkv.jsonl")]
    names += [f"cam0.truth_clean{each}" for each in (".mkv", ".mkv.jsonl")] + ["run.csv"]
    assert written(OUT) == names
    for suffix in ("", ".truth_clean"):
        found = list(read_video(OUT / f"cam0{suffix}.mkv"))
        assert len(found) == 3
        for n, frame in zip((8, 9, 10), found, strict=True):
            assert np.array_equal(frame, Image.open(f"plain/cam0/f{n}{suffix}.png"))


def test_a_frame_is_done_when_its_clip_exists(clpipe, frames):
    run = api.run(frames("in/a", "in/b"), "out", format="mkv", codec="ffv1", device="numpy")
    for outcome in run:
        assert video_info(OUT / outcome.job.name.partition("/")[0]).frames == 5
        assert all((OUT / name).exists() for name in outcome.outputs)
    assert run.summary.counts["done"] == 10


def test_records_contain_the_sidecar_of_each_frame(clpipe, frames):
    clpipe("run", frames(numbers=[1, 2, 4]), *RUN, "--fps", "30000/1001")
    clpipe("run", "in", "-o", "plain", "--sequence", "--format", "png", *RUN[6:])
    found = records("out/cam0.mkv.jsonl")
    assert [record["index"] for record in found] == [0, 1, 3]  # frame 3 is missing
    for n, record in zip((1, 2, 4), found, strict=True):
        sidecar = json.loads(Path(f"plain/cam0/f{n}.json").read_text())
        del sidecar["sidecar_sha256"]
        assert {name: record[name] for name in sidecar} == sidecar
        assert record["clip"]["encoding"]["rate"] == "30000/1001"
    assert video_info(OUT / "cam0.mkv").frames == 3


def test_a_named_clip_is_one_sequence(clpipe, frames):
    frames("in", size=(16, 64))
    clpipe("run", "in", "-o", "clip.mp4", *RUN[6:], "--bit-depth", 10, "--codec", "h265")
    assert written(Path()) == [
        "clip.mp4",
        "clip.mp4.csv",
        "clip.mp4.jsonl",
        *(f"in/f{n}.exr" for n in range(5)),
    ]
    found = video_info(Path("clip.mp4"))
    assert (found.codec, found.bits, found.frames) == ("hevc", 10, 5)
    frames("both/a", "both/b")
    result = clpipe("run", "both", "-o", "b.mp4", status=2)
    assert "found b.mp4 for 2 sequences (a, b); use -o OUT --format mp4" in result.output


@pytest.mark.parametrize("change", [("--seed", 1), ("--fps", 25)])
def test_a_changed_request_makes_clips_again(clpipe, frames, change):
    clpipe("run", frames(), *RUN)
    before = (OUT / "cam0.mkv").read_bytes()
    clpipe("run", "in", *RUN, *change)
    assert (OUT / "cam0.mkv").read_bytes() != before
    assert set(statuses(OUT).values()) == {"done"}


def test_a_failed_frame_fails_its_sequence_only(clpipe, frames, caplog):
    frames("in/a", "in/b")
    broken = Path("in/a/f2.exr")
    whole = broken.read_bytes()
    broken.write_bytes(whole[:200])
    clpipe("run", "in", *RUN, status=1)
    assert not (OUT / "a.mkv").exists()
    assert len(list(read_video(OUT / "b.mkv"))) == 5
    assert "out/a.mkv: no clip is written, because the frame in/a/f2.exr failed" in caplog.text
    # The same command resumes with this frame.
    broken.write_bytes(whole)
    clpipe("run", "in", *RUN)
    assert [name for name, status in statuses(OUT).items() if status == "done"] == ["a/f2.exr"]
    assert len(list(read_video(OUT / "a.mkv"))) == 5
    assert not [path for path in OUT.iterdir() if path.name.startswith(".clpipe")]


def test_a_run_that_was_killed_before_encoding_resumes(clpipe, frames, monkeypatch):
    clpipe("run", frames(), *RUN)
    whole = (OUT / "cam0.mkv").read_bytes()
    shutil.rmtree(OUT)

    def killed(*_):
        raise KeyboardInterrupt

    run = api.run("in", "out", format="mkv", codec="ffv1", iso=3200, device="numpy")
    with monkeypatch.context() as patch:
        patch.setattr(clip_sink.Clips, "_encode", killed)
        with pytest.raises(KeyboardInterrupt):
            list(run)
    (OUT / ".clpipe.cam0/cam0/f1.png").unlink()
    clpipe("run", "in", *RUN)
    made = [name for name, status in statuses(OUT).items() if status == "done"]
    assert "cam0/f1.exr" in made
    assert len(made) <= 2  # the last frame's outcome names the clip
    assert (OUT / "cam0.mkv").read_bytes() == whole


def test_frames_that_depend_on_earlier_ones_are_all_made_again(clpipe, frames):
    stages = [*DEFAULT_CHAIN]
    stages.insert(stages.index("denoise"), "temporal_denoise")
    options = (*RUN, "--stages", ",".join(stages))
    clpipe("run", frames(), *options)
    whole = (OUT / "cam0.mkv").read_bytes()
    before = stamps()
    clpipe("run", "in", *options)
    assert stamps() == before
    shutil.rmtree(OUT)
    broken = Path("in/cam0/f2.exr")
    picture = broken.read_bytes()
    broken.write_bytes(picture[:200])
    clpipe("run", "in", *options, status=1)
    broken.write_bytes(picture)
    clpipe("run", "in", *options)
    assert (OUT / "cam0.mkv").read_bytes() == whole


def test_frames_of_several_sizes_fail(clpipe, frames, write_exr):
    frames("in/a", "in/b")
    write_exr("in/a/f3.exr", np.full((16, 26, 3), 0.2, np.float32))
    result = clpipe("run", "in", *RUN, status=1)
    assert "frame 3 has 26x16 px, but the frames before it have 24x16 px" in result.output
    assert [path.name for path in sorted(OUT.glob("*.mkv"))] == ["b.mkv"]


def test_an_odd_size_fails_before_frames_are_made(clpipe, frames):
    result = clpipe("run", frames(size=(16, 25)), "-o", "out", "--format", "mp4", status=2)
    assert "--codec: the picture has 25x16 px, but h264 needs an even width" in result.output
    assert not list(OUT.glob("*.mp4"))
    narrow = ("run", frames(size=(64, 48)), "-o", "a.mp4", "--codec", "h265")
    assert "48x64 px, but h265 needs a width of 64 px" in clpipe(*narrow, status=2).output


def test_decoded_frames_show_what_the_codec_did(clpipe, frames):
    lossy = ("-o", "out", "--format", "mp4", "--crf", 40, *RUN[6:])
    clpipe("run", frames(), *lossy)
    before = stamps()
    clpipe("run", "in", *lossy, "--decoded")
    assert stamps().items() >= before.items()  # the clip is decoded, but not made again
    for n, frame in enumerate(read_video(OUT / "cam0.mp4")):
        assert np.array_equal(frame, Image.open(f"out/cam0.mp4.decoded/f{n}.png"))


def test_new_clips_replace_decoded_frames(clpipe, frames):
    options = ("-o", "out", "--format", "mp4", *RUN[6:])
    clpipe("run", frames(), *options, "--crf", 40, "--decoded")
    clpipe("run", "in", *options, "--crf", 10)
    assert not list(OUT.glob("*.decoded/*"))


def test_shards_are_whole_sequences(clpipe, frames):
    frames("in/a", "in/b", "in/c")
    clpipe("run", "in", *RUN)
    whole = {path.name: path.read_bytes() for path in OUT.glob("*.mkv")}
    shutil.rmtree(OUT)
    for part in ("2/2", "1/2"):
        clpipe("run", "in", *RUN, "--shard", part, "--jobs", 3)
    assert {path.name: path.read_bytes() for path in OUT.glob("*.mkv")} == whole
    assert len(whole) == 3


def test_a_missing_library_is_noticed_early(frames, monkeypatch):
    monkeypatch.setattr("clpipe.base.extras.is_installed", lambda name: name != "av")
    with pytest.raises(RequestError, match=r"a clip needs av, .*\. Run: pip install av"):
        api.run(frames(), "clip.mp4")


def test_a_sequence_may_have_the_name_of_the_log(clpipe, frames):
    clpipe("run", frames("in/run"), *RUN)
    assert Path("out/run.mkv.jsonl").is_file()
    assert "5 of 5 images" in clpipe("status", "out").output


def test_rates():
    assert parse_rate(str(23.976)) == Fraction(24000, 1001)
    assert parse_rate("12.5") == Fraction(25, 2)
    assert parse_bit_rate(str(2.5e6)) == 2_500_000
    for text in ("x", "0", "-1", "1/0", "inf"):
        with pytest.raises(RequestError, match="--fps: found"):
            parse_rate(text)
        with pytest.raises(RequestError, match="--bit-rate: found"):
            parse_bit_rate(text)


def test_a_report_needs_single_pictures(clpipe, frames):
    clpipe("run", frames(), *RUN)
    stderr = clpipe("report", "out", status=2).stderr
    assert "out: its pictures are in clips, such as cam0.mkv, but a report needs single" in stderr
    clpipe("run", "in", "-o", "out/plain", "--sequence", *RUN[6:])
    clpipe("report", "out/plain")


def times_of(path):
    """Return the times of a clip's frames in s, and their mean levels."""
    import av

    with av.open(path) as container:
        found = [*container.decode(video=0)]
    times = [float(each.pts * each.time_base) for each in found]
    return times, [each.to_ndarray(format="gray").mean() for each in found]


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize(
    ("gaps", "expected"),
    [
        ("hold", [0, 1, 4, 5]),
        ("black", [0, 1, 2, 3, 4, 5]),
        ("cut", [0, 1, 2, 3]),
    ],
)
def test_a_gap_keeps_its_time_in_the_clip(clpipe, frames, suffix, gaps, expected):
    frames("in", numbers=(3, 4, 7, 8), size=(32, 48))
    options = ("--fps", 20, "--gaps", gaps, "--device", "numpy", "--decoded")
    clpipe("run", "in", "-o", f"film.{suffix}", *options)
    times, levels = times_of(f"film.{suffix}")
    assert times == pytest.approx([each / 20 for each in expected], abs=2e-3)
    assert [n for n, level in enumerate(levels) if level < 20] == [2, 3] * (gaps == "black")
    found = records(f"film.{suffix}.jsonl")
    assert [record["index"] for record in found] == [0, 1, 4, 5]
    decoded = sorted(Path(f"film.{suffix}.decoded").iterdir())
    assert [path.name for path in decoded] == [f"f{n}.png" for n in (3, 4, 7, 8)]
    assert all(np.asarray(Image.open(path)).mean() > 50 for path in decoded)


def test_another_treatment_of_gaps_makes_the_clip_again(clpipe, frames):
    frames("in", numbers=(3, 4, 6))
    run = ("run", "in", "-o", "film.mkv", *RUN[4:])
    clpipe(*run)
    assert len(times_of("film.mkv")[0]) == 3
    clpipe(*run, "--gaps", "black")
    assert len(times_of("film.mkv")[0]) == 4


@pytest.mark.parametrize(("suffix", "codec"), [("mp4", "h264"), ("mkv", "ffv1"), ("mp4", "h265")])
@pytest.mark.parametrize("source", ["names", "column"])
def test_a_clip_has_the_times_of_its_frames(clpipe, write_exr, suffix, codec, source):
    """The rate may vary: the third interval is one and a half times as long."""
    given = [0, 0.04, 0.08, 0.14, 0.18]
    stamps = [f"{1305031102 + each:.6f}" for each in given]
    names = stamps if source == "names" else [f"f{n}" for n in range(5)]
    for name in names:
        write_exr(f"in/{name}.exr", np.full((32, 64, 3), 0.3, np.float32))
    if source == "column":
        rows = "".join(f"in/{n}.exr,{s}\n" for n, s in zip(names, stamps, strict=True))
        Path("list.csv").write_text(f"path,time\n{rows}")
    inputs = "in" if source == "names" else "list.csv"
    options = ("--codec", codec, "--device", "numpy")
    stderr = clpipe("run", inputs, "-o", f"film.{suffix}", *options).stderr
    assert "1 sequence of 5 frames, 25 frames per second from their times" in stderr
    assert times_of(f"film.{suffix}")[0] == pytest.approx(given, abs=1e-3)
    found = records(f"film.{suffix}.jsonl")
    assert [record["time"] for record in found] == pytest.approx(given)
    assert found[3]["index"] == pytest.approx(3.5)
    stderr = clpipe("run", inputs, "-o", f"x.{suffix}", *options, "--fps", 30, status=2).stderr
    assert "--fps: found 30, but the times of" in stderr and "are of 25 frames per s" in stderr


def test_the_settings_of_a_timed_clip_make_it_again(clpipe, write_exr):
    for n in range(3):
        write_exr(f"in/f{n}.exr", np.full((32, 48, 3), 0.1 * (n + 1), np.float32))
    Path("list.csv").write_text("path,time\nin/f0.exr,0\nin/f1.exr,0.1\nin/f2.exr,0.4\n")
    clpipe("run", "list.csv", "-o", "a.mkv", *RUN[4:])
    assert "0.4" in Path("a.mkv.csv").read_text()
    clpipe("run", "a.mkv.csv", "-o", "b.mkv", *RUN[4:])
    assert Path("a.mkv").read_bytes() == Path("b.mkv").read_bytes()


def test_frames_of_a_sequence_have_all_a_time_or_none(clpipe, frames):
    frames("in")
    Path("list.csv").write_text("path,time\nin/f0.exr,0\nin/f1.exr,\n")
    stderr = clpipe("run", "list.csv", "-o", "a.mkv", *RUN[4:], status=2).stderr
    assert "f1.exr" in stderr and "this frame has no time, but others of its sequence" in stderr
    Path("list.csv").write_text("path,time\nin/f0.exr,now\n")
    stderr = clpipe("run", "list.csv", "-o", "a.mkv", *RUN[4:], status=2).stderr
    assert "time: found now, but expected a number: seconds" in stderr


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (("0", "1e-6"), "are of 1e+06 frames per second, but clips have 1000 at most"),
        (("0", "1e300"), "time: found 1e+300, which is neither seconds nor a time stamp"),
        (("0", "true"), "time: found True, but expected a number"),
        (("0", "nan"), "time: found nan, but expected a number"),
        (("0", "1" + 400 * "0"), "which is neither seconds nor a time stamp"),
    ],
)
def test_impossible_times_are_rejected(clpipe, frames, times, message):
    frames("in")
    rows = "".join(f"in/f{n}.exr,{time}\n" for n, time in enumerate(times))
    Path("list.csv").write_text(f"path,time\n{rows}")
    assert message in clpipe("run", "list.csv", "-o", "a.mkv", *RUN[4:], status=2).stderr


def test_changed_times_make_the_clip_again(clpipe, frames):
    frames("in")
    for time in ("0.2", "0.3"):
        Path("list.csv").write_text(
            f"path,time\nin/f0.exr,0\nin/f1.exr,0.1\nin/f2.exr,{time}\nin/f3.exr,0.4\n"
        )
        clpipe("run", "list.csv", "-o", "a.mkv", *RUN[4:])
        assert times_of("a.mkv")[0] == [0, 0.1, float(time), 0.4]


def test_black_frames_between_places_that_are_not_whole(clpipe, frames):
    frames("in")
    Path("list.csv").write_text("path,time\nin/f0.exr,0\nin/f1.exr,0.1\nin/f2.exr,0.28\n")
    clpipe("run", "list.csv", "-o", "a.mkv", *RUN[4:], "--gaps", "black")
    times, levels = times_of("a.mkv")
    assert times == pytest.approx([0, 0.1, 0.2, 0.28])
    assert [level < 20 for level in levels] == [False, False, True, False]


def test_cut_frames_have_equal_intervals():
    """Even if the times are of a rate that differs a little from the clip's."""
    own = {"decoded": False, "name": "", "gaps": "cut", "has_rate": False}
    options = ClipOptions(".mkv", VideoOptions("ffv1"), **own)
    places = [Place("s", "s", n, 5000, 1 / 29.975) for n in range(5000)]
    jobs = [Job(Path(f"{n}.exr"), f"{n}.exr", place=place) for n, place in enumerate(places)]
    rate = options.video_of(jobs[0]).rate
    assert rate == Fraction(30000, 1001)
    assert [time * rate for time, _ in options.shown(jobs)] == [*range(5000)]


def test_an_hour_between_frames(clpipe, frames):
    frames("in")
    Path("list.csv").write_text("path,time\nin/f0.exr,0\nin/f1.exr,3600\nin/f2.exr,7200\n")
    stderr = clpipe("run", "list.csv", "-o", "a.mkv", *RUN[4:]).stderr
    assert "0.000277778 frames per second from their times" in stderr
    assert times_of("a.mkv")[0] == [0, 3600, 7200]
    Path("list.csv").write_text("path,time\nin/f0.exr,0\nin/f1.exr,0.1\nin/f2.exr,7200\n")
    run = ("run", "list.csv", "-o", "b.mkv", *RUN[4:], "--gaps", "black")
    assert "71998 frames of in are missing, but 10000 black" in clpipe(*run, status=2).stderr


def test_two_containers_of_one_name_have_their_own_records(clpipe, frames):
    frames("in")
    for suffix in ("mkv", "mp4"):
        clpipe("run", "in", "-o", f"film.{suffix}", "--device", "numpy")
    assert records("film.mkv.jsonl")[0]["clip"]["name"] == "film.mkv"
    assert records("film.mp4.jsonl")[0]["clip"]["name"] == "film.mp4"
    assert (
        "5 of them were there already"
        in clpipe("run", "in", "-o", "film.mkv", "--device", "numpy").output
    )


@pytest.mark.parametrize("name", ["film.mov", "film.avi", "film.webm"])
def test_other_containers_are_no_directories(clpipe, frames, name):
    stderr = clpipe("run", frames(), "-o", name, status=2).stderr
    assert f"--output: found {name}, but clpipe writes clips as .mp4 or .mkv" in stderr
    assert not Path(name).exists()


def test_the_records_of_a_clip_are_no_sidecar(clpipe, frames):
    clpipe("run", frames("in"), "-o", "film.mkv", "--device", "numpy")
    stderr = clpipe("replay", "film.mkv.jsonl", "-o", "again", status=2).stderr
    assert "film.mkv.jsonl: this file has the records of a clip or a run" in stderr


def test_an_odd_overscan_has_an_even_picture(clpipe):
    header = {"displayWindow": ((0, 0), (47, 31)), "dataWindow": ((-1, -1), (49, 33))}
    header = {key: tuple(map(np.int32, value)) for key, value in header.items()}
    for frame in range(2):
        picture = np.full((35, 51, 3), 0.2, np.float32)
        OpenEXR.File(header, {"RGB": picture}).write(f"f{frame}.exr")
    clpipe("run", "f0.exr", "f1.exr", "-o", "film.mp4", "--device", "numpy")
    assert video_info(Path("film.mp4")).height == 32
