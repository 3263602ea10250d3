"""The 3-D scene of a push in the browser: ground, bodies, taxels, paths and twist."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rps_jax.geometry import solid
from rps_jax.robot.shell import Shell
from rps_jax.robot.skin import NONE
from rps_jax.trials.live import Moment
from rps_jax.world import rendering
from rps_jax.world.opengl import mujoco
from rps_jax.world.scene import Scene

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from viser import SceneApi, ViserServer

_PATH_STEP = 10  # moments between two points of a path
_ROOT = "/push"
TARGET = f"{_ROOT}/target"  # the control by which a hand moves the target
_SIDES = 48  # facets of a cylinder
_CAMERA = ((-2.7, -4.6, 3.7), (0.25, 0.1, 0.0))  # [m] its position, and the point that it looks at
_FIELD = 0.75  # [rad] of view, upright
_GROUND = (226, 226, 223)  # RGB
_SKIN, _PRESSED = np.array([13, 168, 161]), np.array([255, 176, 0])  # RGB, from none to all foam
_TWIST = (228, 88, 20)  # RGB
_TAXEL = (0.022, 0.125, 0.2925)  # [m] depth, height, and height above the ground of its middle
_ARROW = 12.0  # [s] of the commanded velocity that an arrow shows
_SHOULDERS = np.array([[0.0, 0.3, 0.45], [0.0, -0.3, 0.45]])  # [m] left and right, beside the arm


def furnish(server: ViserServer) -> None:
    """Add camera, theme and ground."""
    server.gui.configure_theme(
        show_logo=False,
        show_share_button=False,  # it would send the scene to a server on the internet
        brand_color=(8, 84, 80),
    )
    server.gui.main_panel.dock_right()
    server.gui.set_panel_label("Reactive Pushing Strategy")
    server.initial_camera.position, server.initial_camera.look_at = _CAMERA
    server.initial_camera.fov = _FIELD
    server.scene.add_grid(
        "/ground",
        infinite_grid=True,
        plane_color=_GROUND,
        plane_opacity=1.0,
        shadow_opacity=0.35,
        fade_distance=30.0,
    )


# --- the push ------------------------------------------------------------------------------


class Drawing:
    """Bodies, paths and arrows of the current push in the 3-D scene."""

    def __init__(
        self, server: ViserServer, scene: Scene, has_heading: bool = False, fixed: bool = False
    ) -> None:
        """Add the bodies of a scene, in place of the last push.

        An arrow shows the heading of a target that has one. A hand can move and turn the target
        unless it is `fixed`.
        """
        world = self._world = server.scene
        world.remove_by_name(_ROOT)
        world.add_frame(_ROOT, show_axes=False)
        self.held = False  # whether a user drags the target
        self.target = world.add_transform_controls(
            TARGET,
            scale=0.45,
            active_axes=(True, True, False),
            disable_axes=fixed,
            disable_sliders=fixed,
            disable_rotations=fixed or not has_heading,
            depth_test=False,
            opacity=0.7,
        )
        if has_heading:  # the arrow ends at the target
            tail, shape = np.array([[[-0.4, 0, 0.02], [0, 0, 0.02]]]), {"head_length": 0.12}
            colour = _rgb(rendering.PATH_RGBA)
            world.add_arrows(f"{TARGET}/heading", tail, colour, shaft_radius=0.02, **shape)
        self._base = world.add_frame(f"{_ROOT}/base", show_axes=False)
        self._object = world.add_frame(f"{_ROOT}/object", show_axes=False)
        _add_geoms(world, scene.model)
        self._taxels = _add_taxels(world, f"{_ROOT}/base/taxels", scene.shell)
        self._contact = world.add_icosphere(
            f"{_ROOT}/base/contact", rendering.CONTACT_RADIUS, color=_rgb(rendering.CONTACT_RGBA)
        )
        pin = _mesh_of_kind(mujoco.mjtGeom.mjGEOM_CYLINDER, np.array(rendering.PIN))
        self._remembered = world.add_mesh_simple(
            f"{_ROOT}/remembered", *pin, color=_rgb(rendering.PIN_RGBA), visible=False
        )
        nowhere = np.zeros((1, 2, 3))
        shape: dict[str, Any] = {"shaft_radius": 0.016, "head_radius": 0.045, "head_length": 0.1}
        self._velocity = world.add_arrows(f"{_ROOT}/base/velocity", nowhere, _TWIST, **shape)
        path = partial(world.add_line_segments, points=nowhere, thickness=0.025)
        self._base_path = path(f"{_ROOT}/base_path", colors=_rgb(rendering.BASE_RGBA))
        self._contact_path = path(f"{_ROOT}/contact_path", colors=_rgb(rendering.CONTACT_RGBA))

    def draw_lines(self, lines: Mapping[str, np.ndarray]) -> None:
        """Draw the path and the walls of a task: see `Course.lines`."""
        if "path" in lines:
            points = _joined(list(lines["path"]), 0.004)
            colour = _rgb(rendering.PATH_RGBA)
            self._world.add_line_segments(f"{_ROOT}/path", points, colour, thickness=0.02)
        half_thickness, half_height = rendering.WALL_HALF
        for i, (start, end) in enumerate(lines.get("walls", ())):
            x, y = (end - start) / 2
            self._world.add_box(
                f"{_ROOT}/wall_{i}",
                _rgb(rendering.WALL_RGBA),
                (2 * math.hypot(x, y), 2 * half_thickness, 2 * half_height),
                wxyz=solid.quaternion(math.atan2(y, x)),
                position=(*((start + end) / 2), half_height),
            )

    def place_target(self, p_world_target: ArrayLike, yaw: float | None = None) -> None:
        """Put the target at (2,) [m] with a heading [rad], unless a user drags it."""
        if not self.held:
            x, y = np.asarray(p_world_target, float)
            self.target.position = (x, y, 0.0)
            if yaw is not None:
                self.target.wxyz = solid.quaternion(yaw)

    def show(self, past: Sequence[Moment], index: int, remembered: ArrayLike) -> None:
        """Draw one moment with the `remembered` middle (2,) [m] of the object, and the paths."""
        moment = past[index]
        x, y, yaw = map(float, moment.snapshot.qpos[:3])
        self._base.position = (x, y, 0.0)
        self._base.wxyz = solid.quaternion(yaw)
        self._object.position = moment.snapshot.qpos[3:6]
        self._object.wxyz = moment.snapshot.qpos[6:10]
        colour = _SKIN + moment.compression[:, None] * (_PRESSED - _SKIN)
        self._taxels.batched_colors = np.round(colour).astype(np.uint8)
        touching = int(moment.snapshot.reading.contact_type) != NONE
        self._contact.visible = touching
        if touching:
            felt = map(float, moment.snapshot.reading.p_robot_contact)
            self._contact.position = (*felt, rendering.CONTACT_HEIGHT + 0.03)
        x, y = map(float, np.asarray(remembered))
        self._remembered.visible = not math.isnan(x)
        if self._remembered.visible:
            self._remembered.position = (x, y, rendering.PIN[1])
        # Velocities of the left and the right side of the base.
        v_x, v_y, omega = map(float, moment.snapshot.twist)
        velocities = np.array([[v_x - omega * y, v_y + omega * x, 0.0] for x, y, _ in _SHOULDERS])
        self._velocity.points = np.stack([_SHOULDERS, _SHOULDERS + _ARROW * velocities], axis=1)
        self._velocity.visible = bool(np.abs(velocities).max() > 1e-3)
        way = [past[i] for i in (*range(0, index, _PATH_STEP), index)]
        self._base_path.points = _joined([m.snapshot.qpos[:2] for m in way], 0.006)
        self._contact_path.points = _joined([m.p_world_contact for m in way], 0.012)


def _joined(points: Sequence[ArrayLike], height: float) -> np.ndarray:
    """Return lines (m, 2, 3) [m] along points (n, 2) at a height, with gaps at NaN."""
    raised = np.column_stack([np.array(points), np.full(len(points), height)])
    lines = np.stack([raised[:-1], raised[1:]], axis=1)
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    return lines if len(lines) else np.zeros((1, 2, 3))


def _add_taxels(world: SceneApi, name: str, shell: Shell) -> Any:
    """Add a tile for each taxel, along the rim of the base."""
    depth, height, z = _TAXEL
    quarters = np.asarray(shell.taxels(2))  # (T, 2, 2) [m] at 1/4 and 3/4 of each taxel
    along = 2 * (quarters[:, 1] - quarters[:, 0])
    lengths = np.linalg.norm(along, axis=-1)
    inward = np.stack([along[:, 1], -along[:, 0]], axis=-1) / lengths[:, None]  # runs clockwise
    middles = quarters.mean(axis=1) + (depth / 2 - 0.004) * inward
    centers = np.column_stack([middles, np.full(len(middles), z)])
    zero = 0 * lengths
    return world.add_batched_meshes_simple(
        name,
        *_mesh_of_kind(mujoco.mjtGeom.mjGEOM_BOX, np.full(3, 0.5)),
        batched_wxyzs=solid.quaternion(np.arctan2(along[:, 1], along[:, 0])),
        batched_positions=centers,
        batched_scales=np.stack([0.92 * lengths, depth + zero, height + zero], axis=-1),
        batched_colors=np.tile(_SKIN, (len(centers), 1)).astype(np.uint8),
        flat_shading=True,
        lod="off",
    )


def _add_geoms(world: SceneApi, model: mujoco.MjModel) -> None:
    """Add the visible geoms of a model in the frames of their bodies."""
    for i in range(model.ngeom):
        geom = model.geom(i)
        if geom.group[0] > 2 or geom.type[0] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue  # MuJoCo hides these groups, and the page has another ground
        name = f"{_ROOT}/{model.body(int(geom.bodyid[0])).name}/{i}"
        style = {"color": _colour_of(model, geom), "flat_shading": True}
        vertices, faces = _mesh_of(model, geom)
        world.add_mesh_simple(name, vertices, faces, position=geom.pos, wxyz=geom.quat, **style)


def _mesh_of(model: mujoco.MjModel, geom: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and faces (F, 3) of a geom in its frame."""
    if geom.type[0] != mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh_of_kind(geom.type[0], geom.size)
    mesh = model.mesh(int(geom.dataid[0]))
    vertices = slice(mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0])
    faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
    return model.mesh_vert[vertices], model.mesh_face[faces]


