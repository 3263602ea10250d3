"""Images of a MuJoCo scene, with the paths of base and contact up to then.

MuJoCo reads the environment variable MUJOCO_GL when it is imported. `choose_gl` sets it at the
first image, and reloads that part of MuJoCo.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import itertools
import math
import os
import sys
import threading
import warnings
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from rps_jax import errors

if TYPE_CHECKING:
    from mujoco import MjModel, MjvGeom, Renderer
    from numpy.typing import ArrayLike

    from rps_jax.world.scene import Scene

_VIEW = 2.0  # [m] from the middle to where a base is in view; beyond, the camera follows it
Colour = Sequence[float]  # red, green, blue and opacity
_TRAIL_STEP = 0.02  # [m] between the points of a trail
_TRAIL_POINTS = 1500  # at most, so that memory stays flat: 30 m; the oldest go first
_TRAIL_WIDTH = 0.007  # [1] of the image's height
_TRAIL_ROOM = 8  # [px] more than the width of a trail in the largest image
BASE_RGBA = (0.08, 0.09, 0.11, 1.0)
CONTACT_RGBA = (0.62, 0.04, 0.46, 1.0)
PATH_RGBA = (0.05, 0.35, 0.65, 1.0)
WALL_RGBA = (0.45, 0.47, 0.5, 1.0)
WALL_HALF = (0.02, 0.15)  # [m] half thickness and half height of a wall in pictures
CONTACT_HEIGHT = 0.36  # [m] just above the chassis, which would hide the marker from above
CONTACT_RADIUS = 0.04  # [m]
PIN = (0.02, 0.5)  # [m] radius and half height of what marks the remembered object
PIN_RGBA = (0.89, 0.35, 0.08, 1.0)
_CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)))  # of a cube
NO_CONTACT = np.full(2, np.nan)
_OPENING = threading.Lock()
# An image is drawn so many times as fine along either side, and averaged: smoother than the four
# samples of a pixel that OpenGL would take, and without a GPU in less time.
_FINER = 2
_ARROW_HEIGHT = 0.05  # [m] of a goal's arrow above the ground
_SHADOWS_FROM = 480  # [px] height of an image: they take most of the time without a GPU

_FIX_GL = (
    "MuJoCo cannot draw on this machine: install Mesa's EGL library (`apt install libegl1 "
    "libopengl0 libgl1-mesa-dri`) and set MUJOCO_GL=egl, or set MUJOCO_GL=osmesa (`apt install "
    "libosmesa6`)."
)


class VideoError(errors.InputError):
    """Failure to draw or encode: one sentence with its fix."""


class Tile(NamedTuple):
    """A trial in a grid of trials."""

    scene: Scene
    p_world_target: ArrayLike  # (2,) [m]
    lines: Mapping[str, np.ndarray] = MappingProxyType({})  # of its task: see `Course.lines`


class _Trail:
    """A path on the ground in steps of `_TRAIL_STEP`, with gaps at NaN."""

    def __init__(self, rgba: tuple[float, ...], height: float) -> None:
        self.rgba = rgba
        self.height = height  # [m] above the ground, so that one trail lies over another
        self.points: deque[np.ndarray] = deque(maxlen=_TRAIL_POINTS)

    def add(self, point: np.ndarray) -> None:
        """Append a point (2,) [m] unless it is close to the last one."""
        last = self.points[-1] if self.points else NO_CONTACT
        both = np.isnan([point[0], last[0]])
        if not both.all() and (both.any() or math.dist(point, last) >= _TRAIL_STEP):
            self.points.append(point)

    def segments(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield pairs of neighbouring points without a gap between them."""
        for a, b in itertools.pairwise(self.points):
            if not (math.isnan(a[0]) or math.isnan(b[0])):
                yield a, b


