"""Spectral renders: bands in files and arrays, through a sensor's filters."""

import json
import mmap
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

import clpipe
from clpipe.analysis.noise_models.read import import_camera
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.memory import release_pages
from clpipe.camera.profile import SRGB_TO_XYZ, load_camera
from clpipe.camera.spectra import GRID, ILLUMINANTS, band_weights, light, observer, sight_of
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.check import SIZES
from clpipe.engine.runner import Runner
from clpipe.explorer.file_names import files_in
from clpipe.images import claims, samples
from clpipe.images.claims import claim_of
from clpipe.images.read import read_image
from clpipe.images.spectral import spectra_in
from clpipe.images.two_lights import Light, camera_to_srgb
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.filter_array import parse_array


def test_names_of_wavelengths():
    for form in ("S0.{},25nm", "S0.{}.25nm", "{}.25nm", "band.{}.25nm", "my.layer.{},25nm"):
        names = ["B", *(form.format(nm) for nm in (700, 400, 500, 600)), "A"]
        [spectrum] = spectra_in(names)
        assert spectrum.wavelengths == (400.25, 500.25, 600.25, 700.25), form
        assert spectrum.channels == (2, 3, 4, 1)
        assert spectrum.layer == form.partition("{}")[0].rstrip(".")


def test_other_units_and_exponents():
    names = ["0.4um", "4.5e-7m", "S0.5,0E2nm", "599.584916THz", "550nm", "600nm"]
    [spectrum] = spectra_in(names)
    assert spectrum.wavelengths == pytest.approx((400, 450, 500, 550, 600))
    assert spectra_in([*names, *(f"S0.{nm}nm" for nm in (400, 450, 600))])[1].layer == "S0"


def test_stokes_and_reflective_layers_are_apart():
    names = [f"{layer}.{nm},0nm" for layer in ("S1", "S0", "T") for nm in range(400, 800, 100)]
    assert [each.layer for each in spectra_in(names)] == ["S0", "S1", "T"]
    assert spectra_in(names)[0].channels == (4, 5, 6, 7)


@pytest.mark.parametrize(
    "names",
    [
        ["R", "G", "B", "A", "Z"],
        ["400nm", "500nm", "600nm"],
        ["Depth.Z", "uv.m", "12m.x", "S0.nm", "S0.,5nm", "nm", "5 nm", "4mm", "5mm", "6mm"],
    ],
)
def test_other_channels_are_no_spectrum(names):
    assert spectra_in(names) == []


@pytest.fixture
def write(tmp_path):
    def written(names, half=False, tiled=False, **attributes):
        path = tmp_path / "spectral.exr"
        spec = oiio.ImageSpec(12, 8, len(names), oiio.HALF if half else oiio.FLOAT)
        spec.channelnames = names
        if tiled:
            spec.tile_width = spec.tile_height = 4
        for name, value in attributes.items():
            spec.attribute(name, value)
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), spec)
        output.write_image(np.random.default_rng(0).random((8, 12, len(names)), np.float32))
        output.close()
        return path

    return written


BANDS = [f"S0.{nm},00nm" for nm in range(400, 710, 10)]


def test_bands_next_to_a_picture_are_named(write):
    image = read_image(write(["R", "G", "B", *BANDS]))
    [warning] = image.warnings
    assert warning == (
        "its 31 spectral bands from 400 to 700 nm (layer S0) are not used; to read them, add "
        "--layer spectral"
    )


