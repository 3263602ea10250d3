"""Figures as a paper needs them: its width, its letters, its units, and nothing cut off."""

import itertools

import numpy as np
import pytest
import xarray as xr
from helpers import results_of
from matplotlib.colors import to_rgb
from matplotlib.text import Text
from numpy.random import default_rng

from rps_jax import RPSParams
from rps_jax.analysis import report
from rps_jax.analysis.figures import style
from rps_jax.analysis.figures import sweeps as sweep_figures
from rps_jax.analysis.figures.paper import min_distance, profile
from rps_jax.analysis.figures.sweeps import success_curves
from rps_jax.control.base import unit_of_leaf
from rps_jax.control.laws.rps import BOUNDS
from rps_jax.runs.question import Run
from rps_jax.studies import attack, ladder, sensitivity
from rps_jax.trials.progress import no_progress
from rps_jax.tuning import learn
from rps_jax.tuning.fit import Fitted
from rps_jax.world.domain import LABELS, Domain, unit_of

RANDOM = default_rng(0)
AXES = ("size", "com_offset", "friction_robot")


def search():
    count, names = 20, list(BOUNDS)
    rows = ("mean", "spread", "best", "base", "validation", "validation_success")
    columns = {name: ("generation", RANDOM.random(count)) for name in rows}
    columns["params"] = (("generation", "parameter"), RANDOM.random((count, len(names))))
    units = [unit_of_leaf(RPSParams(), name) for name in names]
    labels = {"generation": np.arange(count), "parameter": names, "unit": ("parameter", units)}
    return sweep_figures.search(xr.Dataset(columns, labels))


def curve():
    columns = {name: ("update", RANDOM.random(60)) for name in learn.METRICS}
    return learn.figure_of(xr.Dataset(columns, {"update": np.arange(60)}))


def marginals():
    names, dims = list(LABELS), ("draw", "quantity")
    columns = {
        "sample": (dims, RANDOM.random((200, len(names)))),
        "undetermined": ("quantity", np.arange(len(names)) % 2),
        "prior_low": ("quantity", np.full(len(names), 0.1)),
        "prior_high": ("quantity", np.full(len(names), 0.9)),
    }
    labels = {"quantity": names, "unit": ("quantity", list(map(unit_of, names)))}
    return Fitted(xr.Dataset(columns, labels), Domain()).plot()


def rungs():
    senses = {"rps": "touch", "force_push_published": "force", "aps": "pose", "learned": "taxels"}
    results = results_of(list(senses), success=np.tri(4, 100, 60, np.int8))
    return ladder.draw_ladder(results.assign_coords(senses=("law", list(senses.values()))))


def archive():
    margin = RANDOM.uniform(-1, 0.2, (3, 6, 6, 6))
    labels = {name: (name, np.linspace(0, 0.4, 6), {"units": unit_of(name)}) for name in AXES}
    objects = ["random_box", "random_cylinder", "random_prism"]
    data = xr.Dataset({"margin": (("object", *AXES), margin)}, {"object": objects} | labels)
    return attack.archive_figure(data, AXES)


def indices():
    factors, dims = list(LABELS), ("output", "factor")
    shape = len(sensitivity.OUTPUTS), len(factors)
    names = ("first", "first_reach", "total", "total_reach")
    columns = {name: (dims, RANDOM.random(shape)) for name in names}
    columns["success"] = ("world", np.ones(8))
    labels = {"output": list(sensitivity.OUTPUTS), "factor": factors}
    return sensitivity.indices_figure(xr.Dataset(columns, labels))


def interactions():
    names = ["object", *itertools.islice(LABELS, 4)]
    columns = {"u": (("world", "quantity"), RANDOM.random((200, 5)))}
    columns["success"] = ("world", RANDOM.integers(0, 2, 200))
    data = xr.Dataset(columns, {"quantity": names})
    return sensitivity.interactions(data, names, ["box", "cylinder", "prism"])