class SceneRenderer:
    """A scene and its camera; each image adds to the trails."""

    def __init__(self, renderer: Any, tile: Tile, camera: str, target: np.ndarray) -> None:
        """Create it for a camera of the scene, with the flag at `target` (2,) [m]."""
        scene, self._lines = tile.scene, tile.lines
        self.mujoco = _import_mujoco()
        self.renderer = renderer
        self.model = scene.model
        self.data = self.mujoco.MjData(scene.model)
        self.data.mocap_pos[scene.model.body("target").mocapid[0], :2] = target
        self.camera = camera
        self.base_trail = _Trail(BASE_RGBA, 0.006)
        self.contact_trail = _Trail(CONTACT_RGBA, 0.010)
        self._size = np.array([renderer.width, renderer.height]) // _FINER
        self._image = np.zeros((*self._size[::-1], 3), np.uint8)
        self._eye, self._box = np.zeros(0), np.zeros((2, 2))  # of the last image
        self._moving = np.flatnonzero(scene.model.body_dofnum[scene.model.geom_bodyid])
        middle, half = np.split(scene.model.geom_aabb[self._moving], 2, axis=1)
        self._corners = middle + _CORNERS[:, None] * half  # (8, geoms, 3) [m]

    def draw(
        self, qpos: ArrayLike, p_world_contact: ArrayLike, remembered: ArrayLike = NO_CONTACT
    ) -> np.ndarray:
        """Draw an image (height, width, 3) uint8, and extend the trails.

        A pin marks the object's middle (2,) [m] that the law has `remembered`. While the camera
        stands still, only the rectangle with moving bodies is drawn again.
        """
        qpos = errors.check_array("qpos", qpos, (self.model.nq,))
        contact = np.array(p_world_contact, float)  # a copy: the trail keeps it
        self.data.qpos[:] = qpos
        self.mujoco.mj_kinematics(self.model, self.data)  # poses of the bodies, without dynamics
        self.mujoco.mj_camlight(self.model, self.data)
        self.data.cam_xpos[:, :2] += qpos[:2] - np.clip(qpos[:2], -_VIEW, _VIEW)
        self.renderer.update_scene(self.data, camera=self.camera)
        view = self.renderer.scene
        view.flags[self.mujoco.mjtRndFlag.mjRND_SHADOW] = self._size[1] >= _SHADOWS_FROM
        self.base_trail.add(qpos[:2])
        self.contact_trail.add(contact)
        path = itertools.pairwise(self._lines.get("path", ()))
        self._add_lines(path, PATH_RGBA, 0.004)
        for trail in (self.base_trail, self.contact_trail):
            self._add_lines(trail.segments(), trail.rgba, trail.height)
        for start, end in self._lines.get("walls", ()):
            self._add_wall(start, end)
        if "goal" in self._lines:
            ends = [[*x, _ARROW_HEIGHT] for x in self._lines["goal"]]
            arrow = self._add_geom("mjGEOM_ARROW", np.zeros(3), np.zeros(3), PATH_RGBA)
            self.mujoco.mjv_connector(arrow, arrow.type, 0.05, *map(np.array, ends))
            arrow.size[2] *= 2  # MuJoCo draws half of it
        if not np.isnan(contact).any():
            position, size = np.array([*contact, CONTACT_HEIGHT]), np.full(3, CONTACT_RADIUS)
            marker = self._add_geom("mjGEOM_SPHERE", size, position, CONTACT_RGBA)
            marker.emission = 1.0  # seen in the shadow of the object too
        middle = np.asarray(remembered, float)
        if not np.isnan(middle).any():
            size, position = np.array([*PIN, 0]), np.array([*middle, PIN[1]])
            self._add_geom("mjGEOM_CYLINDER", size, position, PIN_RGBA)
        marks = np.stack([contact, middle])
        self._draw_changes(np.where(np.isnan(marks), qpos[:2], marks))
        return self._image.copy()

    def _draw_changes(self, marks: np.ndarray) -> None:
        """Draw the rectangle of moving bodies and marks (n, 2) [m] in this and the last image.

        If the camera has moved, all of the image is drawn.
        """
        eye = self.mujoco.mjv_averageCamera(*self.renderer.scene.camera)
        pixel = 2 * eye.frustum_top / self._size[1]  # [m] where the field of view begins
        last_eye, self._eye = self._eye, np.concatenate([eye.pos, eye.forward, eye.up])
        still = np.array_equal(last_eye, self._eye)
        boxes = [self._box if still else np.array([[0, 0], self._size])]
        away = self._points(marks) - eye.pos
        depth = 1 if eye.orthographic else away @ eye.forward / eye.frustum_near
        flat = away @ np.transpose([np.cross(eye.forward, eye.up), eye.up])
        flat = self._size / 2 + flat / np.maximum(depth, 1)[..., None] / pixel
        self._box = np.array([flat.min(axis=0) - _TRAIL_ROOM, flat.max(axis=0) + _TRAIL_ROOM])
        boxes.append(self._box)
        low, high = np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]
        (x, y), (end_x, end_y) = np.clip([low, high], 0, self._size).astype(int)
        if x == end_x or y == end_y:
            return
        # A margin, since lines are cut off at the edge.
        first, last = np.clip([[x - 8, y - 8], [end_x + 8, end_y + 8]], 0, self._size)
        x_min, y_min, x_max, y_max = pixel * np.ravel([first, last] - self._size / 2)
        for camera in self.renderer.scene.camera:
            camera.frustum_bottom, camera.frustum_top = y_min, y_max
            camera.frustum_center, camera.frustum_width = (x_min + x_max) / 2, (x_max - x_min) / 2
        part = self.mujoco.MjrRect(0, 0, *(_FINER * (last - first)))
        drawn = np.empty((part.height, part.width, 3), np.uint8)
        self.renderer._gl_context.make_current()
        self.mujoco.mjr_render(part, self.renderer.scene, self.renderer._mjr_context)
        self.mujoco.mjr_readPixels(drawn, None, part, self.renderer._mjr_context)
        drawn = np.asarray(Image.fromarray(drawn).reduce(_FINER))[y - first[1] :, x - first[0] :]
        # OpenGL's rows go up.
        self._image[::-1][y:end_y, x:end_x] = drawn[: end_y - y, : end_x - x]

    def _points(self, marks: np.ndarray) -> np.ndarray:
        """Return points (m, 3) [m] around the moving bodies, the marks and their shadows."""
        data, moving = self.data, self._moving
        rotation = data.geom_xmat[moving].reshape(-1, 3, 3)
        bodies = np.einsum("gij,cgj->cgi", rotation, self._corners) + data.geom_xpos[moving]
        middles = np.pad(marks, ((0, 0), (0, 1)), constant_values=PIN[1])
        around = middles + _CORNERS[:, None] * (CONTACT_RADIUS, CONTACT_RADIUS, PIN[1])
        points = np.concatenate([bodies.reshape(-1, 3), around.reshape(-1, 3)])
        for i, sun in enumerate(data.light_xpos):
            far = self.model.light_type[i] == self.mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
            ray = data.light_xdir[i] if far else points - sun
            points = np.concatenate([points, points - ray * (points[:, 2:] / ray[..., 2:])])
        return points

    def _add_lines(
        self, segments: Iterable[tuple[np.ndarray, np.ndarray]], rgba: Colour, height: float
    ) -> None:
        """Add lines between pairs of points (2,) [m] at a height [m]."""
        width = _TRAIL_WIDTH * self.renderer.height
        for a, b in segments:
            line = self._add_geom("mjGEOM_LINE", np.zeros(3), np.zeros(3), rgba)
            self.mujoco.mjv_connector(line, line.type, width, *([*x, height] for x in (a, b)))

    def _add_wall(self, start: np.ndarray, end: np.ndarray) -> None:
        """Add a wall between two points (2,) [m]."""
        x, y = (end - start) / 2
        if not (length := math.hypot(x, y)):  # after the last part of a drawn path
            return
        size, middle = [length, *WALL_HALF], [*((start + end) / 2), WALL_HALF[1]]
        wall = self._add_geom("mjGEOM_BOX", np.array(size), np.array(middle), WALL_RGBA)
        c, s = x / length, y / length
        wall.mat = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def _add_geom(self, kind: str, size: np.ndarray, position: np.ndarray, rgba: Colour) -> MjvGeom:
        """Add a geom to this image, which has at most 10,000."""
        view = self.renderer.scene
        geom = view.geoms[view.ngeom]
        kind = getattr(self.mujoco.mjtGeom, kind)
        colour = np.array(rgba, np.float32)
        self.mujoco.mjv_initGeom(geom, kind, size, position, np.eye(3).ravel(), colour)
        view.ngeom += 1
        return geom


