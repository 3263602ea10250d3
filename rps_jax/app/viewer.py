"""The viewer: a push in the browser, which users can rewind and disturb.

viser serves the page. The thread of `Page.run` builds and simulates pushes and draws them; requests
of browsers wait for it in a queue.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from rps_jax import errors
from rps_jax.app.drawing import Drawing, furnish
from rps_jax.app.gate import HOST, check_guarded, guarding
from rps_jax.control import registry
from rps_jax.control.registry import LawLike
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan, build_batch, load_plan, scene_of, world_title
from rps_jax.runs.push import case_options, end_in_words, program_slots, select_law
from rps_jax.runs.question import Command, call_of, suit_robot
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.live import CHUNK, Live, yaw_target
from rps_jax.trials.progress import ProgressCallback
from rps_jax.trials.setting import Setting
from rps_jax.world import tasks
from rps_jax.world.scene import Scene

if TYPE_CHECKING:
    from viser import ViserServer

_TICK = 0.04  # [s] between two frames
_PANEL_TICK = 0.25  # [s] between two updates of the panel, which browsers are slow to lay out
_MAX_ELAPSED = 0.5  # [s] between two ticks, also if a push was built in the first
_BUDGET = 0.15  # [s] of simulation between two updates of the page
Event: TypeAlias = Any  # of viser, which is optional
_CONTACTS = ("no contact", "point contact", "line contact")


class Push(NamedTuple):
    """A live push with its scene and title."""

    live: Live
    scene: Scene
    title: str


@dataclass(frozen=True)
class View(Command[None], Case):
    """Push in the browser: watch, drag the target, shove the object, rewind."""

    law: LawLike | None = None
    """The law: its name, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow, as rps,K_h=0.3 or rps,tuned.json. With a run, one of its laws, by
    default the first."""
    run: str | Path | None = option(None, positional=True, kw_only=True)
    """Run folder of a sweep, to begin with one of its worlds; by default the options' push."""
    world: int = option(0, 0, positional=True, kw_only=True)
    """Index of the world in the sweep."""
    port: int = option(8080, 0, 65535, kw_only=True)
    """Port to serve the page on; 0 takes any that is free."""
    setting: Setting = field(default=Setting(), kw_only=True)
    out: Path | str | None = option(None, kw_only=True, hidden=True)
    progress: bool | None = option(False, kw_only=True, hidden=True)

    def __post_init__(self) -> None:
        """Set the control period of the robot; defer the checks of `Case` to `check`."""
        suit_robot(self, self.robot)

    @property
    def case(self) -> Case:
        """The options' push; its law is `rps` if the options name a run."""
        law = None if self.run is not None else self.law
        return Case(**dict(case_options(self, self.setting, Case), law=law))

    def note(self) -> str:
        """Whether another engine than the run's is shown."""
        if self.run is None or load_plan(Path(self.run)).setting.simulator.traced:
            return ""
        return "The viewer has no such engine as this run: this is the engine fused."

    def check(self) -> None:
        """Check the push, or the world."""
        self.setting.check_here(self.case.base, [self.case.params])
        self.setting.simulator.check_traced()
        if self.run is not None:
            self.refuse_options([x.name for x in dataclasses.fields(Case) if x.name != "law"])
            self._chosen(self.run)

    def num_trials(self) -> int:
        return 1

    def _chosen(self, run: str | Path) -> tuple[Plan, str]:
        """The plan and the law of a run that is shown."""
        plan, law = select_law(Path(run), self.world, None if self.law is None else str(self.law))
        if not plan.setting.simulator.traced:
            setting = dataclasses.replace(plan.setting, engine="fused")
            plan = dataclasses.replace(plan, setting=setting)
        return plan, law

    def execute(self, callback: ProgressCallback) -> None:
        """Serve the page until it is ended."""
        build = self.push
        if self.run is not None:
            build = partial(_in_world, Path(self.run), *self._chosen(self.run), self.world)
        page = open_page(self.port)
        print(f"page: {page.url} (Ctrl-C ends it)", flush=True)
        try:
            page.start(build)
            page.run()
        except KeyboardInterrupt:
            print("page closed.")
        finally:
            page.close()

    def push(self) -> Push:
        """The options' push."""
        case, law = self.case, self.case.named_law
        label = law if isinstance(law, str) else registry.resolve_law(law)[0]
        scene = pushes.scene_of(case, self.setting)
        live = Live(pushes.build([case], self.setting), self.setting)
        return Push(live, scene, f"{pushes.title_of(case, scene)}, {label}")