@pytest.mark.parametrize(
    ("names", "layer", "found"),
    [
        (["R", "G", "B", *BANDS], "spectral", BANDS),
        (["R", "G", "B", *BANDS], "s0", BANDS),
        (["R", "G", "B", *BANDS], "RGB", "RGB"),
        (["R", "G", "B", *BANDS], None, "RGB"),
        (BANDS, None, BANDS),
        ([*BANDS[::-1], "T.400,0nm", "T.500,0nm", "T.600,0nm", "T.700,0nm"], None, BANDS),
        ([f"{nm}" for nm in range(400, 710, 100)], None, ["400", "500", "600", "700"]),
        ([f"band_{nm}nm" for nm in (550, 500, 450, 600)], None, "450 500 550 600"),
        ([*BANDS[:4], *(name.replace("S0", "S2") for name in BANDS[:4])], "S0", BANDS[:4]),
    ],
)
def test_what_is_read(names, layer, found, write):
    path = write(names)
    image = read_image(path, layer=layer)
    samples = oiio.ImageBuf(str(path)).get_pixels()
    stored = oiio.ImageBuf(str(path)).spec().channelnames
    if found == "450 500 550 600":
        found = [f"band_{nm}nm" for nm in found.split()]
    expected = np.stack([samples[..., stored.index(name)] for name in found], -1)
    assert np.array_equal(image.pixels, expected)
    assert len(image.wavelengths) == (0 if found == "RGB" else len(found))


@pytest.mark.parametrize(
    ("names", "layer", "message"),
    [
        ([name.replace("S0", "T") for name in BANDS], None, "reflectances or parts of polarised"),
        ([name.replace("S0", "T") for name in BANDS], "T", "reflectances or parts of polarised"),
        (BANDS[:4] + [n.replace("S0", "S1") for n in BANDS[:4]], None, r"polarised \(layers S1\)"),
        ([*BANDS[:4], *(n.replace("S0", "fog") for n in BANDS[:4])], None, "2 layers hold"),
        ([*BANDS[:4], "S0.400,0nm"], None, "two of its channels are the band of 400 nm"),
        (BANDS, "RGB", r"no layer 'RGB', but 31 spectral bands from 400 to 700 nm \(layer S0\)"),
    ],
)
def test_rejected_bands(names, layer, message, write):
    with pytest.raises(ImageError, match=message):
        read_image(write(names), layer=layer)


def write_parts(path, *parts):
    """Write an EXR with parts, each given by its name, its channels and its value."""
    specs = []
    for name, channels, _ in parts:
        spec = oiio.ImageSpec(12, 8, len(channels), oiio.FLOAT)
        spec.channelnames = channels
        spec.attribute("oiio:subimagename", name)
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), tuple(specs))
    for number, (spec, (_, channels, value)) in enumerate(zip(specs, parts, strict=True)):
        if number:
            assert output.open(str(path), spec, "AppendSubimage")
        output.write_image(np.full((8, 12, len(channels)), value, np.float32))
    output.close()
    return path


def test_bands_among_parts_and_aovs(tmp_path, write):
    path, nm = tmp_path / "parts.exr", [f"{nm}nm" for nm in (400, 500, 600, 700)]
    reflective, emitted = ("T", nm, 3.0), ("S0", nm, 2.0)
    for parts, layer, value in (
        ((reflective, emitted), None, 2),
        ((reflective, emitted), "S0", 2),
        ((("left", BANDS, 1.0), ("right", BANDS, 2.0)), "right", 2),
        ((("left", BANDS, 1.0), ("right", BANDS, 2.0)), "right.S0", 2),
        ((("rgb", list("RGB"), 1.0), ("light", nm, 2.0)), "light", 2),
        ((("rgb", list("RGB"), 1.0), ("light", nm, 2.0)), "spectral", 2),
        ((("rgb", list("RGB"), 1.0), ("light", nm, 2.0)), None, 1),
    ):
        image = read_image(write_parts(path, *parts), layer=layer)
        assert (image.pixels == value).all(), (parts, layer)
        assert bool(image.wavelengths) == (value == 2)
    [warning] = image.warnings
    assert "(layer light) are not used; to read them, add --layer spectral" in warning
    with pytest.raises(ImageError, match="reflectances or parts of polarised"):
        read_image(write_parts(path, reflective, ("S1", nm, 1.0)))
    for others in (["albedo.R", "albedo.G", "albedo.B"], ["Y"]):
        assert len(read_image(write([*BANDS, *others])).wavelengths) == 31