def _mesh_of_kind(kind: int, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and faces (F, 3) of a primitive of MuJoCo."""
    from trimesh import creation  # comes with viser

    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        mesh: Any = creation.box(extents=2 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        mesh = creation.cylinder(radius=size[0], height=2 * size[1], sections=_SIDES)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mesh = creation.capsule(radius=size[0], height=2 * size[1], count=(_SIDES // 2, 12))
    else:  # a sphere, or an ellipsoid
        is_ellipsoid = kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID
        mesh = creation.icosphere().apply_scale(size if is_ellipsoid else size[0])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _colour_of(model: mujoco.MjModel, geom: Any) -> tuple[int, int, int]:
    """Return the RGB of a geom or its material, times the median of its texture."""
    if geom.matid[0] < 0:
        return _rgb(geom.rgba)
    material = model.mat(int(geom.matid[0]))
    colour = np.array(material.rgba[:3])
    texture = int(material.texid[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture >= 0:
        image = model.tex(texture)
        first, size = int(image.adr[0]), int(image.width[0] * image.height[0] * image.nchannel[0])
        pixels = model.tex_data[first : first + size].reshape(-1, int(image.nchannel[0]))
        colour = colour * np.median(pixels[:, :3], axis=0) / 255
    return _rgb(colour)


def _rgb(colour: Sequence[float] | np.ndarray) -> tuple[int, int, int]:
    r, g, b = (round(255 * float(c)) for c in colour[:3])
    return r, g, b
