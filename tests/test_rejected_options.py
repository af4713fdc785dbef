"""Options with wrong values: the message names the key, the value and what is allowed."""

import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest

import clpipe as api
from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from

# Options of ``clpipe run`` with a render, and parts of the message.
COMMANDS = """
--set denoise.grian=0 => did you mean 'grain'
--set denoise.luma_size=5 => 'luma_size' is a parameter of bilateral and non
--set denoise.method=[1] => denoise.method: unknown method
--set sensor_noise_2.a=1 => unknown stage in this chain 'sensor_noise_2'
--set denoise.grain=0 --skip denoise => in this chain 'denoise'
--set denoise.grain=true => denoise.grain: found True
--set denoise=2 => 'clpipe stages denoise' lists the parameters of this stage
--device '' => unknown device ''
--device quantum => unknown device 'quantum'
--keep noise => unknown stage in this chain 'noise'
--stages mosaic,quantize => ends in DN, but jpg cannot store DN
--format bmp => bmp
--format png --format png16 => png and png16 would both write NAME.png
--format exr16 --until quantize => ends in DN, but exr16 cannot store DN
--webdataset 0 => --webdataset
--memory lots => clpipe: --memory: 'lots' is not a size
--start-at denoize => unknown stage in this chain 'denoize' .. 'denoise'
--until denoise_2 => unknown stage in this chain 'denoise_2'
--start-at gamma --until mosaic => gamma comes after mosaic
--until demosaic --keep gamma => unknown stage in this chain 'gamma'
--until quantize --format jpg => the chain ends in DN, but jpg cannot store DN
--set output.png_compression=10 => output.png_compression: found 10: .. than or eq
--set output.jpeg_quality=101 => output.jpeg_quality: found 101: .. less than or
--set output.jpeg_qualty=9 => unknown key of output 'jpeg_qualty' .. jpeg_quality
--set output.jpeg_subsampling=4:1:1 => found '4:1:1': .. '4:4:4', '4:2:2' or
--set output.date=today => output.date: found 'today': write the date like 2026
--set render.focal_length=0 => render.focal_length: found 0: .. greater than 0
--set render.exposure_time=fast => render.exposure_time: found 'fast': .. number
--iso random => To draw the ISO of each image, use a range such as 100..6400
--iso 100-6400 => To draw the ISO of each image, use a range such as 100..6400
--iso 100..x => iso: found '100..x'; expected the two ends of a range of random ISOs
--iso 6400..100 => iso: log_uniform: found [6400, 100]; put the lower end first
--iso 100..1e7 => found 1e+07, but camera sony-a7r2 goes from 100 to 25600
--repeat 2 --sequence => --repeat: the frames of a sequence are not repeated
--repeat 0 => --repeat
--iso 100,x => --iso: found '100,x'; expected numbers above 0
--iso 100,-5 => expected numbers above 0 with commas between them, such as 100,800,3200
--iso 100,1e2 => --iso: found '100,1e2', which lists 100 twice; list it once
--iso 9 --set iso.choice=[9] => --set iso.choice=[9]: found --iso as well
--iso 100,1e7 => found 1e+07, but camera sony-a7r2 goes from 100 to 25600
--camera sony-a7r2 --camera ILCE-7RM2 => sony-a7r2 is listed twice
--camera sony-a7r2 --camera nikon-f => nikon-f
--patch 12 --format dng => --patch: patches cannot be written as dng
--patch 8 --patches-per-image grit => found 'grit'; expected a whole number from 1 to 9999, or grid
--carry Depth:metres => --carry Depth:metres: unknown kind 'metres'
--carry '' => expected a name such as Depth
--carry a/b:label => expected a name such as Depth
--carry Z --carry z => --carry z: the layer is named twice
--carry Z=d.exr => must contain {name}, the name of the
--carry Z:png= => must contain {name}
--format dng --stages exposure,gamma => starts on rgb and has no quantize
--format dng --until sensor_noise => the DN that quantize produces
--format dng --until quantize --format jpg => ends in DN, but jpg cannot store DN
--format dng --set quantize.white_level=1000.5 => white level of 1000.5, but DNG needs whole
--format dng --start-at white_balance => starts on mosaic and has no quantize
--set shutter.subframes=3 => in: shutter.subframes is 3, but this folder has 1 image
--set shutter.subframes={choice=[2,4]} => shutter.subframes: found a random draw
--set shutter.subframes=0 => shutter.subframes
--bracket -2,x => --bracket: found '-2,x'; expected EVs, such as -2,0,2
--bracket nan => expected EVs
--bracket 1e-9,0 => expected EVs
--bracket 1,1.0 => found '1,1.0', which repeats +1 EV; list each EV once
--bracket 0,30 => +30 EV added to exposure.ev=0 is not allowed; exposure.ev: found 30
--bracket 1 --skip exposure => this chain has no stage exposure:
--truth iid --skip picture_noise => in the stage picture_noise, which this chain
--truth iid --set picture_noise.method=iid_gaussian --set picture_noise.sigma=0.1 => already adds
--truth iid --until normalize => which this chain does not have
--truth iid --skip sensor_noise --skip row_noise => no stage of this chain adds noise
--augment => --augment: this option needs patches; add --patch SIZE
--truth noise => is not one of 'development', 'clean', 'mosaic', 'variance'
--truth mosaic --until quantize --format exr => ends in DN, at quantize
--truth clean --truth mosaic --skip sensor_noise --skip row_noise => no ground truth to write
--truth variance --start-at white_balance => no ground truth to write
--truth variance --stages mosaic,sensor_noise,mosaic_denoise,row_noise => cannot compute the vari
"""


