"""A push in the browser: watched, gone back to, disturbed, and begun again with another object.

The page is viser's, served by this process alone. The simulation and all that is drawn belong to
the thread of `Page.run`; what a browser asks for waits in a queue until that thread comes by.
"""

from __future__ import annotations

import contextlib
import io
import math
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np

from rps_jax import errors
from rps_jax.analysis import studio
from rps_jax.control import strategies
from rps_jax.errors import InputError
from rps_jax.robot import skin
from rps_jax.robot.skin import NONE
from rps_jax.trials.stepper import CHUNK, Live, Moment
from rps_jax.world import objects
from rps_jax.world.scene import Scene

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from viser import ViserServer

_TICK = 0.04  # [s] between two pictures
_WORDS = 0.25  # [s] between two looks at the panel, which browsers are slow to lay out
_BUDGET = 0.15  # [s] of simulation before the page is looked after again
_PATH_STEP = 10  # moments between two points of a path
_ROOT = "/push"
_SIDES = 48  # facets of what is round
_CAMERA = ((-2.7, -4.6, 3.7), (0.25, 0.1, 0.0))  # [m] where it stands, and what it looks at
_FIELD = 0.75  # [rad] of view, upright
_GROUND, _CELL, _METRE = (226, 226, 223), (198, 198, 196), (158, 158, 156)  # RGB
_SKIN, _PRESSED = np.array([13, 168, 161]), np.array([255, 176, 0])  # RGB, from none to all foam
_TWIST = (228, 88, 20)  # RGB
_TAXEL = (0.022, 0.125, 0.2925)  # [m] depth, height, and height above the ground of its middle
_ARROW = 12.0  # [s] of the commanded velocity that an arrow shows
_ARC = (10.0, 0.56, 0.40)  # [s] of turning that an arc shows, its radius and height [m]
_CONTACTS = ("no contact", "point contact", "line contact")


class Push(NamedTuple):
    """A push that can be shown."""

    live: Live
    scene: Scene
    title: str


class Asked(NamedTuple):
    """A push as the page asks for it."""

    object: str
    friction: str  # as on the command line
    strategy: str
    p_world_target: tuple[float, float]  # [m]


# --- the page ------------------------------------------------------------------------------