@contextlib.contextmanager
def open_renderers(
    tiles: Sequence[Tile], size: tuple[int, int], camera: str
) -> Iterator[list[SceneRenderer]]:
    """Yield a renderer for each tile; tiles of one scene share a `mujoco.Renderer`.

    The MuJoCo renderers are closed at the end, since open ones warn when Python exits.
    """
    with contextlib.ExitStack() as stack:
        renderers: dict[int, Renderer] = {}
        scene_renderers = []
        for tile in tiles:
            model = tile.scene.model
            errors.check_name("camera", camera, [model.camera(i).name for i in range(model.ncam)])
            target = errors.check_array("p_world_target", tile.p_world_target, (2,))
            limits = (model.vis.global_.offwidth, model.vis.global_.offheight)
            for n, limit in zip(size, limits, strict=True):
                errors.check_finite("size", n, at_least=2, at_most=limit, unit="px")
            if id(model) not in renderers:
                renderers[id(model)] = stack.enter_context(_renderer(model, size))
            scene_renderers.append(SceneRenderer(renderers[id(model)], tile, camera, target))
        yield scene_renderers


@functools.cache
def choose_gl() -> None:
    """Select EGL on Linux without a display, unless MUJOCO_GL is set or EGL does not work."""
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY"):
        return
    from rps_jax.world import opengl

    try:
        ctypes.CDLL("libEGL.so.1")
        os.environ["MUJOCO_GL"] = "egl"
        importlib.reload(opengl.mujoco.rendering.classic.gl_context)
    except Exception:  # of any kind, by a library that is missing
        os.environ.pop("MUJOCO_GL", None)


