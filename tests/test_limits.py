"""What the documentation says clpipe cannot do: each sentence names its test, or is no claim of it.

A sentence with one of :data:`WORDS` needs an entry in :data:`SENTENCES`.
"""

import re
from collections import Counter

import pytest

from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.images.pixels import DEFAULT_MAX_PIXELS
from clpipe.stage import StageRole
from tests.conftest import ROOT, STILL_LIFE, run_cli

WORDS = re.compile(
    r"\b(cannot|(?:was|were) not measured|never (?:tested|run)|not (?:simulated|supported|shown)"
    r"|has not been)\b"
)
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))

OTHERS = "another program, format or method cannot do it"
EVIDENCE = "it says what was not tried"
PANORAMA = "test_wide.py::test_panoramas_have_no"
ADVICE = "it explains a value or gives advice"

# A part of a sentence, and its test or the kind of statement that it is.
SENTENCES = {
    "Code that cannot be traced": "test_families.py::test_what_cannot_be_replaced_is_refused",
    "clpipe cannot read as an image": "test_transfers.py::test_errors_of_files_have_a_class",
    "a picture that cannot be written": "test_batch.py::test_the_disk_is_full",
    "auto exposure cannot avoid noise": ADVICE,
    "COLMAP cannot represent them": OTHERS,
    "whose common speed was not measured": EVIDENCE,
    "Settings cannot be keyframed": OTHERS,
    "If the lens cannot show the end": "test_carry.py::test_a_place_that_a_lens_does_not_show",
    "a figure cannot be measured": ADVICE,
    "never run": EVIDENCE,
    "has not been built on a machine with a GPU": EVIDENCE,
    "cannot have sub-frames or annotations": PANORAMA,
    "sub-frames cannot have a rolling shutter": PANORAMA,
    "`projection` cannot be combined": "test_wide.py::test_what_is_of_perspective_pictures",
    "are not simulated": ADVICE,
    "You cannot combine it with a": "test_wide.py::test_what_is_of_perspective_pictures",
    "COLMAP's files cannot describe": OTHERS,
    "cannot be flipped or rotated": "test_annotations.py::test_kittis_boxes",
    "Annotations of panoramas cannot": PANORAMA,
    "[not shown](recipes/denoiser.md": EVIDENCE,
    "NoiseProfile, which cannot describe": OTHERS,
    "cannot rotate normals and flow": "test_patches.py::test_layers_go_along",
    "what its threads cannot share": ADVICE,
    "This was never tested": EVIDENCE,
    "samples on a GPU was not measured": EVIDENCE,
    "which cannot distinguish green from blue": ADVICE,
    "`--webdataset` cannot be combined with `--dask`": "test_limits.py::test_tars_need_no_dask",
    "which cannot represent a rational model": OTHERS,
    "cannot undistort a raw": ADVICE,
    "Arrays that ROS cannot name": "test_camera_info.py::test_the_raw",
    "if an array cannot distinguish": "test_filter_arrays.py::test_flat_colours_stay",
    "which DNG cannot describe": "test_filter_arrays.py::test_an_array_that_no_dng_holds",
    "cannot be metered": "test_sequences.py::test_a_frame_that_cannot_be_metered",
    "of kernels cannot be written": "test_kernel_cache.py::test_a_store_that_cannot_be_written",
}


def sentences(path):
    """The sentences of a page with one of the words, without code blocks."""
    text = re.sub(r"```.*?```", "", path.read_text("utf-8"), flags=re.DOTALL)
    for part in re.split(r"(?<=[.!?|])\s+|\n\n|\n- |\n\| ", text):
        if WORDS.search(part):
            yield " ".join(part.split())


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_limit_has_a_test_or_is_no_claim(path):
    for sentence in sentences(path):
        assert [part for part in SENTENCES if part in sentence], sentence


def test_no_entry_is_left_over_and_the_tests_exist():
    found = [sentence for path in PAGES for sentence in sentences(path)]
    for part, kind in SENTENCES.items():
        assert any(part in sentence for sentence in found), part
        if "::" in kind:
            file, _, name = kind.partition("::")
            assert f"\ndef {name}" in (ROOT / "tests" / file).read_text("utf-8"), kind


def test_tars_need_no_dask():
    words = ("--webdataset", 2, "--dask", "tcp://127.0.0.1:1")
    assert "--dask" in run_cli("run", STILL_LIFE, "-o", "o", *words, status=2).stderr


STAGES = {
    "tails of the read noise": "tails",
    "row noise": "row_noise",
    "PRNU": "prnu",
    "DSNU": "dsnu",
    "dark current": "dark_current",
    "column noise": "column_noise",
    "black level error": "black_level_error",
    "defect pixels": "defect_pixels",
    "random telegraph noise": "random_telegraph",
    "banding": "banding",
    "crosstalk": "crosstalk",
    "dark shading": "dark_shading",
}


def test_the_table_of_profiles_counts_their_figures():
    cameras = [load_camera(name) for name in built_in_cameras()]
    active: Counter[str] = Counter()
    exposed = {"shutter": {"exposure_time": 1.0}}
    for camera in cameras:
        steps = set()
        for iso in camera.iso_range:
            made = make_chain(settings_from({"camera": camera.name, "iso": iso, **exposed}))
            steps |= {step.name for step in made.steps if step.passes}
            noise = made.step_in(StageRole.SENSOR_NOISE).method
            steps |= {"tails"} if noise.tukey_lambda is not None else set()
        active.update(what for what, stage in STAGES.items() if stage in steps)
    text = (ROOT / "docs" / "limitations.md").read_text("utf-8")
    assert f"the {len(cameras)} built-in profiles" in text
    rows = re.findall(r"^\| ([^|]+) \| (\d+|none)(?: each)? \|$", text, re.MULTILINE)
    counts = {
        what: 0 if count == "none" else int(count)
        for row, count in rows
        for what in STAGES
        if what in row
    }
    assert counts == {what: active[what] for what in counts} and len(counts) == 12


def test_the_size_of_an_image_is_limited():
    text = (ROOT / "docs" / "limitations.md").read_text("utf-8")
    assert f"more than {DEFAULT_MAX_PIXELS // 10**6} megapixels" in text