def rows(text):
    return [pytest.param(*line.split(" => ")) for line in text.strip().splitlines()]


@pytest.fixture
def folder(write_exr, clpipe):
    """A render of 13x9 pixels, and a manifest of another."""
    write_exr("in/a.exr", np.full((9, 13, 3), 0.25))
    Path("m.csv").write_text("path\nin/none.exr\n")


@pytest.mark.parametrize(("options", "parts"), rows(COMMANDS))
def test_a_wrong_command_writes_nothing(clpipe, folder, options, parts):
    status = 3 if options.startswith("--device") else 2
    stderr = clpipe("run", "in", "-o", "out", *shlex.split(options), status=status).stderr
    for part in parts.split(" .. "):
        assert part in " ".join(stderr.split())
    assert "Traceback" not in stderr
    if options.startswith(("--memory", "--patch", "--iso", "--set")):
        assert "Invalid value" not in stderr
    assert not Path("out").exists()


# Settings, as in a configuration, and parts of the message.
SETTINGS = """
demosiac.method="bilinear" => unknown stage 'demosiac' .. mean 'demosaic'
demosaic.method="biliner" => demosaic.method: .. 'biliner' .. mean 'bilinear'
sensor_noise.aa=1 => unknown parameter of sensor_noise .. 'aa' .. allowed: method, a, b
sensor_noise.a=-1 => sensor_noise.a: found -1: .. greater than or equal to 0
sensor_noise.a="much" => sensor_noise.a: found 'much': .. number
sensor_noise.a=nan => sensor_noise.a: found nan: .. finite
sensor_noise.chi=100.0 => sensor_noise: .. need both chi and theta; only chi is set
sensor_noise={chi=1e3, theta=1.0, system_gain=2.0} => use only one of these parametrisations
sensor_noise={a=1e-3, system_gain=2.0} => sensor_noise: set the noise in one parametrisation; a
sensor_noise={chi=1e3, theta=1.0, p0=0.1} => sensor_noise: p0 = 0.1 makes b negative
sensor_noise={method="poisson", a=0.0} => poisson needs the parameter a above 0
sensor_noise.tukey_lambda=-0.5 => tukey_lambda
mosaic.pattern="RGBG" => mosaic.pattern: found 'RGBG': .. 'RGGB', 'BGGR', 'GRBG'
denoise={method="mean", luma_size=4} => denoise.luma_size: found 4: it must be odd, 1 to 15
denoise={method="median", chroma_size=7} => denoise.chroma_size: found 7: it must be odd, 1 to 5
mosaic_denoise.size=17 => mosaic_denoise.size: found 17: it must be odd, 1 to 15
stages=["mosaic", "nosie"] => unknown stage 'nosie'
skip=["nosie"] => unknown stage 'nosie'
stages="mosaic" => stages: found 'mosaic', but expected a list
stages=[] => no stage is left to run
stages=["exposure", "demosaic"] => demosaic reads mosaic, but exposure gives rgb; list mosaic
stages=["demosaic"] => demosaic reads mosaic, but the input gives rgb
skip=["normalize"] => white_balance reads mosaic, but quantize gives raw .. normalize
skip=["quantize"] => normalize reads raw, but black_level_error gives mosaic .. quantize
iso="high" => iso: found 'high', but expected a number
isoo=3 => unknown key 'isoo' .. mean 'iso'
iso=50 => iso: found 50, but camera sony-a7r2 goes from 100 to 25600
camera="sony-a7r9" => unknown camera 'sony-a7r9': .. (most similar: sony-a7r)
camera="nowhere.toml" => nowhere.toml: there is no such file
color_matrix={method="given", matrix=[[1,0,0], [0,1,0], [1,1,0]]} => matrix: found .. is singular
color_matrix={method="given", matrix=[[1,0,0], [0,1,0]]} => matrix: found .. three rows of three
white_balance={method="white_patch", percentile=0} => percentile: found 0:
white_balance={method="white_patch", percentile=101} => percentile: found 101
quantize={black_level=600, white_level=500} => white_level must be above
quantize.white_level=500 => white_level must be above
motion_blur.length=300.0 => motion_blur.length .. 200
motion_blur.rotation=1.0 => rotation needs a focal length; set fx
motion_blur={method="perspective", rotation=1.0} => perspective needs a focal length; set fx
motion_blur={rotation=9.0, fx=5000.0} => a streak of 792 px; at most
motion_blur={rotation=1.0, fx=99.0, length=1.0} => set either length or rotation
camera="sony-imx686"; optical_blur.f_number=2.0 => diffraction needs this parameter
optical_blur.psf="none.exr" => none.exr: no such file
defocus={method="thin_lens", focus_distance=0.04} => the focal length of 50 mm. Check depth_scale
defocus={method="thin_lens", blades=3} => 5 to 9 blades
defocus={method="thin_lens", sensor_width=36.0, pixel_pitch=5.0} => either sensor_width or pixel
defocus.method="thin_lens"; camera="sony-imx686" => sensor_width: this stage needs the pixel size
"""


