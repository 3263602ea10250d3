"""Find where gradients grow: the products of the Jacobians of control steps along pushes.

A random change of the poses at the start is propagated by the derivatives of the control steps of
softened trials. Its norm after some time is the growth. Most variants remove one part of the
derivative, such as that of the contact point that the law feels, and do not change the trial. A
part whose removal ends the growth belongs to the loop that causes it. Two variants have other
skins: taxels with wider switches, and an ideal skin, which feels the contact without taxels.

    rps sweeps/gradients/growth.py --quick
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Law, RPSParams, Setting
from rps_jax.analysis.figures.style import Figure, tiles
from rps_jax.control import registry
from rps_jax.geometry import planar
from rps_jax.laws import law_of
from rps_jax.physics import PHYSICS, ControlPeriod, EngineName, get_engine
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.trials import trial
from rps_jax.trials.progress import Progress, set_phase
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World
from rps_jax.trials.worlds import drawn_worlds, soften_skins
from rps_jax.world import draws
from rps_jax.world.physics import Fidelity
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.gradients.study import WARM, label_of
from sweeps.study_base import RANDOM_OBJECTS, QuickStudy, Rows, Table, part_name

# Parts of the derivative, each of which a variant removes.
PARTS = ("contact point", "contact weight", "odometry", "law", "velocities", "tilt")
WHOLE = "whole derivative"
# Variants with another skin, and so with other trials: temperature [1] of the taxels.
SKINS = {f"taxels at {WARM:g}": WARM, "ideal skin": None}
VARIANTS = (WHOLE, *(f"without {part}" for part in PARTS), *SKINS)
# Components of a change of the poses: of the base in the world, of the object in the robot's frame.
COMPONENTS = ("base x, y", "base yaw", "object ahead", "object aside", "object yaw", "object tilt")
_EXPLOSION = 1e3  # [1] growth of a world that counts as exploding
_NEAR = 11  # steps around one for which it is near a switch, or the sharpest is taken
_BURST = 0.01  # [1] share of the steps with the largest growth


class Gains(NamedTuple):
    """Factors 0 or 1 () of the parts of the derivative."""

    point: jax.Array
    weight: jax.Array
    odometry: jax.Array
    law: jax.Array
    velocities: jax.Array
    tilt: jax.Array


@dataclass(frozen=True)
class Growth(QuickStudy[xr.Dataset]):
    """Find where gradients grow: the products of the Jacobians of control steps along pushes.

    The answer has the natural logarithm of the `growth` (object, variant, world, step) of a change
    of the poses since the start, its `components` (object, world, step, component), which are
    shares of its square, whether the smooth law or the skin is within a `switch` (object, world,
    step), and the `sharpness` (object, world, step) [m/m] of the contact that is felt: the
    derivative of its offset by the object's offset aside.
    """

    TITLE = "Growth of derivatives along pushes"
    QUICK: ClassVar = {"worlds": 4, "horizon": 4.0, "engine": "quasistatic"}
    CHOICES: ClassVar = {"objects": RANDOM_OBJECTS}
    GROWS = ("objects",)
    PRESETS: ClassVar = {"physics": PHYSICS["default"], "laws": ("rps",)}

    domain: DomainLike = "wide,gap=0:0"
    """The worlds: a domain's name or a JSON file of ranges; changes follow."""
    objects: tuple[str, ...] = ("random_box", "random_cylinder")
    """Objects to push: random_box, random_cylinder or random_prism."""
    horizon: float = option(8.0, 0.1, 300, unit="s")
    """Simulated time [s]."""
    worlds: int = option(64, 2, 1_000_000)
    """Number of worlds of each object."""
    engine: EngineName = "fused"
    """Engine of all trials; it needs derivatives in forward mode."""
    fidelity: Fidelity = "standard"
    """Fidelity of the physics."""
    seed: int = option(0, 0, 2**30)
    """Seed of the worlds."""

    @property
    def setting(self) -> Setting:
        """Setting of all trials."""
        return Setting(engine=self.engine, fidelity=self.fidelity)

    def attributes(self) -> dict[str, str | int]:
        """Return the attributes of the results, with those of the setting."""
        return super().attributes() | self.setting.attributes

    def check(self) -> None:
        super().check()
        get_engine(self.engine).check_derivatives("forward")

    def num_trials(self) -> int | None:
        """Number of measurements."""
        return len(self.objects) * len(VARIANTS)

    def answer(self, run: Run) -> xr.Dataset:
        """Propagate changes through the pushes that the run folder lacks."""
        by_object, done = [], 0
        for name in self.objects:
            program, variants = functools.cache(partial(_program, self, name)), []
            for variant in VARIANTS:
                set_phase(run.callback, f"{label_of(name)}, {variant}")
                part = part_name(name, variant)
                variants.append(run.checkpoint(part, partial(_propagate, program, variant)))
                done += 1
                run.callback(Progress(done, 0.0))
            growth = [x.growth.rename(None) for x in variants]
            joined = xr.concat(growth, xr.IndexVariable("variant", list(VARIANTS)))
            by_object.append(variants[0].assign(growth=joined))
        results = xr.concat(by_object, xr.IndexVariable("object", list(self.objects)))
        time = self.setting.physics.control_period * (1 + np.arange(results.sizes["step"]))
        return results.assign_coords(time=("step", time, {"units": "s"}))

    def intro(self, results: xr.Dataset) -> str:
        """Return the options in a sentence."""
        return (
            f"Growth of a random change of the poses over {self.horizon:g} s in {self.worlds} "
            f"worlds of each object, by derivatives in the engine {self.engine}."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the growth of the variants, and the steps at which it happens."""
        picture = Picture("growth", partial(figure_of, results))
        return [
            Table(
                variant_table(results),
                merge="object",
                name="gradients_growth",
                title="Growth of a change of the poses",
                picture=picture,
            ),
            Table(
                burst_table(results),
                merge="object",
                name="gradients_bursts",
                title=f"The {100 * _BURST:g} % of the steps with the largest growth",
            ),
        ]


growth = call_of(Growth)


# --- propagation ---------------------------------------------------------------------------


def gate(x: Any, gain: jax.Array) -> Any:
    """Return unchanged arrays, with derivatives scaled by a gain ()."""
    return jax.tree.map(lambda a: gain * a + (1 - gain) * jax.lax.stop_gradient(a), x)


def gated(law: Law, gains: Gains) -> Law:
    """Return a law whose inputs have scaled derivatives."""

    def step(params: Any, state: Any, obs: Any) -> Any:
        obs = obs._replace(
            p_robot_contact=gate(obs.p_robot_contact, gains.point),
            in_contact=gate(obs.in_contact, gains.weight),
            p_world_robot=gate(obs.p_world_robot, gains.odometry),
            yaw=gate(obs.yaw, gains.odometry),
        )
        return law.step(params, state, obs)

    return replace(law, step=step)


def _program(study: Growth, name: str, skin: str = "") -> Any:
    """Return the compiled function of gains that propagates changes in the worlds of an object."""
    alone = replace(parse_domain(study.domain), objects=(name,))
    alone = replace(alone, skin="ideal") if skin == "ideal skin" else alone
    drawn = draws.draw(alone, study.seed, np.arange(study.worlds))
    with jax.enable_x64(True):
        part = drawn_worlds(alone, drawn, study.setting)
        temperature = SKINS.get(skin)
        options = {} if temperature is None else {"taxels": temperature}
        worlds = soften_skins(part.worlds, **options)
        steps = round(study.horizon / study.setting.physics.control_period)
        function = jax.jit(partial(propagate, part.stage, study.setting, steps))
        key = jax.random.key(study.seed)
        return lambda gains: jax.device_get(function(worlds, key, gains))


def _propagate(program: Any, variant: str) -> xr.Dataset:
    """Return growth, components and switches without a part of the derivative."""
    with jax.enable_x64(True):
        gains = (variant != f"without {part}" for part in PARTS)
        run = program(variant) if variant in SKINS else program()
        growth, components, switch, sharpness = run(Gains(*(jnp.asarray(float(x)) for x in gains)))
    return xr.Dataset(
        {
            "growth": (("world", "step"), growth.T),
            "components": (("world", "step", "component"), np.swapaxes(components, 0, 1)),
            "switch": (("world", "step"), switch.T),
            "sharpness": (("world", "step"), sharpness.T, {"units": "1"}),
        },
        {"component": list(COMPONENTS)},
    )


def propagate(
    stage: Any, setting: Setting, steps: int, worlds: World, key: jax.Array, gains: Gains
) -> tuple[jax.Array, ...]:
    """Propagate a random change of the poses through trials of all worlds (n, ...).

    Returns, for each step (T, n, ...): the logarithm of the growth since the start, the shares of
    the components, whether the law or the skin is within a switch, and the sharpness [m/m] of the
    contact: the derivative of the offset that is felt by the object's offset aside.
    """
    smooth = registry.smooth_law(law_of(RPSParams))
    law = gated(smooth, gains)
    loop = ControlLoop(setting.physics, law=law)
    count = worlds.qpos.shape[0]
    params = jax.vmap(lambda _: RPSParams())(jnp.arange(count))
    start = trial.start_all(worlds, params, jnp.ones(count, bool), law=smooth)

    def step(trials: Trial) -> tuple[Trial, Snapshot]:
        """Run `trial.control_step` with gates."""
        qpos = _without_tilt(trials.qpos, gains.tilt)
        qvel, warmstart = gate((trials.qvel, trials.warmstart), gains.velocities)
        current = trials._replace(qpos=qpos, qvel=qvel, warmstart=warmstart)
        decide = jax.vmap(trial.decide, (0, 0, 0, None))
        decided, twists, snapshots = decide(worlds, params, current, loop)
        period = ControlPeriod(gate(twists, gains.law), loop.physics, trial.pushing(worlds))
        driven = stage.drive(worlds.fields, trial.motion(decided), period)
        return jax.vmap(trial.settle)(worlds, current, decided, driven), snapshots

    def sharpness(world: World, trial_: Trial) -> jax.Array:
        """Return the derivative of the offset that is felt by the object's offset aside [m/m]."""

        def offset(qpos: jax.Array) -> jax.Array:
            outline = trial.outline(world, qpos)
            _, reading = world.skin.sense(trial_.skin, outline, loop.physics.control_period)
            return reading.p_robot_contact[1]

        yaw = trial_.qpos[2]
        sideways = jnp.zeros(10).at[3:5].set(jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)]))
        return jnp.abs(jax.jvp(offset, (trial_.qpos,), (sideways,))[1])

    leaves, structure = jax.tree.flatten(start)
    real = [jnp.issubdtype(x.dtype, jnp.floating) for x in leaves]

    def reals(trials: Trial) -> list[jax.Array]:
        return [x for x, is_real in zip(jax.tree.leaves(trials), real, strict=True) if is_real]

    def advance(
        carry: tuple[Trial, list[jax.Array], jax.Array], _: None
    ) -> tuple[Any, tuple[jax.Array, ...]]:
        trials, changes, size = carry

        def moved(values: list[jax.Array]) -> Any:
            rest = iter(values)
            merged = [
                next(rest) if is_real else x
                for x, is_real in zip(jax.tree.leaves(trials), real, strict=True)
            ]
            stepped, snapshots = step(jax.tree.unflatten(structure, merged))
            return (reals(stepped), _poses(stepped.qpos)), (stepped, snapshots)

        (_, _), (changes, poses), (stepped, snapshots) = jax.jvp(
            moved, (reals(trials),), (changes,), has_aux=True
        )
        norm = planar.norm(poses)  # (n,)
        safe = jnp.where((norm > 0) & jnp.isfinite(norm), norm, 1.0)
        changes = [x / safe.reshape(-1, *(1,) * (x.ndim - 1)) for x in changes]
        squares = (poses / safe[:, None]) ** 2  # base x, y, yaw; object ahead, aside, yaw, 3 tilts
        shares = [
            squares[:, :2].sum(1),
            *(squares[:, i] for i in (2, 3, 4, 5)),
            squares[:, 6:].sum(1),
        ]
        kinds = snapshots.reading.contact_type
        weights = jnp.stack([snapshots.reading.in_contact, snapshots.details.realigning])
        within = jnp.any((weights > 0.05) & (weights < 0.95), axis=0)
        growth = size + jnp.log(jnp.where(norm > 0, norm, 1e-300))
        records = growth, jnp.stack(shares, -1), within, kinds, jax.vmap(sharpness)(worlds, trials)
        return (stepped, changes, growth), records

    poses = jax.random.normal(key, (count, 3), float)
    change = [jnp.zeros_like(x) for x in reals(start)]
    index = next(i for i, x in enumerate(jax.tree.leaves(start)) if x is start.qpos)
    position = sum(real[:index])
    change[position] = change[position].at[:, 3:5].set(poses[:, :2])
    change[position] = change[position].at[:, 0].set(poses[:, 2])
    first = jax.jvp(_poses, (start.qpos,), (change[position],))[1]
    norm = planar.norm(first)
    change = [x / norm.reshape(-1, *(1,) * (x.ndim - 1)) for x in change]
    carry = start, change, jnp.zeros(count, float)
    _, (growth, shares, within, kinds, sharp) = jax.lax.scan(advance, carry, length=steps)
    changed = jnp.concatenate([jnp.zeros_like(within[:1]), kinds[1:] != kinds[:-1]])
    return growth, shares, within | changed, sharp