def test_attributes_that_are_not_applied(write):
    path = write(BANDS, EV=1.0, cameraResponse="400:1;700:1", generatedBy="Mitsuba version 3.9.1")
    warnings = read_image(path).warnings
    assert warnings[0] == "its EV, 1.0, is not applied"
    assert [warning.split(",")[0] for warning in warnings] == [
        "its EV",
        "its cameraResponse",
        "its bands are read as radiance per nm; the response of each band of Mitsuba's specfilm "
        "must therefore have the integral 1",
    ]


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("half", [False, True])
def test_a_cube_that_is_read_to_disk(half, tiled, write, monkeypatch):
    names = ["R", "S0.500,0nm", "S0.400,0nm", "G", "S0.700,0nm", "B", "S0.600,0nm"]
    path = write(names, half=half, tiled=tiled)
    whole = read_image(path, layer="spectral")
    claim = claim_of(path, layer="spectral")
    assert claim.image == 8 * 12 * 4 * (2 if half else 4)
    for module in (samples, claims):
        monkeypatch.setattr(module, "LARGE_CUBE", 100)
        monkeypatch.setattr(module, "STRIP", 12 * 7 * 3)  # three rows
    stored = read_image(path, layer="spectral")
    assert claim_of(path, layer="spectral").image == 12 * 7 * 3 * 4
    assert isinstance(stored.pixels, np.memmap)
    assert stored.pixels.dtype == whole.pixels.dtype == (np.float16 if half else np.float32)
    assert np.array_equal(stored.pixels, whole.pixels)
    assert stored.wavelengths == whole.wavelengths == (400, 500, 600, 700)


@pytest.mark.parametrize("overscan", [False, True])
def test_a_cube_on_the_disk_has_the_display_window(overscan, write_exr, monkeypatch):
    windows = {"x": -2, "y": 3, "full_width": 9, "full_height": 14}
    pixels = np.random.default_rng(0).random((8, 12, 5)).astype(np.float32)
    path = write_exr(
        "a.exr",
        pixels,
        ",".join(name.replace(",", ".") for name in BANDS[:5]),
        half=False,
        **windows,
    )
    whole = read_image(path, overscan=overscan)
    monkeypatch.setattr(samples, "LARGE_CUBE", 100)
    monkeypatch.setattr(samples, "STRIP", 12 * 5)
    stored = read_image(path, overscan=overscan)
    assert isinstance(stored.pixels, np.memmap)
    assert np.array_equal(stored.pixels, whole.pixels) and stored.margins == whole.margins