class Page:
    """The panel, the clock and what the browser asks for."""

    def __init__(self, server: ViserServer, asked: Asked, make: Callable[[Asked], Push]) -> None:
        """A page without a push.

        Args:
          server: of viser, new.
          asked: what the panel proposes at first.
          make: the push that is asked for; called in a thread of its own, it may raise InputError.
        """
        self._server, self._make = server, make
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closed = threading.Event()
        self._maker = ThreadPoolExecutor(1)
        self._making: Future[Push] | None = None
        self._push: Push | None = None
        self._drawing: _Drawing | None = None
        self._drawn: tuple[int, int] | None = None  # the moment that is on the page, of how many
        self._cursor = 0.0  # the moment that is to be seen; a fraction of the next has passed
        self._playing, self._error = True, ""
        self._words_due = 0.0  # [s] when the panel is next brought up to date
        _furnish(server)
        self._build(asked)

    @property
    def url(self) -> str:
        """Where a browser finds it."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    @property
    def asked(self) -> Asked:
        """What the panel proposes now."""
        x, y = map(float, self._target.value)
        return Asked(self._object.value, self._friction.value, self._strategy.value, (x, y))

    def begin(self, make: Callable[[], Push]) -> None:
        """Have another push made, and show it as soon as it is there."""
        if self._making is None:
            self._error = ""
            self._making = self._maker.submit(_started, make)

    def run(self) -> None:
        """Serve the page until `close` is called."""
        before = time.perf_counter()
        while not self._closed.is_set():
            now = time.perf_counter()
            self.tick(now - before)
            before = now
            self._closed.wait(_TICK - (time.perf_counter() - now))

    def tick(self, elapsed: float) -> None:
        """What is due after another `elapsed` [s]."""
        with contextlib.suppress(queue.Empty):
            while True:
                try:
                    self._todo.get_nowait()()
                except InputError as error:
                    self._error = str(error)
        self._adopt()
        if self._push is not None:
            self._advance(self._push.live, elapsed)
            self._show(self._push)
        if (now := time.perf_counter()) >= self._words_due:
            self._words_due = now + _WORDS
            self._tell()

    def close(self) -> None:
        """End `run`, and the server."""
        self._closed.set()
        self._maker.shutdown(wait=False, cancel_futures=True)
        self._server.stop()

    # --- what happens on its own ---

    def _adopt(self) -> None:
        """Take the push that was made, if it is there."""
        if self._making is None or not self._making.done():
            return
        made, self._making = self._making, None
        try:
            self._push = made.result()
        except InputError as error:
            self._error = str(error)
            return
        self._cursor, self._drawn, self._playing = 0.0, None, True
        with self._server.atomic():
            self._drawing = _Drawing(self._server, self._push.scene)
            self._when(self._drawing.target.on_update, self._drag)

    def _advance(self, live: Live, elapsed: float) -> None:
        """Move the clock on, and the simulation with it, while somebody looks."""
        if not self._playing or not self._server.get_clients():
            return
        self._cursor += elapsed * self._speed.value / live.period
        until = time.perf_counter() + _BUDGET
        while (
            (ahead := int(self._cursor) + 1 - len(live.past)) > 0
            and not live.done
            and time.perf_counter() < until
        ):
            live.step(min(ahead, CHUNK))
        last = len(live.past) - 1
        if int(self._cursor) > last:
            self._cursor = float(last)
            self._playing = not live.done

    def _show(self, push: Push) -> None:
        """Draw the moment that is to be seen, unless it is on the page."""
        past = push.live.past
        index = min(int(self._cursor), len(past) - 1)
        if self._drawing is None:
            return
        with self._server.atomic():
            if self._drawn != (index, len(past)):
                self._drawing.show(past, index)
                self._drawn = index, len(past)
            newest = index == len(past) - 1
            self._drawing.place_target(
                push.live.p_world_target if newest else past[index].worlds.p_world_target[0]
            )

    def _tell(self) -> None:
        """Words and buttons."""
        lines = []
        if self._push is not None and self._push.live.past:
            live = self._push.live
            lines += [f"**{self._push.title}**", self._state(live)]
            self._time.max = max(live.period, (len(live.past) - 1) * live.period)
            self._time.value = int(self._cursor) * live.period
        if self._making is not None:
            lines.append("The push is being prepared; the first of a shape takes some seconds.")
        if self._error:
            lines.append(f"**Not possible:** {self._error}")
        self._status.content = "\n\n".join(lines)
        self._again.disabled = self._making is not None
        self._play.label = "Pause" if self._playing else "Play"

    def _state(self, live: Live) -> str:
        index = min(int(self._cursor), len(live.past) - 1)
        seen = live.past[index].seen
        words = [
            f"{index * live.period:.1f} s",
            f"{float(seen.details.distance):.2f} m to the target",
            _CONTACTS[int(seen.reading.contact_type)],
        ]
        if seen.details.realigning:
            words.append("realigning")
        if live.done and index == len(live.past) - 1:
            words.append(f"**{_ending(live)}**")
        return ", ".join(words)

    # --- what the browser asks for ---

    def _when(self, register: Callable[..., Any], act: Callable[[Any], None]) -> None:
        """Have `run` act on every event of a browser; events that it causes itself are none."""

        def note(event: Any) -> None:
            if event.client_id is not None:
                self._todo.put(partial(act, event))

        register(note)

    def _build(self, asked: Asked) -> None:
        """The panel."""
        gui = self._server.gui
        self._status = gui.add_markdown("")
        with gui.add_folder("Time"):
            self._play = gui.add_button("Pause")
            self._time = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
            self._speed = gui.add_slider("speed", 1.0, 20.0, 1.0, 5.0, hint="times real time")
        with gui.add_folder("Shove the object"):
            self._size = gui.add_slider("by [m]", 0.01, 0.5, 0.01, 0.15)
            self._way = gui.add_slider(
                "towards [deg]", -180.0, 180.0, 5.0, 90.0, hint="0: ahead, 90: left of the robot"
            )
            shove = gui.add_button("Shove")
        with gui.add_folder("Another push"):
            self._object = gui.add_dropdown(
                "object", tuple(objects.OBJECTS), initial_value=asked.object
            )
            self._friction = gui.add_text(
                "friction", asked.friction, hint="S1, S2 or ground,robot (as 0.25,0.4)"
            )
            self._strategy = gui.add_dropdown(
                "strategy", tuple(strategies.PARAMS), initial_value=asked.strategy
            )
            self._target = gui.add_vector2("target [m]", asked.p_world_target, step=0.1)
            self._again = gui.add_button("Push", color=(13, 148, 141))
        self._when(self._play.on_click, self._toggle)
        self._when(self._time.on_update, self._seek)
        self._when(shove.on_click, self._shove)
        self._when(self._again.on_click, self._ask)

    def _toggle(self, event: Any) -> None:
        """Play or pause; at its end a push is played again."""
        del event
        self._playing = not self._playing
        if self._playing and self._push is not None:
            live = self._push.live
            if live.done and int(self._cursor) == len(live.past) - 1:
                self._cursor = 0.0

    def _seek(self, event: Any) -> None:
        """Stop, and look at another moment."""
        if self._push is not None:
            self._playing = False
            self._cursor = round(event.target.value / self._push.live.period)

    def _ask(self, event: Any) -> None:
        del event
        self.begin(partial(self._make, self.asked))

    def _shove(self, event: Any) -> None:
        del event
        by, way = self._size.value, math.radians(self._way.value)
        self._disturb(lambda live: live.shove((by * math.cos(way), by * math.sin(way))))

    def _drag(self, event: Any) -> None:
        x, y, _ = event.target.position
        if self._drawing is not None and event.target is self._drawing.target:
            self._drawing.held = event.phase != "end"
            self._disturb(lambda live: live.set_target((float(x), float(y))))

    def _disturb(self, act: Callable[[Live], None]) -> None:
        """Disturb the push at the moment that is seen; what came after it is forgotten."""
        if self._push is not None:
            self._error = ""
            self._push.live.rewind(int(self._cursor))
            act(self._push.live)
            self._playing = True


def _started(make: Callable[[], Push]) -> Push:
    """A push with its first step done, and so its program compiled."""
    push = make()
    push.live.step()
    return push


def _ending(live: Live) -> str:
    outcome = live.outcome
    if outcome.success:
        return "reached"
    if outcome.tipped:
        return "the object fell over"
    return "the physics ran away" if outcome.diverged else "not reached in time"


def open_page(host: str, port: int, asked: Asked, make: Callable[[Asked], Push]) -> Page:
    """A page, served from now on; see `Page`.

    Args:
      host: address to serve on.
      port: to serve on; 0 takes any that is free.
      asked: as for `Page`.
      make: as for `Page`.

    Raises:
      InputError: viser is not installed, or host and port cannot be served on.
    """
    errors.check_count("port", port, at_least=0, at_most=65535)
    try:
        import viser
    except ImportError as error:
        raise InputError("viser is not installed: run pip install '.[viz]'.") from error
    try:
        with socket.create_server((host, port)):  # viser would quietly take another port
            pass
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (")[0]
        raise InputError(
            f"host = {host}, port = {port} cannot be served on ({reason}): choose another port."
        ) from error
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a panel
        return Page(viser.ViserServer(host, port, verbose=False), asked, make)


def _furnish(server: ViserServer) -> None:
    """What is there without a push: camera, light, ground."""
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
        cell_size=0.5,
        section_size=1.0,
        cell_color=_CELL,
        section_color=_METRE,
        plane_color=_GROUND,
        plane_opacity=1.0,
        shadow_opacity=0.35,
        fade_distance=30.0,
    )


# --- what is drawn -------------------------------------------------------------------------


class _Drawing:
    """One push in the 3-D scene, in place of the one before."""

    def __init__(self, server: ViserServer, scene: Scene) -> None:
        world = server.scene
        world.remove_by_name(_ROOT)
        world.add_frame(_ROOT, show_axes=False)
        self.held = False  # whether a hand holds the target
        self.target = world.add_transform_controls(
            f"{_ROOT}/target",
            scale=0.45,
            active_axes=(True, True, False),
            disable_rotations=True,
            depth_test=False,
            opacity=0.7,
        )
        self._base = world.add_frame(f"{_ROOT}/base", show_axes=False)
        self._object = world.add_frame(f"{_ROOT}/object", show_axes=False)
        for i, (body, colour, vertices, faces) in enumerate(meshes(scene.model)):
            world.add_mesh_simple(
                f"{_ROOT}/{body}/{i}", vertices, faces, color=colour, flat_shading=True
            )
        front = scene.physics.geom("base").size[0]
        self._taxels = _add_taxels(world, f"{_ROOT}/base/taxels", float(front))
        self._contact = world.add_icosphere(
            f"{_ROOT}/base/contact", studio.CONTACT_RADIUS, color=_rgb(studio.CONTACT_RGBA)
        )
        nowhere = np.zeros((1, 2, 3))
        self._velocity = world.add_arrows(
            f"{_ROOT}/base/velocity",
            nowhere,
            _TWIST,
            shaft_radius=0.016,
            head_radius=0.045,
            head_length=0.1,
        )
        line = partial(world.add_line_segments, points=nowhere)
        self._turn = line(f"{_ROOT}/base/turn", colors=_TWIST, thickness=0.022)
        self._paths = {
            name: line(f"{_ROOT}/{name}", colors=_rgb(rgba), thickness=0.025, position=(0, 0, z))
            for name, rgba, z in (
                ("base_path", studio.BASE_RGBA, 0.006),
                ("contact_path", studio.CONTACT_RGBA, 0.012),
            )
        }

    def place_target(self, p_world_target: ArrayLike) -> None:
        """Put the target at (2,) [m], unless a hand holds it."""
        if not self.held:
            x, y = np.asarray(p_world_target, float)
            self.target.position = (x, y, 0.0)

    def show(self, past: Sequence[Moment], index: int) -> None:
        """Draw one moment, and the paths up to there."""
        moment = past[index]
        x, y, yaw = map(float, moment.seen.qpos[:3])
        self._base.position = (x, y, 0.0)
        self._base.wxyz = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        self._object.position, self._object.wxyz = moment.seen.qpos[3:6], moment.seen.qpos[6:10]
        colour = _SKIN + moment.compression[:, None] * (_PRESSED - _SKIN)
        self._taxels.batched_colors = np.round(colour).astype(np.uint8)
        touching = int(moment.seen.reading.contact_type) != NONE
        self._contact.visible = touching
        if touching:
            felt = map(float, moment.seen.reading.p_robot_contact)
            self._contact.position = (*felt, studio.CONTACT_HEIGHT + 0.03)
        self._show_twist(*map(float, moment.seen.twist))
        way = [past[i] for i in (*range(0, index, _PATH_STEP), index)]
        self._paths["base_path"].points = _joined(np.array([m.seen.qpos[:2] for m in way]))
        self._paths["contact_path"].points = _joined(np.array([m.p_world_contact for m in way]))

    def _show_twist(self, v_x: float, v_y: float, omega: float) -> None:
        """An arrow from the middle of the base, and an arc about it from its heading."""
        top = 0.95  # [m] above the arm
        moves, turns = math.hypot(v_x, v_y) > 1e-3, abs(omega) > 1e-3
        self._velocity.visible, self._turn.visible = moves, turns
        if moves:
            tip = [_ARROW * v_x, _ARROW * v_y, top]
            self._velocity.points = np.array([[[0.0, 0.0, top], tip]])
        if turns:
            scale, radius, height = _ARC
            angle = np.linspace(0.0, scale * omega, 24)
            z = np.full_like(angle, height)
            arc = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
            self._turn.points = np.stack([arc[:-1], arc[1:]], axis=1)


def _joined(points: np.ndarray) -> np.ndarray:
    """Lines (m, 2, 3) between neighbours of points (n, 2) [m] on the ground; NaN is a gap."""
    flat = np.column_stack([points, np.zeros(len(points))])
    lines = np.stack([flat[:-1], flat[1:]], axis=1)
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    return lines if len(lines) else np.zeros((1, 2, 3))


def _add_taxels(world: Any, name: str, half_length: float) -> Any:
    """A tile for each taxel, along the rim of the base."""
    middles = np.asarray(skin.taxels(1, half_length))[:, 0]
    depth, height, z = _TAXEL
    faces = skin.faces(half_length).items()
    counts = [skin.BOARDS[side] * skin.ELECTRODES for side, _ in faces]
    along = np.repeat([face.along for _, face in faces], counts, axis=0)
    length = np.repeat([float(face.length) for _, face in faces], counts) / np.repeat(
        counts, counts
    )
    inward = np.stack([along[:, 1], -along[:, 0]], axis=-1)  # the strip runs clockwise
    places = np.column_stack([middles + (depth / 2 - 0.004) * inward, np.full(len(middles), z)])
    sizes = np.abs(along) * 0.92 * length[:, None] + np.abs(inward) * depth
    box = _solid_of(mujoco.mjtGeom.mjGEOM_BOX, np.full(3, 0.5))
    return world.add_batched_meshes_simple(
        name,
        *box,
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(places), 1)),
        batched_positions=places,
        batched_scales=np.column_stack([sizes, np.full(len(places), height)]),
        batched_colors=np.tile(_SKIN, (len(places), 1)).astype(np.uint8),
        flat_shading=True,
        lod="off",
    )


def meshes(
    model: mujoco.MjModel,
) -> Iterator[tuple[str, tuple[int, int, int], np.ndarray, np.ndarray]]:
    """What can be seen of a model's bodies: body, RGB, vertices (V, 3) [m] and faces (F, 3).

    One mesh for each colour of each body, in the body's frame.
    """
    parts: dict[tuple[str, tuple[int, int, int]], list[tuple[np.ndarray, np.ndarray]]] = {}
    for i in range(model.ngeom):
        geom = model.geom(i)
        body = model.body(int(geom.bodyid[0])).name
        if geom.group[0] > 2 or geom.type[0] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue  # MuJoCo hides these groups, and the page has a ground of its own
        vertices, faces = _mesh_of(model, geom)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, geom.quat)
        placed = vertices @ turn.reshape(3, 3).T + geom.pos
        parts.setdefault((body, _colour_of(model, geom)), []).append((placed, faces))
    for (body, colour), some in parts.items():
        starts = np.cumsum([0, *(len(vertices) for vertices, _ in some[:-1])])
        vertices = np.concatenate([vertices for vertices, _ in some])
        faces = np.concatenate([f + n for (_, f), n in zip(some, starts, strict=True)])
        yield body, colour, vertices.astype(np.float32), faces.astype(np.uint32)


def _mesh_of(model: mujoco.MjModel, geom: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3) of a geom, in its frame."""
    if geom.type[0] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(int(geom.dataid[0]))
        first_vertex, first_face = int(mesh.vertadr[0]), int(mesh.faceadr[0])
        vertices = model.mesh_vert[first_vertex : first_vertex + int(mesh.vertnum[0])]
        return vertices, model.mesh_face[first_face : first_face + int(mesh.facenum[0])]
    return _solid_of(geom.type[0], geom.size)


