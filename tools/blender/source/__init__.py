"""Puts each render through a camera: Blender's linear picture, developed by clpipe.

OpenCL never runs in Blender's process: handlers write the Render Result as linear EXR, and
``clpipe run`` develops it in another one. While Blender renders in the background of its window,
handlers run in the thread that renders; pictures are loaded by a timer, in the main thread.
"""

import json
import os
import re
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from .development import Development, DevelopmentError, Render, Settings

CHOICES = json.loads(Path(__file__).with_name("choices.json").read_text("utf-8"))
IMAGE = "clpipe"  # the image that shows the latest picture
FOLDER = "clpipe"  # of the pictures, beside the render's own files
LINEAR = "linear"  # of the linear renders, in it
SPACE = "Linear Rec.709"  # what clpipe takes an EXR to be in
EXR = {
    "file_format": "OPEN_EXR",
    "color_mode": "RGB",
    "color_depth": "16",
    "exr_codec": "ZIP",
    "color_management": "OVERRIDE",
}
SECONDS = 0.25  # between two looks at what has been developed

# Attributes in an EXR that differ each time: the date, and the time and memory that it took.
PASSING = re.compile(rb"(?:Date|RenderTime|Memory|cycles\.[^\0]*_time)\0string\0(.{4})", re.DOTALL)

development = Development()


class ClpipeSettings(bpy.types.PropertyGroup):
    """The settings of a scene."""

    enabled: BoolProperty(
        name="Develop Renders",
        description="Put each rendered frame through a camera, and write what it makes of it",
        options=set(),
    )
    camera: StringProperty(
        name="Camera",
        description="A camera by name, or the path of a profile; empty is the camera of the look",
        search=lambda _self, _context, _text: list(CHOICES["cameras"].items()),
        search_options={"SUGGESTION"},
        options=set(),
    )
    look: StringProperty(
        name="Look",
        description="How the raw is developed: a configuration by name, or the path of one",
        default=CHOICES["look"],
        search=lambda _self, _context, _text: CHOICES["looks"],
        search_options={"SUGGESTION"},
        options=set(),
    )
    iso: IntProperty(
        name="ISO",
        description="Noise and denoising follow from it",
        default=CHOICES["iso"],
        min=1,
        options=set(),
    )
    seed: IntProperty(
        name="Seed", description="Of the noise", default=CHOICES["seed"], min=0, options=set()
    )
    keep_raw: BoolProperty(
        name="Keep Raw", description="Write the camera's raw, too, as DNG", options=set()
    )


def settings_of(scene: Any) -> Settings:
    """The settings of a scene, with absolute paths."""
    own = scene.clpipe
    camera, look = (os.fspath(bpy.path.abspath(name)) for name in (own.camera, own.look))
    return Settings(camera, look, own.iso, own.seed, own.keep_raw)