def test_a_cube_that_does_not_fit_on_the_disk(write, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(samples, "LARGE_CUBE", 100)
    monkeypatch.setattr(samples, "reserve", full)
    with pytest.raises(ImageError, match="No space left on device; set TMPDIR"):
        read_image(write(BANDS))


NM = tuple(float(nm) for nm in range(400, 710, 10))
RENDER = {"wavelengths": NM}


def cube(height, width, bands=31, seed=0):
    return np.random.default_rng(seed).random((height, width, bands)).astype(np.float32)


def mosaic_of(array):
    bayer = {"pattern": array}
    return {"mosaic": bayer if array in PATTERNS else {"method": "array", "array": array}}


LAYOUTS = {
    "interleaved": lambda pixels: pixels,
    "planes": lambda pixels: np.ascontiguousarray(pixels.transpose(2, 0, 1)).transpose(1, 2, 0),
    "half": lambda pixels: pixels.astype(np.float16),
}


@pytest.mark.parametrize("array", [*PATTERNS, "x-trans", "RCCB", "mono", "RGBW", "CMYG"])
def test_kernels_at_sites_agree_with_the_reference(array, device, scalar_device):
    """A mosaic is the same, whether all colours of a pixel are computed or only one."""
    stages = ("spectral_response", "exposure", "mosaic")
    chain = make_chain(settings_from({"stages": stages, "render": RENDER, **mosaic_of(array)}))
    assert (chain.steps[0].passes[0].function == "site_response") == (array in ("RGBW", "CMYG"))
    for size in SIZES:
        for layout in LAYOUTS.values():
            pixels = layout(cube(*size))
            found = []
            for where in (None, device, scalar_device):
                for keep in ((), ("spectral_response",)):
                    runner = Runner(chain, where, keep, encode=False, final=True)
                    function = runner.chain.steps[0].passes[0].function
                    assert (function == "site_response") == (not keep or array in ("RGBW", "CMYG"))
                    found.append(runner.run(pixels, "a").final)
            assert all(np.array_equal(each, found[0]) for each in found), (size, array)


def test_colours_are_the_integrals():
    """Each of a Bayer pattern's samples is the integral of light and sensitivity, within 1e-5."""
    camera = load_camera("canon-5d3")
    bands = (380.0, 400, 415, 430, 470, 500, 520, 560, 580, 610, 640, 660, 700, 740)
    pixels = cube(6, 8, len(bands))
    shot = clpipe.Pipeline(
        camera="canon-5d3",
        device="numpy",
        stages=["spectral_response", "mosaic", "inverse_white_balance"],
        render={"wavelengths": bands, "illuminant": "A"},
    )(pixels)
    nm = np.arange(300.001, 1100, 0.002)
    middles = (np.array(bands[1:]) + bands[:-1]) / 2
    curves = camera.sensitivities
    light_a = (560 / nm) ** 5 * np.expm1(1.435e7 / 2848 / 560) / np.expm1(1.435e7 / 2848 / nm)
    y = np.interp(nm, GRID, observer()[:, 1])
    light_a /= (light_a * y).sum() / y.sum()
    green = np.interp(nm, curves.wavelengths, curves.curves["G"], 0, 0)
    # Between the ends of the outer bands, light is that of the band whose edges are around it.
    inside = (nm > 2 * bands[0] - middles[0]) & (nm < 2 * bands[-1] - middles[-1])
    band = np.searchsorted(middles, nm)
    for colour, (y, x) in {"R": (0, 0), "G": (0, 1), "B": (1, 1)}.items():
        own = np.interp(nm, curves.wavelengths, curves.curves[colour], 0, 0) * inside
        sums = np.bincount(band, own, len(bands))
        expected = pixels[y::2, x::2] @ sums / (green * light_a).sum()
        assert shot.image[y::2, x::2] == pytest.approx(expected, rel=1e-5)


def metamers():
    """Return two spectra of one XYZ, of which a camera's red, green and blue differ."""
    seen = band_weights(observer(), NM)
    response = sight_of(load_camera("sony-a7r2"), "D65").weights(NM, "RGB")
    blind = np.eye(len(NM)) - seen @ np.linalg.pinv(seen)  # to what the observer does not see
    change = blind @ response @ [1, -1, 0.3]
    grey = np.full(len(NM), 0.5)
    return grey, grey + change * 0.4 / np.abs(change).max()


def test_metamers():
    pixels = np.stack(metamers()).astype(np.float32)[None]
    assert pixels.min() > 0
    stages = ["spectral_response", "color_matrix"]
    for method, (least, most) in {"xyz": (0, 1e-6), "srgb": (0, 1e-5), "camera": (0.01, 1)}.items():
        settings = {"stages": stages, "spectral_response": {"method": method}, "render": RENDER}
        one, two = clpipe.Pipeline(device="numpy", **settings)(pixels).image[0]
        assert least <= np.abs(one - two).max() <= most


def test_white_is_white(develop):
    """A card in the scene's light is grey, and the raw has the sensor's own colours."""
    nm = np.arange(380.0, 781, 5)
    for lamp in ILLUMINANTS:
        card = 0.25 * np.interp(nm, GRID, light(lamp))
        pixels = np.broadcast_to(card.astype(np.float32), (16, 16, nm.size))
        shot = develop(
            pixels,
            keep=("quantize", "color_matrix"),
            numpy=True,
            skip=["noise"],
            render={"wavelengths": nm.tolist(), "illuminant": lamp},
        )
        assert shot.kept["color_matrix"] == pytest.approx(0.125, rel=0.01)
        raw = shot.kept["quantize"] - 512
        red, blue = sight_of(load_camera("sony-a7r2"), lamp).gains
        assert raw[0, 1] / raw[0, 0] == pytest.approx(red, rel=0.01)
        assert raw[0, 1] / raw[1, 1] == pytest.approx(blue, rel=0.01)


def test_a_clear_pixel_gets_more_light(develop):
    """White fills the clear pixels of RGBW, and the others as far as their sensitivities say."""
    card = np.broadcast_to(np.interp(NM, GRID, light("D65")).astype(np.float32) / 2, (8, 8, 31))
    settings = {"render": RENDER, "skip": ["optical_blur", "noise"], **mosaic_of("RGBW")}
    raw = develop(card, keep=("inverse_white_balance",), **settings).kept["inverse_white_balance"]
    sight = sight_of(load_camera("sony-a7r2"), "D65")
    rows = parse_array("RGBW").rows
    for y, x in np.ndindex(4, 4):
        expected = sight.white(rows[y][x]) / sight.white("W") / 4
        assert raw[y, x] == pytest.approx(expected, rel=0.02)
    with pytest.raises(RequestError, match=r"at most three .* RGBW has R, G, B, W; skip optical_"):
        clpipe.Pipeline(device="numpy", render=RENDER, **mosaic_of("RGBW"))


def test_tiles_are_the_whole(device):
    chain = make_chain(settings_from({"render": RENDER, "iso": 800}))
    runner = Runner(chain, device, encode=True)
    for pixels in (cube(300, 520), LAYOUTS["half"](cube(300, 520))):
        whole = runner.run(pixels, "a").encoded
        before, device.memory = device.memory, 5 << 20
        try:
            tiles = runner.run(pixels, "a").encoded
        finally:
            device.memory = before
        assert np.array_equal(whole, tiles)


def test_mapped_memory_is_released(tmp_path):
    path = tmp_path / "cube.npy"
    np.save(path, cube(40, 50))
    camera = clpipe.Pipeline(device="numpy", render=RENDER)
    expected = camera(np.load(path), "a").image
    for mode in ("r", "r+", "c"):
        assert np.array_equal(camera(np.load(path, mmap_mode=mode), "a").image, expected)
    # Changes of a private mapping are only in memory.
    private = mmap.mmap(-1, 4 * cube(40, 50).size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    for changed in (
        np.load(path, mmap_mode="c"),
        np.ndarray((40, 50, 31), np.float32, private),
    ):
        changed[:] = 0.25
        release_pages(changed)
        assert (changed == 0.25).all()


def test_charge_of_a_radiance():
    """Electrons follow from radiance, aperture, time, pixel and quantum efficiency."""
    camera = load_camera("sony-a7r2")
    nm = np.arange(380.0, 781, 5)
    pixels = np.full((8, 8, nm.size), 0.002, np.float32)  # W/(m2 sr nm)
    optics = {"f_number": 4.0, "exposure_time": 0.02}
    shot = clpipe.Pipeline(
        device="numpy",
        iso=400,
        keep="quantize",
        skip=["noise", "optical_blur"],
        render={"wavelengths": nm.tolist()},
        exposure={"method": "radiometric", "quantum_efficiency": 0.5, **optics},
    )(pixels)
    raw = (shot.kept["quantize"] - 512) / (camera.noise(400).a * camera.signal_range)
    curves = {c: np.array(v) / nm for c, v in camera.sensitivities.curves.items()}
    scale = 0.5 / max(curve.max() for curve in curves.values())
    etendue = (camera.pixel_pitch * 1e-6) ** 2 * np.pi / 4 / 4.0**2
    energy = 6.62607015e-34 * 299792458 / (nm * 1e-9)
    for colour, place in {"R": (0, 0), "G": (0, 1), "B": (1, 1)}.items():
        photons = 0.002 / energy * etendue * 0.02
        expected = np.trapezoid(photons * scale * curves[colour], nm)
        assert raw[place] == pytest.approx(expected, rel=2e-3)
    with pytest.raises(RequestError, match="needs spectral bands, but the image is read as red"):
        clpipe.Pipeline(
            device="numpy", exposure={"method": "radiometric", "quantum_efficiency": 0.5}
        )(np.ones((8, 8, 3), np.float32))
    with pytest.raises(RequestError, match=r"set exposure\.quantum_efficiency"):
        clpipe.Pipeline(device="numpy", render=RENDER, exposure={"method": "radiometric"})


def test_an_rgb_render_under_lamps(develop):
    """Grey stays grey, the raw is that of the lamp, and colours are as a camera's matrix makes."""
    grey, red = np.full((16, 16, 3), 0.25, np.float32), np.zeros((16, 16, 3), np.float32)
    red[..., 0] = 0.25
    for lamp in ILLUMINANTS:
        sight = sight_of(load_camera("sony-a7r2"), lamp)
        settings = {"render": {"illuminant": lamp}, "skip": ["noise"], "numpy": True}
        keep = ("inverse_color_matrix", "quantize", "color_matrix")
        shot = develop(grey, keep=keep, **settings).kept
        raw = shot["quantize"] - 512
        assert raw[0, 1] / raw[0, 0] == pytest.approx(sight.gains[0], rel=0.01)
        assert shot["color_matrix"] == pytest.approx(0.125, rel=0.01)
        shot = develop(red, keep=keep, **settings).kept
        seen = 0.25 * sight.from_srgb[:, 0]
        assert shot["inverse_color_matrix"][0, 0] == pytest.approx(seen, rel=1e-5)
        expected = sight.to_srgb @ seen / 2
        assert shot["color_matrix"][8, 8] == pytest.approx(expected, abs=2e-3)


def test_what_contradicts_itself():
    """Spectra that are not read with the sensor's curves have neither a lamp nor a charge."""
    srgb = {"spectral_response": {"method": "srgb"}, "render": RENDER}
    for settings, message in (
        ({**srgb, "render": {**RENDER, "illuminant": "A"}}, "already contain their light"),
        ({"stages": ["exposure", "spectral_response"], "render": RENDER}, "list it as the first"),
        (
            {**mosaic_of("RGBW"), "render": RENDER, "until": "exposure"},
            "end the chain at",
        ),
        ({**mosaic_of("polarised"), "render": RENDER}, "spectra are not polarised"),
    ):
        with pytest.raises(RequestError, match=message):
            clpipe.Pipeline(device="numpy", **settings)
    radiometric = {"exposure": {"method": "radiometric", "quantum_efficiency": 0.5}}
    camera = clpipe.Pipeline(device="numpy", **srgb, **radiometric)
    with pytest.raises(RequestError, match="needs spectral bands, but the image is read as red"):
        camera(cube(8, 8))


def test_methods_are_not_mixed_up():
    """Chains that differ only in this method are of different families."""
    pixels, found = cube(8, 8), {}
    for method in ("xyz", "srgb", "camera", "xyz", "camera"):
        settings = {"render": RENDER, "spectral_response": {"method": method}}
        camera = clpipe.Pipeline(device="numpy", until="spectral_response", **settings)
        assert np.array_equal(found.setdefault(method, camera(pixels).image), camera(pixels).image)
    assert len({image.tobytes() for image in found.values()}) == 3


def test_set_gains_do_not_change_a_raw():
    gains = {"red_gain": 1.2, "blue_gain": 1.9}
    for array in ("RGGB", "x-trans", "RCCB", "RGBW"):
        raws = [
            clpipe.Pipeline(
                device="numpy",
                until="inverse_white_balance",
                skip=["optical_blur"],
                render=RENDER,
                **mosaic_of(array),
                **set_,
            )(cube(12, 12) / 8).image
            for set_ in ({}, {"inverse_white_balance": gains})
        ]
        ratio = raws[1] / raws[0]  # arrays are exposed for their most sensitive channel
        assert ratio == pytest.approx(ratio[0, 0], rel=1e-5), array


def test_a_camera_without_sensitivities():
    for render in (RENDER, {"illuminant": "A"}):
        with pytest.raises(RequestError, match=r"nikon-d800: .* spectral_response\.method=srgb"):
            clpipe.Pipeline(device="numpy", camera="nikon-d800", render=render)
    camera = clpipe.Pipeline(
        device="numpy",
        camera="nikon-d800",
        render=RENDER,
        spectral_response={"method": "srgb"},
        keep="spectral_response",
    )
    pixels = cube(8, 8)
    shot = camera(pixels)
    rgb = clpipe.Pipeline(device="numpy", camera="nikon-d800")(
        shot.kept["spectral_response"], noise_key="a"
    )
    assert np.array_equal(camera(pixels, noise_key="a").image, rgb.image)


def test_a_camera_without_red_green_and_blue(tmp_path):
    path = tmp_path / "curves.csv"
    path.write_text("wavelength,C,M,Y,G\n400,1,1,0,0\n500,1,0,1,1\n600,0,1,1,0\n700,0,0.5,0.5,0\n")
    import_camera(path, "sony-a7r2", tmp_path / "cmyg.toml")
    settings = {"render": RENDER, "skip": ["optical_blur"], **mosaic_of("CMYG")}
    camera = clpipe.Pipeline(device="numpy", camera=str(tmp_path / "cmyg.toml"), **settings)
    with pytest.warns(UserWarning, match="not those of red, green and blue, so there is no matrix"):
        camera(cube(8, 8))


def test_bands_that_miss_light():
    with pytest.warns(UserWarning, match=r"its bands from 450 to 600 nm miss \d\d\.\d % of what R"):
        clpipe.Pipeline(device="numpy", render={"wavelengths": (450.0, 500, 550, 600)})(
            cube(8, 8, 4)
        )
    eye = {"spectral_response": {"method": "srgb"}, "render": {"wavelengths": (500.0, 550, 600)}}
    with pytest.warns(UserWarning, match=r"miss 7\.8 % of what the eye sees"):
        clpipe.Pipeline(device="numpy", **eye)(cube(8, 8, 3))
    with pytest.raises(ImageError, match=r"the 31 bands of render\.wavelengths"):
        clpipe.Pipeline(device="numpy", render=RENDER)(cube(8, 8, 3))
    for wrong in ((500.0, 400.0), (500.0,)):
        with pytest.raises(RequestError, match="must be two or more, and ascend"):
            clpipe.Pipeline(render={"wavelengths": wrong})


def test_a_run(write, clpipe):
    path = write(BANDS)
    words = ("run", path.name, "-o", "out", "--skip", "optical_blur")
    truths = ("--truth", "xyz", "--truth", "srgb")
    clpipe(*words, *truths)
    pixels = read_image(path).pixels
    xyz = oiio.ImageBuf("out/spectral.truth_xyz.exr")
    assert xyz.spec().channelnames == ("X", "Y", "Z")
    expected = pixels.astype(np.float64) @ band_weights(observer(), NM)
    assert xyz.get_pixels() == pytest.approx(expected, rel=1e-5)
    srgb = expected @ np.linalg.inv(SRGB_TO_XYZ).T
    light = read_image(Path("out/spectral.truth_srgb.exr"))
    assert light.pixels == pytest.approx(srgb, abs=1e-5) and not light.warnings
    light = read_image(Path("out/spectral.truth_xyz.exr"))
    assert light.pixels == pytest.approx(srgb, abs=1e-4)
    # A second run finds it, and a replay makes the same bytes.
    assert "already" in clpipe(*words, *truths).stderr
    assert "same bytes" in clpipe("replay", "out/spectral.json", "-o", "again").output
    for more, message in (
        (("--start-at", "exposure"), "31 spectral bands, with which a chain begins"),
        (("--set", "render.wavelengths=[400,500]"), "but the image states those of its 31 bands"),
    ):
        assert message in clpipe("run", path.name, "-o", "no", *more, status=(1, 2)).stderr
    write(["R", "G", "B"])
    assert "needs the bands" in clpipe(*words, *truths, status=(1, 2)).stderr


def test_kept_images_go_on(write, clpipe):
    path = write(BANDS)
    clpipe("run", path.name, "-o", "out", "--keep", "all", "--format", "png")
    whole = oiio.ImageBuf("out/spectral.png").get_pixels()
    for kept, step in (
        ("spectral_response", "projection"),
        ("mosaic", "inverse_white_balance"),
        ("quantize", "normalize"),
    ):
        file = f"out/spectral.{kept}.exr"
        clpipe("run", file, "-o", "on", "--start-at", step, "--format", "png", "--redo", "all")
        again = oiio.ImageBuf(f"on/spectral.{kept}.png").get_pixels()
        assert np.array_equal(again, whole), kept


def test_light_of_a_chain_without_a_mosaic(write, clpipe):
    path = write(BANDS)
    stages = ("--stages", "exposure,tone_curve,gamma", "--set", "spectral_response.method=srgb")
    clpipe("run", path.name, "-o", "out", *stages, "--truth", "xyz")
    expected = read_image(path).pixels.astype(np.float64) @ band_weights(observer(), NM)
    found = oiio.ImageBuf("out/spectral.truth_xyz.exr").get_pixels()
    assert found == pytest.approx(expected, rel=1e-5)


def test_subframes_with_other_bands(write_exr, clpipe):
    for number, shift in enumerate((0, 0, 5)):
        names = ",".join(f"{nm + shift}nm" for nm in (400, 500, 600, 700))
        write_exr(f"in/f.{number:04}.exr", np.full((8, 12, 4), 0.5 + number), names, half=False)
    words = ("run", "in/f.%04d.exr", "-o", "out", "--set", "shutter.subframes=3")
    message = clpipe(*words, status=1).stderr
    assert "f.0002.exr: its spectral bands are not those of" in message


def test_a_page_names_no_lamp():
    lamps = {"choice": ["A", "/etc/lamp.csv"]}
    assert list(files_in({"render": {"illuminant": lamps}})) == [
        ("render.illuminant", "/etc/lamp.csv")
    ]


def test_a_lamp_drawn_for_each_render(renders, clpipe):
    lamps = '{ choice = ["A", "D65", "lamp.csv"] }'
    Path("lamp.csv").write_text("400,1\n700,1\n")
    Path("c.toml").write_text(f"[render]\nilluminant = {lamps}\n")
    clpipe("run", renders(8), "-o", "out", "-c", "c.toml", "--format", "png")
    records = [json.loads(path.read_text()) for path in sorted(Path("out").glob("*.json"))]
    gains = {record["output"]["illuminant"]: record["photometry"]["gains"] for record in records}
    assert 1 < len(gains) == len({tuple(each["light"]) for each in gains.values()}) <= 3


def test_a_dng_has_the_colours_of_two_lights(write, clpipe):
    path = write(BANDS)
    for number, lamp in enumerate(("A", "D65")):
        settings = ("--set", f"render.illuminant={lamp}")
        clpipe("run", path.name, "-o", lamp, "--format", "dng", *settings)
        with Image.open(f"{lamp}/spectral.dng") as image:
            tags = dict(image.tag_v2)
        assert [tags[50778], tags[50779]] == [17, 21]
        tables = 50721, 50722, 50964, 50965
        matrices = {tag: np.array(tags[tag], float).reshape(3, 3) for tag in tables}
        sight = sight_of(load_camera("sony-a7r2"), lamp)
        # The matrix for this light makes of its white what the raw has of it.
        seen = matrices[50721 + number] @ sight.white_xyz
        neutral = np.array([1 / sight.gains[0], 1, 1 / sight.gains[1]])
        assert seen / seen[1] == pytest.approx(neutral, rel=1e-4)
        assert matrices[50964 + number].sum(1) == pytest.approx([0.9642, 1, 0.8251], abs=1e-4)
        # clpipe reads it with the matrix for this light.
        lights = Light(2856, matrices[50721]), Light(6504, matrices[50722])
        to_srgb, temperature = camera_to_srgb(*lights, neutral)
        assert temperature == pytest.approx({"A": 2856, "D65": 6504}[lamp], rel=0.02)
        assert to_srgb == pytest.approx(sight.to_srgb, abs=0.02)
