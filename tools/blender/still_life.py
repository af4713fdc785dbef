"""Render tests/data/still_life.exr, the linear still life that the tests develop.

The scene is built only from code, with meshes and procedural materials and no outside assets.
Blender's Cycles renders it on the CPU. Values are scene-linear Rec. 709; 1.0 is sensor white at
EV 0. Blender is not a dependency of the project, so install it into a separate Python 3.11 venv.

    pip install bpy==5.0.1
    python tools/blender/still_life.py tests/data/still_life.exr

One unit is ten centimetres; x points right, y into the picture, z up; the table top is z = 0.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Sequence
from math import pi, radians, sin
from pathlib import Path
from typing import Any

SEED = 7
Point = tuple[float, float, float]

# The 24 patches of the classic chart, 8-bit sRGB, row by row from the top left.
CHART_SRGB = """
    115 82 68    194 150 130  98 122 157   87 108 67    133 128 177  103 189 170
    214 126 44   80 91 166    193 90 99    94 60 108    157 188 64   224 163 46
    56 61 150    70 148 73    175 54 60    231 199 31   187 86 149   8 133 161
    243 243 242  200 200 200  160 160 160  122 122 121  85 85 85     52 52 52
"""


class Material:
    """A Principled material, with helpers that build node graphs for patterns."""

    def __init__(self, color: Point, roughness: float = 1.0, **inputs: Any) -> None:
        self.data = bpy.data.materials.new("material")
        self.data.use_nodes = True
        self.tree = self.data.node_tree
        self.bsdf = self.tree.nodes["Principled BSDF"]
        self.bsdf.inputs["Specular IOR Level"].default_value = 0.0 if roughness == 1.0 else 0.5
        inputs |= {"base_color": (*color, 1.0), "roughness": roughness}
        for name, value in inputs.items():
            self.bsdf.inputs[name.replace("_", " ").title()].default_value = value

    def node(self, kind: str, inputs: dict[str | int, Any], **properties: Any) -> Any:
        """Add a node and return its outputs. An input is a value or a socket."""
        node = self.tree.nodes.new("ShaderNode" + kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for socket, value in inputs.items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[socket])
            else:
                node.inputs[socket].default_value = value
        return node.outputs

    def math(self, operation: str, a: Any, b: Any = 0.0, c: Any = 0.0) -> Any:
        return self.node("Math", {0: a, 1: b, 2: c}, operation=operation)[0]

    def mix(self, factor: Any, a: Any, b: Any) -> Any:
        a, b = ((*c, 1.0) if isinstance(c, tuple) else c for c in (a, b))
        return self.node("Mix", {0: factor, 6: a, 7: b}, data_type="RGBA")[2]

    def position(self, scale: Point = (1.0, 1.0, 1.0)) -> Any:
        """Object coordinates, scaled."""
        return self.node("Mapping", {0: self.node("TexCoord", {})["Object"], "Scale": scale})[0]

    def noise(self, vector: Any, detail: float) -> Any:
        return self.node("TexNoise", {"Vector": vector, "Scale": 1.0, "Detail": detail})[0]

    def paint(self, color: Any) -> Material:
        self.tree.links.new(color, self.bsdf.inputs["Base Color"])
        return self


def wood() -> Material:
    """Planks along x: rings, fine pores and dark gaps."""
    m = Material((0.2, 0.1, 0.05), 0.38)
    board = m.math("DIVIDE", m.node("SeparateXYZ", {0: m.position()})[1], 1.35)
    shift = m.node("CombineXYZ", {2: m.math("FLOOR", board)})[0]
    rings = m.noise(m.node("VectorMath", {0: m.position((1.1, 5.0, 5.0)), 1: shift})[0], 8.0)
    rings = m.math("SINE", m.math("MULTIPLY", rings, 60.0))
    pores = m.noise(m.position((3.0, 60.0, 1.0)), 3.0)
    tone = m.math("MULTIPLY_ADD", rings, 0.2, m.math("MULTIPLY", pores, 0.9))
    color = m.mix(tone, (0.13, 0.06, 0.025), (0.42, 0.24, 0.12))
    gap = m.math("LESS_THAN", m.math("FRACT", board), 0.014)
    return m.paint(m.mix(gap, color, (0.01, 0.006, 0.004)))


def woven(pitch: float) -> Material:
    """Plain-weave tartan: warp and weft alternate on top, thread by thread."""
    m = Material((0.5, 0.5, 0.5))
    axes = m.node("SeparateXYZ", {0: m.position((1 / pitch, 1 / pitch, 1.0))})[:2]
    waves = [m.math("SINE", m.math("MULTIPLY", axis, pi)) for axis in axes]
    threads = []
    for axis, wave in zip(axes, waves, strict=True):
        band = m.math("FRACT", m.math("DIVIDE", axis, 26.0))
        color = m.mix(m.math("GREATER_THAN", band, 0.54), (0.72, 0.66, 0.54), (0.05, 0.1, 0.2))
        color = m.mix(m.math("COMPARE", band, 0.27, 0.04), color, (0.5, 0.06, 0.03))
        roundness = m.math("POWER", m.math("ABSOLUTE", wave), 0.7)
        threads.append(m.mix(roundness, (0.02, 0.02, 0.02), color))
    return m.paint(m.mix(m.math("GREATER_THAN", m.math("MULTIPLY", *waves), 0.0), *threads))


def test_card() -> Material:
    """A Siemens star of 48 spokes on the left, lines of falling pitch on the right."""
    m = Material((0.8, 0.8, 0.8))
    x, _, z = m.node("SeparateXYZ", {0: m.position()})
    star_x = m.math("ADD", x, 0.4)
    spokes = m.math("SINE", m.math("MULTIPLY", m.math("ARCTAN2", z, star_x), 48.0))
    radius = m.math("SQRT", m.math("MULTIPLY_ADD", z, z, m.math("POWER", star_x, 2.0)))
    star = m.math("MULTIPLY", m.math("GREATER_THAN", spokes, 0.0), m.math("LESS_THAN", radius, 0.5))
    rise = m.math("ADD", z, 0.5)
    chirp = m.math("SINE", m.math("MULTIPLY", rise, m.math("MULTIPLY_ADD", rise, 130.0, 40.0)))
    inside = m.math("MULTIPLY", m.math("COMPARE", x, 0.5, 0.28), m.math("COMPARE", z, 0.0, 0.48))
    lines = m.math("MULTIPLY", m.math("GREATER_THAN", chirp, 0.0), inside)
    return m.paint(m.mix(m.math("MAXIMUM", star, lines), (0.85, 0.85, 0.85), (0.015, 0.015, 0.015)))


def fruit_skin(color: Point, fleck: Point) -> Material:
    m = Material(color, 0.28)
    streaks = m.noise(m.position((14.0, 14.0, 1.5)), 4.0)
    dots = m.math("LESS_THAN", m.node("TexVoronoi", {0: m.position(), "Scale": 17.0})[0], 0.12)
    blend = m.math("MULTIPLY_ADD", dots, 0.45, m.math("MULTIPLY", streaks, 0.3))
    return m.paint(m.mix(blend, color, fleck))


def paper_edges() -> Material:
    m = Material((0.75, 0.7, 0.58))
    sheets = m.noise(m.position((0.4, 0.4, 55.0)), 1.0)
    steep = m.math("MULTIPLY_ADD", sheets, 4.0, -1.6)
    return m.paint(m.mix(steep, (0.2, 0.16, 0.1), (0.82, 0.77, 0.66)))


def box(
    size: Point, at: Point, material: Material, turn: Point = (0, 0, 0), bevel: float = 0.0
) -> Any:
    """Add a box centred at `at`, rotated by Euler angles in degrees, with bevelled edges."""
    angles = [radians(a) for a in turn]
    bpy.ops.mesh.primitive_cube_add(size=1, location=at, rotation=angles, scale=size)
    thing = bpy.context.object
    bpy.ops.object.transform_apply(location=False, rotation=False)
    thing.data.materials.append(material.data)
    rounding = thing.modifiers.new("bevel", "BEVEL")
    rounding.width, rounding.segments = bevel, 3
    return thing


def lathe(profile: Sequence[tuple[float, float]], at: Point, material: Material) -> Any:
    """Revolve a smoothed profile of (radius, height) about the z axis through `at`."""
    data = bpy.data.meshes.new("lathe")
    edges = [(k, k + 1) for k in range(len(profile) - 1)]
    data.from_pydata([(radius, 0, height) for radius, height in profile], edges, [])
    data.materials.append(material.data)
    thing = bpy.data.objects.new("lathe", data)
    thing.location = at
    screw = thing.modifiers.new("turn", "SCREW")
    screw.steps = screw.render_steps = 32
    screw.use_merge_vertices = screw.use_normal_calculate = True
    smooth = thing.modifiers.new("smooth", "SUBSURF")
    smooth.render_levels = 3
    bpy.context.collection.objects.link(thing)
    return thing


def sphere(radius: float, at: Point, material: Material) -> Any:
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=at, segments=96, ring_count=48)
    bpy.ops.object.shade_smooth()
    bpy.context.object.data.materials.append(material.data)
    return bpy.context.object


def wire(points: Sequence[Point], radius: float, material: Material) -> None:
    data = bpy.data.curves.new("wire", "CURVE")
    data.dimensions, data.bevel_depth = "3D", radius
    spline = data.splines.new("POLY")
    spline.points.add(len(points) - 1)
    for target, source in zip(spline.points, points, strict=True):
        target.co = (*source, 1.0)
    data.materials.append(material.data)
    bpy.context.collection.objects.link(bpy.data.objects.new("wire", data))


def aimed(name: str, data: Any, at: Point, target: Point) -> Any:
    """Place a light or camera at `at`, looking at `target`."""
    thing = bpy.data.objects.new(name, data)
    thing.location = at
    thing.rotation_euler = (Vector(target) - Vector(at)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.collection.objects.link(thing)
    return thing


def add_room() -> None:
    box((60, 0.2, 30), (0, 3.6, 10), Material((0.38, 0.38, 0.38)))
    box((30, 14, 0.5), (0, -3.5, -0.25), wood())
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=120, y_subdivisions=80, size=1)
    cloth = bpy.context.object
    for vertex in cloth.data.vertices:
        x, y = vertex.co.x * 4.4, vertex.co.y * 2.6
        z = 0.05 + 0.022 * sin(2.1 * x + 1.3 * y) + 0.016 * sin(3.7 * y - 1.9 * x)
        vertex.co = (x, y, z)
    bpy.ops.object.shade_smooth()
    cloth.location, cloth.rotation_euler.z = (0.25, -1.75, 0), radians(-9)
    cloth.modifiers.new("thickness", "SOLIDIFY").thickness = 0.03
    cloth.data.materials.append(woven(0.045).data)


def add_chart(at: Point, patch: float) -> None:
    """Add a colour chart, tilted to face the camera."""
    frame = box((6.6 * patch, 0.08, 4.6 * patch), at, Material((0.02, 0.02, 0.02)), (-10, 0, 0))
    values = [int(v) / 255 for v in CHART_SRGB.split()]
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in values]
    for k in range(24):
        where = ((k % 6 - 2.5) * patch, -0.045, (1.5 - k // 6) * patch)
        r, g, b = linear[3 * k : 3 * k + 3]
        box((0.86 * patch, 0.01, 0.86 * patch), where, Material((r, g, b))).parent = frame


def add_niche(at: Point, width: float, depth: float, height: float) -> None:
    """Add an open-fronted case: dark lacquer, a black inside, a brass line around the opening."""
    lacquer = Material((0.03, 0.022, 0.018), 0.25)
    velvet = Material((0.018, 0.018, 0.019))
    x, y, z = at
    box((width, 0.1, height), (x, y + depth / 2, z + height / 2), velvet)
    for side in (-1, 1):
        edge = x + side * (width / 2 - 0.06)
        box((0.12, depth, height), (edge, y, z + height / 2), lacquer, bevel=0.02)
        lining = (edge - side * 0.065, y, z + height / 2)
        box((0.01, depth - 0.1, height - 0.24), lining, velvet)
    for level in (0.06, height - 0.06):
        box((width - 0.24, depth, 0.12), (x, y + 0.03, z + level), lacquer, bevel=0.02)
    left, right, low, high = x - width / 2 + 0.06, x + width / 2 - 0.06, z + 0.06, z + height - 0.06
    corners = [(left, low), (left, high), (right, high), (right, low)]
    brass = Material((0.85, 0.6, 0.25), 0.35, metallic=1.0)
    wire([(across, y - depth / 2, up) for across, up in corners], 0.014, brass)


def add_vase(at: Point) -> None:
    body = [(0, 0), (0.28, 0), (0.36, 0.02), (0.58, 0.4), (0.64, 0.75), (0.42, 1.12)]
    neck = [(0.18, 1.3), (0.17, 1.5), (0.27, 1.68), (0.25, 1.7), (0.13, 1.5), (0.14, 1.2), (0, 1.1)]
    lathe([*body, *neck], at, Material((0.01, 0.035, 0.36), 0.16, coat_weight=0.5))
    rng = random.Random(SEED)
    bark, bud = Material((0.62, 0.5, 0.36)), Material((0.86, 0.85, 0.8))
    for k in range(7):
        bend, length = rng.uniform(-0.3, 0.3), rng.uniform(1.3, 2.1)
        stalk = []
        for t in (n / 24 for n in range(25)):
            x = at[0] + (k - 3) * 0.15 * t * length + bend * t * t + rng.uniform(-0.008, 0.008)
            stalk.append((x, at[1] - 0.15 * t, at[2] + 1.4 + length * t))
        wire(stalk, 0.009 + 0.002 * (k % 3), bark)
        for n in range(9, 25, 3):
            x, y, z = stalk[n]
            offset = 0.05 * (-1) ** n if n < 24 else 0.0
            sphere(0.042, (x + offset, y, z + 0.03), bud).scale.z = 1.5


def add_candle(at: Point) -> None:
    x, y, z = at
    dish = [(0, 0), (0.4, 0), (0.5, 0.02), (0.54, 0.14), (0.47, 0.07), (0.16, 0.07)]
    stem = [(0.08, 0.2), (0.06, 0.4), (0.15, 0.48), (0.06, 0.56), (0.08, 0.7)]
    cup = [(0.21, 0.75), (0.21, 0.84), (0, 0.8)]
    lathe([*dish, *stem, *cup], at, Material((0.78, 0.5, 0.17), 0.17, metallic=1.0))
    wax = [(0, 0.8), (0.14, 0.8), (0.14, 0.9), (0.13, 1.8), (0.12, 1.85), (0.05, 1.8), (0, 1.8)]
    lathe(wax, at, Material((0.85, 0.8, 0.7), 0.45, subsurface_weight=0.3))
    wire([(x, y, z + 1.8), (x + 0.01, y, z + 1.95)], 0.012, Material((0.02, 0.02, 0.02)))
    glow = Material((0, 0, 0), emission_strength=14.0, emission_color=(1.0, 0.6, 0.22, 1.0))
    drop = [(0, 1.88), (0.05, 1.9), (0.075, 2.01), (0.04, 2.14), (0.012, 2.26), (0, 2.3)]
    lathe(drop, at, glow)


def add_fruit(apple_at: Point, pear_at: Point) -> None:
    apple = [(0, 0.08), (0.15, -0.02), (0.38, 0.06), (0.54, 0.4), (0.52, 0.66), (0.38, 0.86)]
    apple += [(0.2, 0.9), (0.07, 0.82), (0, 0.72)]
    pear = [(0, 0.03), (0.2, -0.01), (0.45, 0.12), (0.54, 0.42), (0.44, 0.75), (0.27, 1.02)]
    pear += [(0.21, 1.22), (0.14, 1.38), (0, 1.38)]
    stem = Material((0.08, 0.045, 0.02))
    for profile, (x, y, z), skin, top in (
        (apple, apple_at, fruit_skin((0.5, 0.008, 0.008), (0.8, 0.3, 0.03)), 0.75),
        (pear, pear_at, fruit_skin((0.07, 0.3, 0.015), (0.4, 0.42, 0.06)), 1.34),
    ):
        lathe(profile, (x, y, z), skin)
        wire([(x + 0.3 * t * t, y, z + top + t) for t in (0, 0.1, 0.2, 0.32)], 0.024, stem)


def add_books(at: Point) -> float:
    """Add three books, and return the height of the pile."""
    x, y, z = at
    for color, wide, thick, turn in (
        ((0.02, 0.2, 0.16), 1.75, 0.34, 3),
        ((0.42, 0.05, 0.03), 1.6, 0.26, -5),
        ((0.62, 0.42, 0.05), 1.4, 0.22, 8),
    ):
        for level in (0.02, thick - 0.02):
            box((wide, 1.2, 0.04), (x, y, z + level), Material(color, 0.6), (0, 0, turn), 0.01)
        size = (wide - 0.1, 1.1, thick - 0.08)
        box(size, (x, y, z + thick / 2), paper_edges(), (0, 0, turn))
        z += thick
    return z


def add_lights_and_camera() -> None:
    for name, at, size, power, color in (
        ("key", (-18.5, -16.0, 15.5), 12.2, 9000.0, (1.0, 0.97, 0.93)),
        ("fill", (12.0, -9.0, 5.0), 8.0, 320.0, (0.85, 0.92, 1.0)),
    ):
        lamp = bpy.data.lights.new(name, "AREA")
        lamp.size, lamp.energy, lamp.color = size, power, color
        aimed(name, lamp, at, (0, 1, 1))
    # A flag that shades the upper right of the wall from the key.
    flag = box((0.05, 6.0, 6.0), (-4.8, -3.0, 10.2), Material((0.02, 0.02, 0.02)), (25, 0, 20))
    flag.visible_glossy = False
    world = bpy.data.worlds.new("room")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.05, 0.055, 0.06, 1.0)
    camera = bpy.data.cameras.new("camera")
    camera.lens = 62
    scene = bpy.context.scene
    scene.world, scene.camera = world, aimed("camera", camera, (0, -15, 4.6), (0, 0.5, 1.35))


def build() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    add_room()
    add_chart((-2.65, 2.4, 1.15), 0.48)
    add_niche((1.5, 2.4, 0), 2.4, 1.3, 3.3)
    add_vase((1.55, 0.9, 0))
    add_candle((3.55, 0.4, 0))
    height = add_books((-0.25, 0.9, 0))
    sphere(0.45, (-0.2, 0.9, height + 0.45), Material((0.55, 0.55, 0.55)))
    add_fruit((-0.3, -1.8, 0.08), (0.65, -1.2, 0.08))
    box((1.9, 0.03, 1.2), (-2.72, -2.1, 0.57), test_card(), (-20, 0, 14))
    sphere(0.62, (2.2, -1.2, 0.62), Material((0.85, 0.86, 0.88), 0.06, metallic=1.0))
    add_lights_and_camera()


def render(path: Path, size: tuple[int, int], samples: int) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", samples, SEED
    cycles.use_adaptive_sampling = False
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 3.0
    cycles.filter_width = 1.3
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.use_stamp_date = scene.render.use_stamp_render_time = False
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "16"
    settings.exr_codec = "ZIP"
    scene.render.filepath = str(path.resolve())
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output", type=Path, help="the EXR file to write")
    parser.add_argument("--size", type=int, nargs=2, default=(960, 640), metavar=("W", "H"))
    parser.add_argument("--samples", type=int, default=512)
    options = parser.parse_args()

    import bpy
    from mathutils import Vector

    build()
    render(options.output, options.size, options.samples)
