"""Any manifest is read or rejected with a RequestError; written manifests can be read."""

import csv
import io
import json
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clpipe.base.errors import RequestError
from clpipe.inputs.manifest import check_rows, read_manifest
from tests.test_manifest import DEFAULT

pytestmark = pytest.mark.slow

# Whatever a manifest holds, what is said of it is a RequestError; what is written is read again.

few = settings(max_examples=200, deadline=None, database=None, derandomize=True)
texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
columns = st.sampled_from(
    ["path", "name", "frames", "iso", "camera", "seed", "sensor_noise.a", "denoise.method", "x", ""]
)
cells = st.one_of(
    texts,
    st.sampled_from(["a.exr", "100", "1e-4", "nan", "-inf", "[[", "{uniform=[0,1]}", "{a=1}"]),
    st.integers().map(str),
)
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(columns | texts, inner, max_size=3),
    max_leaves=6,
)
names = st.text(st.characters(codec="utf-8", exclude_characters="\0/\\"), min_size=1, max_size=8)


def is_read_or_refused(path):
    try:
        rows = read_manifest(path)
        check_rows(rows, DEFAULT)
    except RequestError as error:
        assert re.match(re.escape(str(path)), str(error))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("manifests")


@few
@given(data=st.binary(max_size=60) | texts.map(str.encode))
def test_any_bytes(folder, data):
    for name in ("a.csv", "a.jsonl"):
        (folder / name).write_bytes(data)
        is_read_or_refused(folder / name)


@few
@given(
    table=st.lists(st.lists(cells, min_size=1, max_size=4), max_size=4), header=st.lists(columns)
)
def test_any_csv(folder, table, header):
    text = io.StringIO()
    csv.writer(text).writerows([["path", *header], *table])
    (folder / "b.csv").write_text(text.getvalue(), newline="")
    is_read_or_refused(folder / "b.csv")


@few
@given(rows=st.lists(st.dictionaries(columns | texts, values, max_size=4), max_size=3))
def test_any_jsonl(folder, rows):
    lines = [json.dumps({"path": f"{number}.exr", **row}) for number, row in enumerate(rows)]
    (folder / "b.jsonl").write_text("\n".join(lines))
    is_read_or_refused(folder / "b.jsonl")


@few
@given(
    rows=st.lists(
        st.fixed_dictionaries(
            {"name": names.filter(lambda name: name[0] not in ".~" and name.strip())},
            optional={
                "frames": st.integers(1, 100),
                "iso": st.floats(100, 25600),
                "seed": st.integers(0, 2**63),
                "sensor_noise.a": st.floats(0, 1),
            },
        ),
        min_size=1,
        max_size=4,
        unique_by=lambda row: row["name"],
    )
)
def test_what_is_written_is_read_again(folder, rows):
    header = ["path", "name", "frames", "iso", "seed", "sensor_noise.a"]
    with open(folder / "c.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, header, quoting=csv.QUOTE_ALL)
        writer.writeheader()
        writer.writerows([{"path": "a.exr", **row} for row in rows])
    lines = [json.dumps({"path": "a.exr", **row}) for row in rows]
    (folder / "c.jsonl").write_text("\n".join(lines))
    one, two = (read_manifest(folder / name) for name in ("c.csv", "c.jsonl"))
    for row, from_csv, from_json in zip(rows, one, two, strict=True):
        assert from_csv.name == from_json.name == row["name"]
        assert from_csv.frames == from_json.frames == row.get("frames")
        nested = {key: row[key] for key in ("iso", "seed") if key in row}
        if "sensor_noise.a" in row:
            nested["sensor_noise"] = {"a": row["sensor_noise.a"]}
        assert from_csv.values == from_json.values == nested
    assert check_rows(one, DEFAULT) == check_rows(two, DEFAULT)