def fig_5():
    dims, objects = ("law", "object", "friction", "target"), ["box", "cylinder", "nonuniform_box"]
    columns = {name: (dims, np.ones((3, 3, 2, 24))) for name in ("success", "min_distance")}
    at = {"target_x": ("target", np.arange(24) % 5), "target_y": ("target", np.arange(24) // 5)}
    return min_distance(xr.Dataset(columns, {"law": ["rps", "nps", "aps"], "object": objects} | at))


def random_worlds(laws=6):
    columns = {name: RANDOM.permutation(400) * 0.001 for name in LABELS}
    columns["corners"] = np.arange(400) % 7.0 + 2
    columns["corners"][columns["corners"] == 2] = 0  # cylinders
    success = (columns["corners"] > 3) & (columns["mass"] < 0.3) & (columns["yaw"] < 0.35)
    names = [f"rps_tuned,K_h=0.{i}" for i in range(laws)]
    results = results_of(names, success=np.tile(np.int8(success), (laws, 1)), **columns)
    for name in LABELS:
        results[name].attrs["units"] = unit_of(name)
    return results


FIGURES = {
    "tuning": search,
    "curve": curve,
    "marginals": marginals,
    "ladder": rungs,
    "archive": archive,
    "sobol": indices,
    "interactions": interactions,
    "min_distance": fig_5,
    "success": lambda: success_curves(random_worlds()),
    "success of one quantity": lambda: success_curves(random_worlds(1), 1),
    "profile": lambda: profile(RPSParams()),
}


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_fits_a_page_of_a_paper(name, tmp_path):
    """Its letters have 8 points, and no label is cut off or covers another panel's title."""
    figure = FIGURES[name]()
    report.save(figure, tmp_path / "figure.png")  # makes the labels of the ticks
    width, height = figure.get_size_inches()
    assert width <= style.WIDTH
    texts = [x for x in figure.findobj(Text) if x.get_visible() and x.get_text()]
    assert {x.get_fontsize() for x in texts} == {8}
    style.styled(figure.draw_without_rendering)()
    box = figure.get_tightbbox()
    assert min(box.x0, box.y0) >= 0
    assert box.x1 <= width
    assert box.y1 <= height
    titles = [ax.title.get_window_extent() for ax in figure.axes if ax.get_title()]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(titles, 2))


def test_each_tuned_parameter_has_its_unit_in_the_figure():
    titles = [ax.get_title() for ax in search().axes]
    assert {"K_v [1/s]", "l_cr [m]", "gamma_max [rad]", "eta [1]"} <= set(titles)
    assert sum("[" in title for title in titles) == len(BOUNDS)


def test_prior_and_posterior_have_a_legend():
    (legend,) = marginals().legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["90 % of the prior", "posterior"]


def test_no_line_joins_cylinders_to_triangles():
    figure = success_curves(random_worlds(2))
    lines = {ax.get_xlabel(): ax.containers[0].lines[0].get_linestyle() for ax in figure.axes}
    assert lines.pop("corners of the object") == "None"
    assert set(lines.values()) == {"-"}
    (ax,) = (ax for ax in figure.axes if ax.get_xlabel() == "corners of the object")
    assert [label.get_text() for label in ax.get_xticklabels()][:2] == ["round", "3"]


# Of Machado, Oliveira and Fernandes (2009), for complete blindness to red and to green.
BLIND = {
    "protan": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "deutan": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
}


@pytest.mark.parametrize("kind", BLIND)
def test_curves_differ_for_the_colour_blind(kind):
    """By more than those of matplotlib, of which two differ by 0.04 for eyes blind to red."""
    seen = np.array([to_rgb(x) for x in style.COLOURS]) @ np.transpose(BLIND[kind])
    distances = [np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)]
    assert min(distances) > 0.15


def test_learning_without_an_update_has_a_report():
    columns = {name: ("update", np.zeros(0)) for name in learn.METRICS}
    curve = xr.Dataset(columns, {"update": np.zeros(0, int)}, {"compile": 1.0, "run": 2.0})
    (section,) = learn.Learn().report(curve, Run(None, no_progress))
    assert section.picture is None
    assert section._repr_markdown_().endswith("None.")