def _poses(qpos: jax.Array) -> jax.Array:
    """Return base x, y [m], yaw [rad], and object ahead, aside [m], yaw and tilt (n, 9)."""

    def pose(q: jax.Array) -> jax.Array:
        p_object, yaw = trial.object_pose(q)
        relative = planar.rotate(-q[2], p_object - q[:2])
        return jnp.concatenate([q[:3], relative, (yaw - q[2])[None], q[5:6], 2 * q[7:9]])

    return jax.vmap(pose)(qpos)


def _without_tilt(qpos: jax.Array, gain: jax.Array) -> jax.Array:
    """Return positions (n, 10) with scaled derivatives of the object's height and tilt."""
    tilt = jnp.array([5, 7, 8])
    return qpos.at[:, tilt].set(gate(qpos[:, tilt], gain))


# --- tables and figure ---------------------------------------------------------------------


def _final(results: xr.Dataset) -> xr.DataArray:
    """Return the decimal logarithm of the growth at the end."""
    return results.growth.isel(step=-1) / np.log(10)


def variant_table(results: xr.Dataset) -> Rows:
    """Return a header and one row per object and variant: the growth over the horizon."""
    rows = [["object", "variant", "median growth", "95 %", "largest", "above 1,000"]]
    for name in map(str, results.object.values):
        for variant in map(str, results.variant.values):
            final = _final(results.sel(object=name, variant=variant))
            quantiles = (10.0**x for x in final.quantile([0.5, 0.95, 1.0]).values)
            count = int((final > np.log10(_EXPLOSION)).sum())
            texts = (f"{x:.1e}" for x in quantiles)
            rows.append([label_of(name), variant, *texts, f"{count} of {final.size}"])
    return rows