view = call_of(View)


def _in_world(run: Path, plan: Plan, law: str, index: int) -> Push:
    """A world of a sweep, with its end there."""
    slots, end = program_slots(run, plan, law, index), ""
    if (run / "results.nc").exists():  # no shard
        end = end_in_words(files.read_results(run).sel(law=law, world=index))
        end = f"; in the sweep {end}"
    live = Live(build_batch(plan, law, [index]), plan.setting, slots)
    return Push(live, scene_of(plan, index), f"{world_title(plan, index)}, {law}{end}")


# --- the page ------------------------------------------------------------------------------


class Page:
    """The panel, the clock and what the browser asks for."""

    def __init__(self, server: ViserServer):
        """Create a page without a push."""
        self._server = server
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closed = threading.Event()
        self._push: Push | None = None
        self._drawing: Drawing  # of the push
        self._drawn = (0, 0)  # index of the moment on the page, and number of moments
        self._cursor = 0.0  # index of the moment to show, with the fraction of the next
        self._playing, self._error = True, ""
        self._panel_due = 0.0  # [s] of the next update of the panel
        furnish(server)
        self._add_controls()

    @property
    def url(self) -> str:
        """URL of the page."""
        return f"http://{HOST}:{self._server.get_port()}"

    def start(self, build: Callable[[], Push]) -> None:
        """Have `run` build a push and show it."""
        self._status.content = (
            "The push is being prepared; the first of a shape takes some seconds."
        )
        self._requests.put(partial(self._show_built, build))

    def run(self) -> None:
        """Serve the page until `close` is called."""
        last = time.perf_counter()
        while not self._closed.wait(last + _TICK - time.perf_counter()):
            time_now = time.perf_counter()
            self.tick(min(time_now - last, _MAX_ELAPSED))
            last = time_now

    def tick(self, elapsed: float) -> None:
        """Handle requests, simulate and draw, after `elapsed` [s] since the last tick."""
        while not self._requests.empty():
            try:
                self._requests.get()()
            except InputError as error:
                self._error = str(error)
        if self._push is not None:
            self._advance(self._push.live, elapsed)
            self._show(self._push.live)
        if (time_now := time.perf_counter()) >= self._panel_due:
            self._panel_due = time_now + _PANEL_TICK
            self._update_panel()

    def close(self) -> None:
        """End `run`, and the server."""
        self._closed.set()
        self._server.stop()

    # --- simulation and drawing ---

    def _show_built(self, build: Callable[[], Push]) -> None:
        """Build a push and step it once, which compiles its program; then show it."""
        push = build()
        push.live.step()
        self._push, self._error = push, ""
        self._cursor, self._drawn, self._playing = 0.0, (0, 0), True
        with self._server.atomic():
            live, has_heading = push.live, push.live.yaw_target is not None
            self._drawing = Drawing(self._server, push.scene, has_heading, live.has_own_end)
            self._drawing.draw_lines(live.lines)
            self._connect(self._drawing.target.on_update, self._drag)

    def _advance(self, live: Live, elapsed: float) -> None:
        """Advance the clock and the simulation while a browser is connected."""
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
        if self._cursor >= len(live.past):
            self._cursor = float(len(live.past) - 1)
            self._playing = not live.done

    def _show(self, live: Live) -> None:
        """Draw the moment at the cursor, unless the page shows it."""
        past, index, last = live.past, int(self._cursor), len(live.past) - 1
        with self._server.atomic():
            if self._drawn != (index, len(past)):
                self._drawing.show(past, index, live.memory_at(index).p_world_object)
                self._drawn = index, len(past)
            worlds = past[index].worlds
            goal = (live.p_world_target, live.yaw_target)
            stored = (worlds.p_world_target[0], yaw_target(worlds))
            self._drawing.place_target(*(goal if index == last else stored))

    def _update_panel(self) -> None:
        """Update the texts and buttons of the panel."""
        lines = []
        if self._push is not None:
            live = self._push.live
            lines += [f"**{self._push.title}**", self._state_text(live)]
            self._time.max = max(live.period, (len(live.past) - 1) * live.period)
            self._time.value = int(self._cursor) * live.period
        if self._error:
            lines.append(f"**Not possible:** {self._error}")
        self._status.content = "\n\n".join(lines)
        self._play.label = "Pause" if self._playing else "Play"

    def _state_text(self, live: Live) -> str:
        index = int(self._cursor)
        moment, trial = live.past[index].snapshot, live.past[index].trial
        task = live.outcome.task if self._is_over(live) else trial.task.outcomes()
        way = f"{float(moment.details.distance):.2f} m to the target"
        if "progress" in task:
            error = float(np.nan_to_num(task["error_mean"]))
            way = f"{float(task['progress']):.0%} of the path, {error:.2f} m off it in the mean"
        contact = _CONTACTS[int(moment.reading.contact_type)]
        words = [f"{index * live.period:.1f} s", way, contact]
        mode = live.memory_at(index).mode or "realigning" * bool(moment.details.realigning)
        words += [mode] * bool(mode)
        if self._is_over(live):
            words.append("**reached**" if live.outcome.success else "**not reached**")
            words += tasks.failures_of(task)
        return ", ".join(words)

    def _is_over(self, live: Live) -> bool:
        """Return whether the page shows the end of a trial."""
        return live.done and int(self._cursor) == len(live.past) - 1

    # --- requests of the browser ---

    def _connect(self, register: Callable[..., Any], act: Callable[[Event], None]) -> None:
        """Have `run` call `act` on each event of a browser, but not on its own events."""

        def note(event: Event) -> None:
            if event.client_id is not None:
                self._requests.put(partial(act, event))

        register(note)

    def _add_controls(self) -> None:
        """Build the panel."""
        gui = self._server.gui
        self._status = gui.add_markdown("")
        with gui.add_folder("Time"):
            self._play = gui.add_button("Pause")
            self._time = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
            self._speed = gui.add_slider("speed", 1.0, 20.0, 1.0, 5.0, hint="times real time")
        with gui.add_folder("Shove the object"):
            self._distance = gui.add_slider("by [m]", 0.01, 0.5, 0.01, 0.15)
            hint = "0: ahead, 90: left of the robot"
            self._direction = gui.add_slider("towards [deg]", -180.0, 180.0, 5.0, 90.0, hint=hint)
            shove = gui.add_button("Shove")
        self._connect(self._play.on_click, self._toggle)
        self._connect(self._time.on_update, self._seek)
        self._connect(shove.on_click, self._shove)

    def _toggle(self, _: Event) -> None:
        """Play or pause; restart a finished push."""
        self._playing = not self._playing
        if self._playing and self._push is not None and self._is_over(self._push.live):
            self._cursor = 0.0

    def _seek(self, event: Event) -> None:
        """Pause at another moment."""
        if self._push is not None:
            self._playing = False
            index = round(event.target.value / self._push.live.period)
            self._cursor = float(min(index, len(self._push.live.past) - 1))

    def _shove(self, _: Event) -> None:
        distance, angle = self._distance.value, math.radians(self._direction.value)
        offset = distance * math.cos(angle), distance * math.sin(angle)
        self._disturb(lambda live: live.shove(offset))

    def _drag(self, event: Event) -> None:
        x, y, _ = event.target.position
        w, *_, z = event.target.wxyz
        if event.target is self._drawing.target:
            self._drawing.held = event.phase != "end"
            yaw = 2 * math.atan2(z, w)
            self._disturb(lambda live: live.set_target((float(x), float(y)), yaw))

    def _disturb(self, act: Callable[[Live], None]) -> None:
        """Disturb the push at the moment at the cursor; later moments are discarded."""
        if self._push is not None:
            self._error = ""
            self._push.live.rewind(int(self._cursor))
            act(self._push.live)
            self._playing = True


def open_page(port: int) -> Page:
    """Serve a page; InputError if viser is missing, or the port cannot be used."""
    viser = errors.require("viser", "viz")
    with contextlib.redirect_stdout(io.StringIO()), guarding():  # it prints a panel
        server = viser.ViserServer(HOST, port, verbose=False)
    try:
        if port not in (0, server.get_port()):  # viser takes another port if this one is used
            raise InputError(f"port = {port} cannot be served on: use another.")
        check_guarded(server.get_port())
    except BaseException:
        server.stop()
        raise
    return Page(server)