@pytest.mark.parametrize(("text", "parts"), rows(SETTINGS))
def test_wrong_settings_are_rejected(text, parts):
    with pytest.raises(RequestError) as caught:
        make_chain(settings_from(tomllib.loads(text.replace("; ", "\n"))))
    for part in parts.split(" .. "):
        assert part in str(caught.value)


SMALL = {"device": "numpy", "stages": ["exposure", "gamma"]}
WHOLE = "expected a whole number from 1 to"
RUNS = [
    ({"iso": [100, 100]}, r"^iso: found \[100, 100\], which lists 100 twice"),
    ({"truth": "cleen"}, r"unknown truth 'cleen' \(did you mean 'clean'"),
    ({"patch": 0}, "found patch 0; expected a whole number from 1"),
    ({"patch": api.Patches(8, 10**4)}, "found patches_per_image 10000; expected a whole"),
    ({"frames": 0}, f"found frames 0; {WHOLE} 100000"),
    ({"frames": 10**9}, f"found frames 1000000000; {WHOLE} 100000"),
    ({"frames": "2"}, "found frames '2'; expected a whole number or None"),
    ({"jobs": -1}, f"found jobs -1; {WHOLE} 1024"),
    ({"webdataset": 0}, f"found webdataset 0; {WHOLE}"),
    ({"max_pixels": 0}, f"found max_pixels 0; {WHOLE}"),
    ({"memory": 0}, "^memory: '0' is not a size"),
    ({"format": "gif"}, "unknown format 'gif'"),
    ({"transfer": "x"}, "found transfer 'x'; expected 'srgb', 'linear' or None"),
    ({"bracket": [1, 1]}, r"^bracket: found \[1, 1\], which repeats \+1 EV"),
    ({"bracket": [float("nan")]}, r"^bracket: found \[nan\]; expected EVs"),
    ({"redo": "some"}, "found redo 'some'"),
    ({"stages": ["normalize", "demosaic"], "layer": "a"}, "^layer: .* only for renders"),
    ({"nosuch": 1}, "nosuch"),
    ({"output": ""}, "output: found an empty path; name a directory"),
    ({"output": "out.jpg"}, "the name of a picture"),
    ({"format": ["mp4", "jpg"]}, "found mp4, jpg, but a run writes either clips"),
    ({"format": "mp4", "keep": "all"}, "keep: a clip contains only pictures"),
    ({"format": "mp4", "patch": 8}, "patch: a clip contains only pictures"),
    ({"format": "mp4", "webdataset": 8}, "webdataset: a clip contains only pictures"),
    ({"format": "mp4", "truth": "mosaic"}, "truth: found mosaic, but a clip contains only"),
    ({"format": "mp4", "codec": "ffv1"}, r"found a \.mp4 file for ffv1; expected \.mkv"),
    ({"format": "mp4", "stages": ["mosaic"]}, "the chain ends in mosaic, but a clip"),
    ({"format": "mp4", "processes": 2}, "processes: a clip is encoded by one process"),
    ({"format": "mp4", "bit_depth": 9}, "found h264 with 9 bits; expected h264 with 8 bits"),
    ({"format": "mp4", "crf": 60}, "found crf 60; expected"),
    ({"fps": 25}, "fps: this option needs a clip; use output='NAME.mp4', or format='mp4'"),
    ({"decoded": True}, "decoded: this option needs a clip"),
]


