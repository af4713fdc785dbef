"""The keys of a transforms.json, and what becomes of each.

The keys are those of nerfstudio's parser (nerfstudio_dataparser.py, 1.1), of instant-ngp
(nerf_loader.cu), of the NeRF authors' Blender scenes and of Agisoft's camera model. Renders have no
lens distortion, so keys of a lens must state none.
"""

import re
from collections.abc import Mapping
from typing import Any

from clpipe.base.vocabulary import Vocabulary

TRANSFORMS = Vocabulary.of(
    "transforms.json",
    "nerfstudio's parser (1.1), instant-ngp's loader, the NeRF authors' scenes, Agisoft's model",
    {
        "used": {
            "focal length in px": "fl_x fl_y",
            "principal point in px": "cx cy",
            "image size in px": "w h",
            "angle of view in radians": "camera_angle_x camera_angle_y",
            "camera to world, OpenGL axes": "transform_matrix",
            "name of the image": "file_path",
            "model of the camera": "camera_model camera_type",
            "the cameras of all images": "frames",
        },
        "rejected": {
            "radial distortion": "k1 k2 k3 k4 k5 k6 k7",
            "tangential distortion": "p1 p2 p3 p4",
            "thin prism distortion": "s1 s2 s3 s4 sx1 sy1",
            "tilt of the sensor": "tau_x tau_y tauX tauY",
            "skew of the pixels": "b1 b2 skew",
            "distortion coefficients": "distortion_params distortion",
            "fisheye lens": "is_fisheye ftheta_p0 ftheta_p1 ftheta_p2 ftheta_p3 ftheta_p4",
            "latitude-longitude lens": "latlong",
            "shift of the lens": "shift_x shift_y",
        },
        "ignored": {
            "the scene's box, not the camera's": "aabb_scale aabb scale offset up near far",
            "how training uses the images": "train_filenames val_filenames test_filenames "
            "auto_scale_poses_override orientation_override sharpness n_extra_learnable_dims "
            "white_transparent black_transparent from_na enable_depth_loading enable_ray_loading",
            "other files": "ply_file_path depth_file_path mask_path mask_file_path depth_path "
            "hash_path envmap normal_file_path sparse_filename",
            "how poses were transformed, which clpipe's views need not undo": "applied_transform "
            "applied_scale camera_extrinsics n_frames",
            "the unit of depths, which carried layers do not change": "depth_unit_scale_factor "
            "integer_depth_scale",
            "where an image came from": "colmap_im_id camera_id timestamp time rotation fps "
            "driver_parameters light_file",
        },
    },
)
# For COLMAP's models that can describe a pinhole: all parameters, in their order.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
OF_PINHOLE = ("f", "fx", "fy", "cx", "cy")  # the parameters that are not of a lens
COLMAP = Vocabulary.of(
    "COLMAP cameras.txt",
    "colmap/sensor/models.h (4.0)",
    {
        "used": {"a pinhole, with distortion of 0 only": " ".join(COLMAP_MODELS)},
        "rejected": {
            "fisheye": "OPENCV_FISHEYE SIMPLE_RADIAL_FISHEYE RADIAL_FISHEYE SIMPLE_FISHEYE FISHEYE",
            "fisheye with thin prism": "THIN_PRISM_FISHEYE RAD_TAN_THIN_PRISM_FISHEYE",
            "field of view": "FOV",
            "division": "SIMPLE_DIVISION DIVISION",
            "enhanced unified": "EUCM",
            "panorama": "EQUIRECTANGULAR",
        },
    },
)
# Unknown keys with such names may describe a lens.
LENS_LIKE = re.compile(
    r"[bkpst]_?\d{1,2}|xi|alpha|beta|.*(distort|fisheye|skew|tilt|prism|lens|fov|shear|radial"
    r"|tangential|projection|panoram|equirect|anamorph|rolling).*",
    re.IGNORECASE,
)
PERSPECTIVE = ("", "perspective", "pinhole", "simple_pinhole")


def check_keys(values: Mapping[str, Any]) -> None:
    """Check that no key of a transforms.json describes a lens.

    Raises:
        ValueError: one does; the message names it, its value and its meaning.

    >>> check_keys({"k1": 0, "is_fisheye": False, "aabb_scale": 16})
    """
    for name, value in values.items():
        known = TRANSFORMS.statements.get(name)
        if name == "camera_type" and str(value).lower() not in PERSPECTIVE:
            raise ValueError(
                f"camera_type: found {value!r}, but renders are perspective pictures; remove it, "
                "or render a perspective picture"
            )
        if _states_nothing(value):
            continue
        is_lens = known.disposition == "rejected" if known else LENS_LIKE.fullmatch(name)
        if is_lens:
            meaning = known.meaning if known else "an unknown key, which may describe a lens"
            raise ValueError(
                f"{name}: found {value!r} ({meaning}), but renders have no lens distortion; remove "
                "it from the file, and let clpipe warp the picture (see clpipe stages distortion)"
            )


def _states_nothing(value: Any) -> bool:
    """Return whether a value is 0, false or empty, or a list or table of such values."""
    if isinstance(value, Mapping):
        return all(map(_states_nothing, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_states_nothing, value))
    return not value