def _solid_of(kind: int, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a primitive of MuJoCo's."""
    from trimesh import creation  # comes with viser

    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        made = creation.box(extents=2 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        made = creation.cylinder(radius=size[0], height=2 * size[1], sections=_SIDES)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        made = creation.capsule(radius=size[0], height=2 * size[1], count=(_SIDES // 2, 12))
    else:  # a sphere, or an ellipsoid
        made = creation.icosphere()
        made.apply_scale(size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[0])
    return np.asarray(made.vertices), np.asarray(made.faces)


def _colour_of(model: mujoco.MjModel, geom: Any) -> tuple[int, int, int]:
    """RGB of a geom: its own or its material's, times what is commonest in its texture."""
    if geom.matid[0] < 0:
        return _rgb(geom.rgba)
    material = model.mat(int(geom.matid[0]))
    colour = np.array(material.rgba[:3])
    texture = int(material.texid[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture >= 0:
        one = model.tex(texture)
        first, size = int(one.adr[0]), int(one.width[0] * one.height[0] * one.nchannel[0])
        pixels = model.tex_data[first : first + size].reshape(-1, int(one.nchannel[0]))
        colour = colour * np.median(pixels[:, :3], axis=0) / 255
    return _rgb(colour)


def _rgb(colour: Any) -> tuple[int, int, int]:
    r, g, b = (round(255 * float(c)) for c in colour[:3])
    return r, g, b