def burst_table(results: xr.Dataset) -> Rows:
    """Return a header and one row per object: what happens in the steps of largest growth."""
    head = ["object", "worlds", "share of the growth", "largest step", "near a switch"]
    sharp = "median sharpness [m/m]"
    rows = [[*head, "all steps", sharp, "all steps, 95 %", *COMPONENTS]]
    for name in map(str, results.object.values):
        of_object = results.sel(object=name)
        growth = of_object.growth.sel(variant=WHOLE).values
        gain = np.diff(growth, axis=1)
        explodes = growth[:, -1] > np.log(_EXPLOSION)
        for label, chosen in (("exploding", explodes), ("others", ~explodes)):
            if not chosen.any():
                continue
            bound = np.quantile(gain[chosen], 1 - _BURST)
            burst = (gain >= bound) & chosen[:, None]
            rise = np.maximum(gain[chosen], 0).sum()
            windows = of_object[["switch", "sharpness"]].astype(float)
            near = windows.rolling(step=_NEAR, center=True, min_periods=1).max()
            switch, sharpness = (near[x].values[:, 1:] for x in ("switch", "sharpness"))
            shares = of_object.components.values[:, 1:][burst].mean(axis=0)
            rows.append(
                [
                    label_of(name),
                    f"{int(chosen.sum())} {label}",
                    f"{gain[burst].sum() / rise:.2f}",
                    f"{np.exp(gain[chosen].max()):.0f}",
                    f"{switch[burst].mean():.2f}",
                    f"{switch[chosen].mean():.2f}",
                    f"{np.median(sharpness[burst]):.2f}",
                    f"{np.quantile(sharpness[chosen], 0.95):.2f}",
                    *(f"{x:.2f}" for x in shares),
                ]
            )
    return rows