def _import_mujoco() -> Any:
    try:
        choose_gl()
        from rps_jax.world import opengl
    except Exception as error:  # of any kind, by a missing GL library
        raise VideoError(_FIX_GL) from error
    if opengl.FAULT:
        raise VideoError(opengl.FAULT)
    return opengl.mujoco


@contextlib.contextmanager
def _renderer(model: MjModel, size: tuple[int, int]) -> Iterator[Renderer]:
    mujoco = _import_mujoco()
    width, height = (_FINER * n for n in size)
    buffer, quality = model.vis.global_, model.vis.quality
    with _OPENING:  # a film and stills of one model may be drawn on two threads
        limits = buffer.offwidth, buffer.offheight, quality.offsamples
        # Else each renderer holds images of the limits, and several samples of a pixel.
        buffer.offwidth, buffer.offheight, quality.offsamples = width, height, 0
        try:
            with warnings.catch_warnings():  # GLFW warns before it fails
                warnings.simplefilter("ignore")
                # Without a context, a renderer ends the process on some machines.
                opened = mujoco.rendering.classic.gl_context.GLContext(width, height)
                if not opened._context:
                    raise VideoError(_FIX_GL)
                renderer = mujoco.Renderer(model, height=height, width=width)
        except Exception as error:  # of any kind, by OpenGL
            raise VideoError(_FIX_GL) from error
        finally:
            buffer.offwidth, buffer.offheight, quality.offsamples = limits
    with contextlib.closing(renderer):
        yield renderer


def check_rendering() -> None:
    """Draw a sphere; raise VideoError if this fails, or the image is black."""
    mujoco = _import_mujoco()
    xml = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    with _renderer(model, (16, 16)) as renderer:
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        renderer.update_scene(data)
        if not renderer.render().any():
            raise VideoError(_FIX_GL)