@contextmanager
def changed(thing: Any, values: Mapping[str, Any]) -> Iterator[None]:
    """Let something of Blender's have other values for a while."""
    before = {name: getattr(thing, name) for name in values}
    try:
        for name, value in values.items():
            setattr(thing, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(thing, name, value)


@contextmanager
def linear_exr(scene: Any) -> Iterator[None]:
    """Let a scene write half EXR in linear Rec. 709, whatever it writes else.

    Raises:
        DevelopmentError: a colour configuration of the user's own lacks that space.
    """
    image = scene.render.image_settings
    space = image.linear_colorspace_settings
    own = {"name": space.name} if image.color_management == "OVERRIDE" else {}
    media = {"media_type": "IMAGE"} if hasattr(image, "media_type") else {}  # from Blender 5.0 on
    with changed(image, media | EXR), changed(space, own):
        try:
            space.name = SPACE
        except TypeError:
            message = f"the OpenColorIO configuration has no colour space {SPACE}"
            raise DevelopmentError(message) from None
        yield


def forget_passing(path: Path) -> None:
    """Zero what differs each time in an EXR's header: noise belongs to the bytes of the file."""
    with path.open("r+b") as file:
        head = bytearray(file.read(2**16))
        for found in PASSING.finditer(bytes(head)):
            end = found.end() + int.from_bytes(found[1], "little")
            head[found.end() : end] = re.sub(rb"\d", b"0", head[found.end() : end])
        file.seek(0)
        file.write(head)


def save_linear(scene: Any) -> Render:
    """Write the Render Result of a scene's frame as FOLDER/linear/NAME.exr, and say what it is.

    Raises:
        DevelopmentError: it has several views, or cannot be written.
    """
    if scene.render.use_multiview:
        raise DevelopmentError("a render with several views is not developed; turn Stereoscopy off")
    with linear_exr(scene):
        own = Path(os.path.abspath(scene.render.frame_path(frame=scene.frame_current)))
        folder = own.parent / FOLDER
        path = folder / LINEAR / f"{own.name.removesuffix('.exr')}.exr"
        unfinished = path.with_name(f".{path.name}")  # clpipe may still read the one before
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            bpy.data.images["Render Result"].save_render(str(unfinished), scene=scene)
            forget_passing(unfinished)
            unfinished.replace(path)
        except OSError as error:
            raise DevelopmentError(f"{error.filename}: {error.strerror}") from None
        except RuntimeError as error:  # Blender's own errors
            raise DevelopmentError(str(error).strip().removeprefix("Error: ")) from None
    return Render(path, folder, settings_of(scene))


def show(picture: Path | None) -> None:
    """Load the latest picture, and show it in Image Editors that show the Render Result."""
    if picture is None:
        return
    image = bpy.data.images.get(IMAGE)
    if image is None:
        image = bpy.data.images.load(str(picture))
        image.name = IMAGE
    else:
        image.filepath = str(picture)
        image.reload()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR" and not bpy.app.is_job_running("RENDER"):
                space = area.spaces.active
                if space.image is None or space.image.type == "RENDER_RESULT":
                    space.image = image


@persistent
def begin(_scene: Any, *_: Any) -> None:
    """Before a still or an animation."""
    development.message = ""


@persistent
def take(scene: Any, *_: Any) -> None:
    """After each frame."""
    if not scene.clpipe.enabled:
        return
    try:
        development.add(save_linear(scene))
    except DevelopmentError as error:
        development.fail(str(error))
    if bpy.app.background:
        development.poll()


@persistent
def end(_scene: Any, *_: Any) -> None:
    """After a still or an animation, or what there is of it."""
    if bpy.app.background:  # no timer runs, and Blender may quit now
        show(development.finish())


def look_after() -> float:
    """Show what has been developed; the seconds until the next time."""
    busy = len(development)
    show(development.poll())
    if busy != len(development):
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "PROPERTIES":
                    area.tag_redraw()
    return SECONDS


class RENDER_PT_clpipe(bpy.types.Panel):  # noqa: N801 - Blender's way to name a panel
    """The panel, in the properties of the output."""

    bl_label = "Camera Development"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "output"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - as Blender's own panels

    def draw_header(self, context: Any) -> None:
        self.layout.prop(context.scene.clpipe, "enabled", text="")

    def draw(self, context: Any) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.clpipe
        column = layout.column()
        column.active = settings.enabled
        for name in ("camera", "look", "iso", "seed", "keep_raw"):
            column.prop(settings, name)
        if waiting := len(development):
            layout.label(text=f"{waiting} to develop", icon="SORTTIME")
        if development.message:
            column = layout.column(align=True)
            column.alert = True
            width = context.region.width // 8  # a letter has about as many pixels
            for number, line in enumerate(textwrap.wrap(development.message, max(width, 20))):
                column.label(text=line, icon="BLANK1" if number else "ERROR")


CLASSES = (ClpipeSettings, RENDER_PT_clpipe)
HANDLERS = {
    "render_init": begin,
    "render_post": take,
    "render_complete": end,
    "render_cancel": end,
}


def register() -> None:
    """Called when the extension is enabled."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.clpipe = PointerProperty(type=ClpipeSettings)
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    if not bpy.app.background:
        bpy.app.timers.register(look_after, persistent=True)


def unregister() -> None:
    """Called when it is disabled, and when Blender quits: what waits is developed before."""
    if bpy.app.timers.is_registered(look_after):
        bpy.app.timers.unregister(look_after)
    development.finish()
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    del bpy.types.Scene.clpipe
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
