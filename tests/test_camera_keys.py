"""Keys of transforms.json: each is used, must state no lens, or is ignored for a reason."""

import json
import math
import re

import pytest

from clpipe.base.errors import RequestError
from clpipe.inputs.camera_keys import COLMAP, TRANSFORMS, check_keys
from clpipe.inputs.render_cameras import read_views

# Keys that nerfstudio's parser of transforms.json reads, per file and per frame (version 1.1).
NERFSTUDIO = """w h fl_x fl_y cx cy k1 k2 k3 k4 p1 p2 distortion_params camera_model is_fisheye
orientation_override auto_scale_poses_override applied_transform applied_scale ply_file_path
train_filenames val_filenames test_filenames frames file_path transform_matrix mask_path
depth_file_path depth_unit_scale_factor"""
# Keys that instant-ngp's loader reads.
INSTANT_NGP = """camera_angle_x camera_angle_y fl_x fl_y cx cy w h k1 k2 k3 k4 p1 p2 is_fisheye
latlong ftheta_p0 ftheta_p1 ftheta_p2 ftheta_p3 ftheta_p4 aabb_scale aabb scale offset up from_na
n_extra_learnable_dims white_transparent black_transparent enable_ray_loading enable_depth_loading
integer_depth_scale sharpness driver_parameters envmap normal_file_path n_frames"""


@pytest.mark.parametrize("name", [*NERFSTUDIO.split(), *INSTANT_NGP.split()])
def test_each_key_of_a_parser_has_a_disposition(name):
    assert TRANSFORMS.statements[name].meaning


def view_of(tmp_path, **keys):
    common = {"w": 48, "h": 32, "fl_x": 40.0, "cx": 24, "cy": 16, **keys}
    values = {name: value for name, value in common.items() if value is not None}
    frame = {"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**values, "frames": [frame]}))
    [view] = read_views(path)
    return view


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"s1": 0.05}, "s1: found 0.05 .thin prism distortion., but renders have no lens"),
        ({"b2": 0.1}, "b2: found 0.1 .skew of the pixels."),
        ({"k7": 1e-3}, "k7: found 0.001 .radial distortion."),
        ({"skew": 2}, "skew: found 2"),
        ({"is_fisheye": True}, "is_fisheye: found True .fisheye lens."),
        ({"camera_type": "fisheye"}, "camera_type: found 'fisheye', but renders are perspective"),
        ({"distortion": {"k1": 0.3}}, "distortion: found {'k1': 0.3} .distortion coefficients."),
        ({"distortion_params": [0, 0, 0.1]}, "distortion_params: found .0, 0, 0.1."),
        ({"fisheye_radius": 3}, "fisheye_radius: found 3 .an unknown key, which may describe"),
        ({"s7": 0.5}, "s7: found 0.5 .an unknown key"),
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "its camera has the model THIN_PRISM_FISHEYE"),
    ],
)
def test_a_lens_is_rejected_by_the_name_of_its_key(tmp_path, keys, message):

    assert re.match(message, view_of(tmp_path, **keys).problem)


def test_keys_that_state_nothing_or_no_lens_are_accepted(tmp_path):
    nothing = {"k1": 0, "s1": 0.0, "is_fisheye": False, "distortion": {"k1": 0}, "skew": 0}
    other = {"aabb_scale": 16, "applied_scale": 0.5, "maximum": 3, "pixel_count": 7, "note": "x"}
    view = view_of(tmp_path, **nothing, **other, distortion_params=[0.0] * 6)
    assert not view.problem and view.values["fx"] == 40
    check_keys({"camera_type": "perspective"})


def test_both_angles_of_view_are_used(tmp_path):
    across, down = 2 * math.atan(48 / 2 / 40), 2 * math.atan(32 / 2 / 42)
    view = view_of(tmp_path, fl_x=None, camera_angle_x=across, camera_angle_y=down)
    assert (view.values["fx"], view.values["fy"]) == pytest.approx((40, 42))
    same = view_of(tmp_path, camera_angle_x=across, fl_y=42, camera_angle_y=down)
    assert not same.problem
    wrong = view_of(tmp_path, fl_y=40, camera_angle_y=down)
    assert "camera_angle_y means fy = 42 px in a picture of 48x32 px, but fy is 40" in wrong.problem


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "SIMPLE_FISHEYE", "DIVISION", "FOV"])
def test_a_model_of_colmap_is_rejected_by_its_name(tmp_path, model):
    (tmp_path / "cameras.txt").write_text(f"1 {model} 48 32 40 24 16 0.1\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    [view] = read_views(tmp_path)
    assert re.match(
        rf"its camera has the model {model} \(.*\), but renders have no lens", view.problem
    )


def test_a_distortion_of_colmap_has_its_name(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 FULL_OPENCV 48 32 40 40 24 16 0 0 0 0 0 0.02 0 0\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    [view] = read_views(tmp_path)
    assert "has distortion (k4 0.02)" in view.problem


def test_all_models_of_colmap_have_a_disposition():
    # colmap/sensor/models.h, version 4
    models = """SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV OPENCV_FISHEYE FULL_OPENCV FOV
    SIMPLE_RADIAL_FISHEYE RADIAL_FISHEYE THIN_PRISM_FISHEYE RAD_TAN_THIN_PRISM_FISHEYE
    SIMPLE_DIVISION DIVISION SIMPLE_FISHEYE FISHEYE EUCM EQUIRECTANGULAR"""
    assert {*models.split()} == {*COLMAP.statements}


def test_an_unknown_key_of_a_colour_is_named(tmp_path, caplog):
    assert not view_of(tmp_path, color_space="acescg", note="x").problem
    assert "clpipe does not know its color_space, and does not use it" in caplog.text


def test_a_file_without_views_is_rejected(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("{}")
    with pytest.raises(RequestError, match="neither the list 'views'"):
        read_views(path)
