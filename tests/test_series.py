"""Series: the same images with several cameras and ISOs, each in its own folder."""

import json
import tarfile

import numpy as np
import pytest

NUMPY = ("--device", "numpy", "-c", "paper")
TWO = ("--camera", "sony-a7r2", "--camera", "Canon EOS 5D Mark II", "--iso", "100,1600")


@pytest.fixture
def renders(write_exr):
    for seed, name in enumerate(("a", "b/c")):
        pixels = np.random.default_rng(seed).random((18, 22, 3), np.float32)
        write_exr(f"renders/{name}.exr", pixels)


def test_each_member_is_as_if_it_were_made_alone(clpipe, renders, tmp_path):
    clpipe("run", "renders", "-o", "all", *NUMPY, *TWO)
    made = {p.relative_to(tmp_path / "all").as_posix() for p in tmp_path.glob("all/**/*.jpg")}
    assert made == {
        f"{camera}/iso{iso}/{name}.jpg"
        for camera in ("sony-a7r2", "canon-5d2")
        for iso in (100, 1600)
        for name in ("a", "b/c")
    }
    clpipe("run", "renders", "-o", "one", *NUMPY, "--camera", "canon-5d2", "--iso", 1600)
    for name in ("a.jpg", "b/c.jpg"):
        member = tmp_path / "all/canon-5d2/iso1600" / name
        assert member.read_bytes() == (tmp_path / "one" / name).read_bytes()
    # A second run only makes the pictures of the additional ISO.
    clpipe("run", "renders", "-o", "all", *NUMPY, *TWO[:4], "--iso", "100,1600,400")
    end = json.loads((tmp_path / "all/run.jsonl").read_text().splitlines()[-1])
    assert (end["done"], end["skipped"]) == (4, 8)
    clpipe("replay", "all/canon-5d2/iso400/b/c.json", "-o", "again", *NUMPY[:2])
    again = tmp_path / "again/canon-5d2/iso400/b/c.jpg"
    assert again.read_bytes() == (tmp_path / "all/canon-5d2/iso400/b/c.jpg").read_bytes()


def test_several_of_one_alone_name_no_folder_for_the_other(clpipe, renders, tmp_path):
    clpipe("run", "renders/a.exr", "-o", "isos", *NUMPY, "--iso", "100, 12800")
    assert sorted(p.name for p in tmp_path.glob("isos/*/a.jpg")) == ["a.jpg", "a.jpg"]
    assert (tmp_path / "isos/iso12800/a.json").exists()
    clpipe("run", "renders/a.exr", "-o", "tars", *NUMPY, *TWO, "--webdataset", 3)
    names = []
    for path in sorted(tmp_path.glob("tars/*.tar")):
        with tarfile.open(path) as tar:
            names.append(tar.getnames())
    assert [len(each) for each in names] == [6, 2]
    assert names[1] == ["canon-5d2/iso1600/a.jpg", "canon-5d2/iso1600/a.json"]


def test_a_manifest_that_says_it_too_is_refused(clpipe, renders, tmp_path):
    (tmp_path / "rows.csv").write_text("path,iso\nrenders/a.exr,400\n")
    stderr = clpipe("run", "rows.csv", "-o", "out", *NUMPY, "--iso", "100,200", status=2).stderr
    assert "rows.csv, row 2): this row sets iso, but --iso lists several; remove one" in stderr