def figure_of(results: xr.Dataset) -> Figure:
    """Draw the growth against time: quantiles by variant, and the world of largest growth."""
    names = list(map(str, results.object.values))
    figure, axes = tiles(2 * len(names), len(names), (5, 3.2), (0, 0), sharex=True)
    for column, name in enumerate(names):
        of_object, time = results.sel(object=name), results.time.values
        top, bottom = axes[:, column]
        worst = int(_final(of_object.sel(variant=WHOLE)).argmax("world"))
        for variant in map(str, results.variant.values):
            growth = of_object.growth.sel(variant=variant) / np.log(10)
            width = 2.0 if variant == WHOLE else 1.0
            top.plot(time, growth.quantile(0.95, "world"), lw=width, label=variant)
            bottom.plot(time, growth.isel(world=worst), lw=width)
        switch = of_object.switch.isel(world=worst).values
        low = bottom.get_ylim()[0]
        bottom.plot(time[switch], np.full(switch.sum(), low), "k|", ms=6, label="within a switch")
        top.set(title=f"{label_of(name)}: 95 % of the worlds")
        bottom.set(title="the world of largest growth", xlabel="simulated time [s]")
        for ax in (top, bottom):
            ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel("log10 of the growth [1]")
        ax.legend(fontsize=7)
    return figure