@pytest.mark.parametrize(("options", "message"), RUNS)
def test_a_wrong_run_is_rejected_at_once(folder, options, message):
    start = {"start_at": "normalize"} if "layer" in options else {}
    with pytest.raises(RequestError, match=message):
        api.run(**{"inputs": "in", "output": "out", **SMALL, **start, **options})
    assert not Path("out").exists()


MOSAIC = {"until": "normalize"}
SAMPLES = [
    ({"isos": 3}, "isos"),
    ({"keep": "demosiac"}, "demosaic"),
    ({"truth": True, "skip": ["sensor_noise", "row_noise", "column_noise"]}, "adds noise"),
    ({"epoch": -1}, "found epoch -1"),
    *(({"epochs": epochs}, "found epochs") for epochs in (0, -1, 1.5)),
    ({"truth": "mosaic"}, "expected true or false, 'development', 'clean' or None"),
    ({"keep": 5}, "found keep 5; expected a text, a list of texts or None"),
    ({"start_at": 5}, "found start_at 5; expected a text or None"),
    ({"threads": 0}, "found threads 0; expected 1 or more"),
    ({"threads": "all"}, "found threads 'all'; expected a whole number or None"),
    ({"transfer": "gamma"}, "found transfer 'gamma'; expected .*'srgb', 'linear'"),
    ({"config": "none.toml"}, "none.toml: there is no such file"),
    ({"config": 5}, "found config 5"),
    ({"patch": 0}, "patch: found 0; expected a whole number of 1 or more"),
    ({"patch": 9, "raw": "packed"}, "found patch 9, but a packed raw has planes of half the size"),
    ({"dtype": "int8"}, "unknown dtype 'int8'.*; allowed: float16, float32, uint16"),
    ({"dtype": "half float"}, "unknown dtype 'half float'"),
    ({"dtype": "uint16", **MOSAIC}, "dtype uint16: .* the chain ends in mosaic"),
    ({"dtype": "float16", "until": "quantize"}, "dtype float16: the chain ends in DN, which this"),
    ({"raw": "bayer"}, "found raw 'bayer'; expected .*'packed', 'mosaic'"),
    ({"raw": "mosaic", "until": "exposure"}, "makes no raw in DN. Add the stage quantize"),
    ({"raw": "mosaic", "dtype": "float32", "until": "quantize"}, "ends in DN, at quantize"),
    ({"variance": True, "until": "exposure"}, "no stage of this chain adds noise"),
    ({"cache": "much"}, "found cache 'much'; expected bytes, or a size such as 512M"),
    ({"cache": -1}, "found cache -1"),
    ({"inputs": "none/"}, "none.*: there is no such file or folder"),
    ({"inputs": ["in/a.exr", "in/none.exr"]}, "none.*: there is no such file or folder"),
    ({"inputs": "m.csv"}, "none.*: there is no such file or folder"),
    ({"inputs": 5}, "found inputs 5; expected a text, a path or a"),
    ({"inputs": "in/*.png"}, "no file matches"),
    ({"inputs": ["in/a.exr", "in"]}, r"have the same name a\.exr"),
]


@pytest.mark.parametrize(("options", "message"), SAMPLES)
def test_a_wrong_dataset_is_rejected_at_once(folder, options, message):
    with pytest.raises(RequestError, match=message):
        api.Dataset(**{"inputs": "in", "device": "numpy", **options})


def test_patches_that_do_not_fit_are_rejected(folder):
    for per_image in (0, "all"):
        with pytest.raises(RequestError, match=f"per_image: found {per_image!r}; exp.* or 'grid'"):
            api.Patches(8, per_image)
    with pytest.raises(ImageError, match=r"in/a\.exr: .*13x9 pixels, .* 10x10; choose smal"):
        list(api.Dataset("in", device="numpy", patch=10, until="mosaic"))
    with pytest.raises(ImageError, match=r"in/a\.exr: .*13x9 .*even width and height"):
        list(api.Dataset("in", device="numpy", raw="packed", until="quantize"))
