"""Statistics, tables, figures and reports, from synthetic results."""

import itertools

import chromium
import numpy as np
import pytest
import xarray as xr
from helpers import refusing, results_of
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy import stats

from rps_jax.analysis import report, statistics, tables
from rps_jax.analysis.figures.paper import one_trial
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.figures.sweeps import success_curves
from rps_jax.analysis.report import Picture, Section
from rps_jax.analysis.statistics import Bins
from rps_jax.runs.question import Run
from rps_jax.studies import hardware
from rps_jax.studies.table import Table
from rps_jax.trials.progress import no_progress
from rps_jax.tuning import learn
from rps_jax.world import paper
from rps_jax.world.domain import LABELS
from sweeps.speed.study import throughput


@pytest.fixture
def drawn(tmp_path):
    """Function that draws a figure, saves it, and returns it."""

    def draw(function, *arguments):
        figure, path = function(*arguments), tmp_path / f"{function.__name__}.png"
        assert report.save(figure, path) == path
        assert path.read_bytes().startswith(b"\x89PNG")
        return figure

    return draw


@pytest.mark.parametrize(("gains", "losses"), [(0.1, 0.1), (0.05, 0.3), (0.01, 0.0), (0.5, 0.2)])
def test_the_interval_of_a_paired_difference_covers(gains, losses):
    """Exactly, over all counts of gains and losses in 40 pairs; the least coverage is 94 %."""
    trials, coverage = 40, 0.0
    for gained in range(trials + 1):
        for lost in range(trials + 1 - gained):
            low, high = statistics.Comparison(gained, lost, 1.0).interval(trials)
            assert -1 <= low <= high <= 1
            if low <= gains - losses <= high:
                rest = trials - gained - lost
                shares = [gains, losses, 1 - gains - losses]
                coverage += stats.multinomial.pmf([gained, lost, rest], trials, shares)
    assert 0.93 < coverage <= 1.0 + 1e-9


def test_statistics_and_tables_of_a_sweep_by_hand():
    results = results_of(
        "ab",
        success=[[1, 0, 0, 0], [1, 1, 0, 0]],
        diverged=[[0, 0, 0, 1], [0, 0, 0, 0]],
        tipped=[[0, 0, 0, 0], [0, 0, 0, 1]],
        time=[[50.0, 300, 200, 9], [70, 80, 300, 300]],
        min_distance=[[0.04, 0.5, np.inf, 1], [0.04, 0.04, 1, 2]],
        contact_lost_time=[[0.0, 0, 0, 0], [0, 0, 151, 0]],
        path_length=[[2.0, 9, 9, 9], [3, 4, 9, 9]],
        distance=[1.0, 2.0, 3.0, 1.0],
    ).assign_coords(object=("world", ["box", "box", "drum", "drum"]), world=range(4))
    first, second = (results.sel(law=law) for law in "ab")
    names = np.array([*statistics.modes(), ""])
    modes = [names[statistics.failure_modes(trials, 150)].tolist() for trials in (first, second)]
    assert modes[0] == ["", "timeout", "never touched", "diverged"]
    assert modes[1] == ["", "", "lost contact", "fell over"]
    assert statistics.distance_left(first).tolist() == [0.04, 0.5, 3.0, 1.0]
    assert statistics.cvar(np.arange(100.0)) == pytest.approx(97.0)  # mean of 95 .. 99
    assert statistics.cvar(np.array([1.0, 3.0])) == 3.0
    assert tables.difference_table(results)[1][1:4] == ["1", "0", "+25.00 % [-27.56, +60.90]"]
    assert statistics.hardest(results).tolist() == [2, 3, 1]
    rates = tables.success_table(results, 150)
    assert rates[2][rates[0].index("median path")] == "3.50 m"  # of b's successes
    assert rates[1][1].startswith("50.0 %")  # of a with the box
    assert rates[2][3].startswith("50.0 %")  # of b in all
    bins = statistics.bins(np.arange(16.0), np.arange(16) < 4, count=4)
    assert bins.successes.tolist() == [4, 0, 0, 0]
    assert bins.trials.tolist() == [4] * 4
    by_value = statistics.bins(np.array([1.0, 1, 2]), np.array([True, False, True]))
    assert by_value.trials.tolist() == [2, 1]


def random_worlds(success, **drawn):
    """Results of laws (laws, worlds) in which only the given quantities differ between worlds."""
    columns = {name: np.zeros(success.shape[1]) for name in LABELS} | drawn
    results = results_of("ab"[: len(success)], success=success.astype(np.int8), **columns)
    for name in LABELS:
        results[name].attrs["units"] = "kg"
    return results


def test_rates_of_more_than_99_percent_have_two_decimals():
    assert tables.share(143, 144) == "99.31 % [96.17, 99.88]"
    assert tables.share(142, 144) == "98.6 % [95.1, 99.6]"
    assert tables.share(99, 100) == "99.0 % [94.6, 99.8]"  # no more than 99 %
    assert tables.share(24, 24) == "100.0 % [86.2, 100.0]"
    assert tables.share(10_000, 10_000) == "100.00 % [99.96, 100.00]"  # enough trials
    assert tables.share(3, 1000) == "0.30 % [0.10, 0.88]"
    assert tables.share(0, 0) == "-"
    assert (tables.percent(0.9937), tables.percent(0.5)) == ("99.37", "50.0")
    assert tables.rate_range([0.988, 0.994, 0.99]) == "98.80 to 99.40 %"
    assert tables.rate_range([0.92, 0.94]) == "92.0 to 94.0 %"


def test_a_validated_law_has_two_decimals_above_99_percent():
    columns = {name: ("update", [0.9937]) for name in learn.METRICS}
    curve = xr.Dataset(columns, {"update": [7]}, {"compile": 1.0, "run": 2.0})
    (section,) = learn.Learn().report(curve, Run(None, no_progress))
    rate = "99.48 % [98.12, 99.86]"  # of whole trials, with its interval
    assert f"its success is {rate}" in section.text
    assert rate in section.table[-1]


def test_the_decisive_quantity_is_listed_first():
    """Heavy objects fail, whatever their friction; no other quantity varies."""
    index = np.arange(400)
    drawn = {"mass": index * 1.0, "friction_ground": index % 7 * 1.0}
    results = random_worlds((index < 350)[None], **drawn)
    mass, friction = statistics.influences(results)
    with refusing("join runs of the same domain, seed and worlds"):
        statistics.influences(results.assign_coords(mass=results.mass * results.success))
    assert mass.name == "mass"
    assert mass.q < 1e-10
    binned = statistics.bins(results.mass.values, results.success.values > 0)
    assert binned.middle[-1] == pytest.approx(374.5)  # the last eighth: 350 to 399
    assert binned.successes.tolist() == [[50] * 7 + [0]]
    constant = results.assign(yaw=("world", np.full(400, 0.1, np.float32), {"units": "rad"}))
    assert np.nanstd(constant.yaw.values) > 0  # by rounding
    assert statistics.varied_quantities(constant) == ["mass", "friction_ground"]
    assert friction.name == "friction_ground"
    assert friction.q > 0.5


def test_chance_alone_has_no_excess_variance_on_average():
    """The mean over all cases of 3 successes in 9 trials, in bins of 2, 3 and 4, is zero."""
    variances = []
    for successes in itertools.combinations(range(9), 3):
        parts = np.split(np.isin(np.arange(9), successes), (2, 5))
        binned = Bins(np.arange(3), np.array([part.sum() for part in parts]), np.array([2, 3, 4]))
        variances.append(statistics.excess_variance(binned))
    assert np.mean(variances) == pytest.approx(0, abs=1e-15)
    # Rates of 1 and 0 have a variance of 1/4, of which 1/28 is noise.
    extremes = Bins(np.arange(2), np.array([4, 0]), np.array([4, 4]))
    assert statistics.excess_variance(extremes) == pytest.approx(1 / 4 - 1 / 28)


def test_the_figure_shows_the_influential_quantities_and_names_the_rest(drawn):
    """Yaw decides for law b and mass for law a; six other quantities have no influence."""
    index, random = np.arange(400), default_rng(0)
    noise = ("size", "height", "gap", "noise", "distance", "lateral")
    columns = {name: random.permutation(400) * 1.0 for name in noise}
    columns |= {"mass": index * 1.0, "yaw": index * 7 % 100 * 1.0}
    results = random_worlds(np.stack([index < 370, columns["yaw"] < 50]), **columns)
    influences = statistics.influences(results)
    assert [x.name for x in influences[:2]] == ["yaw", "mass"]
    assert [x.q < 0.05 for x in influences] == [True] * 2 + [False] * 6
    figure = drawn(success_curves, results)
    titles = [ax.get_title() for ax in figure.axes]
    assert len(titles) == 2
    assert titles[0].startswith("spread 49.6 %, q = ")  # 1/4 (1 - 7/399), as a deviation
    assert not any("chance" in title for title in titles)
    title = figure.legends[0].get_title().get_text()
    assert "2 of 8 drawn quantities" in title
    labels = [ax.get_xlabel() for ax in figure.axes]
    assert labels == ["yaw of the object [kg]", "mass of the object [kg]"]
    text = figure.get_supxlabel().replace("\N{NO-BREAK SPACE}", " ")
    for x in influences:
        assert (LABELS[x.name] in text) == (x in influences[2:])


def test_coinciding_curves_are_all_visible(drawn):
    """Equal rates of two laws have different marks, side by side on the page."""
    success = np.arange(400) < 370
    results = random_worlds(np.stack([success, success]), mass=np.arange(400) * 1.0)
    figure = drawn(success_curves, results)
    marks = [bars.lines[0] for bars in figure.axes[0].containers]
    low, high = figure.axes[0].get_xlim()
    assert low < 30 < 370 < high
    assert len({line.get_marker() for line in marks}) == 2
    first, second = (line.get_transform().transform((100.0, 50.0)) for line in marks)
    assert_allclose((second - first) * 72 / figure.dpi, [2.5, 0], atol=1e-6)


def test_a_path_is_drawn_with_its_target_and_its_last_contact(drawn):
    path, none = np.linspace(0, 1, 6).reshape(3, 2), [np.nan, np.nan]
    contact = [[0.3, 0.1], [0.4, 0.2], none]
    dims = ("object", "target", "path_time", "axis")
    results = xr.Dataset(
        {
            "base_path": (dims, [[path, path]]),
            "contact_path": (dims, [[contact, [none] * 3]]),
            "path_success": (("object", "target"), [[1, 0]]),
            "half": ("axis", [0.4, 0.2]),
        },
        {"object": ["hardware_box"], "target_x": ("target", [2.0] * 2)}
        | {"target_y": ("target", [1.0] * 2)},
    )
    (ax,) = drawn(hardware.paths_figure, results).axes
    assert ax.get_title() == "hardware box: 1 of 2"
    lines = [line.get_xydata().tolist() for line in ax.lines]
    target, line = [[2.0, 1.0]], path.tolist()
    assert lines == [line, target, [[0.4, 0.2]], line, target]


def test_the_papers_numbers_are_beside_ours_under_each_friction(drawn):
    dims, objects = ("law", "object", "friction", "target"), list(paper.HARDWARE_OBJECTS)
    columns = {  # the second box under the second friction fails
        "success": [[[[1, 1], [1, 0]], [[0, 0], [0, 0]]]],
        "mean_abs_l": [[[[0.03, 0.05], [0.02, 9.0]], [[1.0, 1.0], [1.0, 1.0]]]],
        "time": [[[[80.0, 90.0], [70.0, 900.0]], [[1.0, 1.0], [1.0, 1.0]]]],
    }
    results = xr.Dataset({name: (dims, x) for name, x in columns.items()}, {"object": objects})
    d, time = drawn(hardware.numbers_figure, results).axes
    assert_allclose(d.lines[0].get_xdata(), [0.04, 0.02])
    assert_allclose(time.lines[0].get_xdata(), [85, 70])
    assert [list(line.get_xdata()) for line in d.lines[1::2]] == [[0.032], [0.059]]
    _, box, cylinder = hardware.table(results)
    assert box == [
        "hardware box",
        "3 of 4 [30, 95]",
        "8 of 8",
        "0.033 m (by friction 0.020-0.040)",
        "0.032 m",
        "80 s (by friction 70-85)",
        "89 s",
    ]
    _, marked, _ = hardware.table(results, "fitted; ")
    assert marked[3:6:2] == [
        "0.033 m (fitted; by friction 0.020-0.040)",
        "80 s (fitted; by friction 70-85)",
    ]
    assert cylinder[1:] == ["0 of 4 [0, 49]", "8 of 8", "-", "0.059 m", "-", "88 s"]


def test_the_papers_grid_has_counts_of_independent_targets_and_no_interval():
    dims, targets = ("law", "object", "friction", "target"), np.array(paper.TARGETS)
    coords = {"law": ["rps"], "object": ["box"], "friction": ["S1"]}
    coords |= {f"target_{axis}": ("target", x) for axis, x in zip("xy", targets.T, strict=True)}
    results = xr.Dataset({"success": (dims, np.ones((1, 1, 1, 24)))}, coords)
    assert tables.table_ii(results)[1:] == [
        ["RPS", "ours", "24/24", "24/24"],
        ["", "paper", "23/24", "23/24"],
    ]
    assert "14 of 24 are independent" in tables.grid_note(results)
    assert "Intervals" not in Table().intro(results)


def test_fitted_numbers_of_the_hardware_say_so():
    assert hardware.Hardware().fitted
    assert not hardware.Hardware(robot="ideal").fitted


def test_recovered_pushes_are_counted():
    dims = ("object", "shift", "side", "target")
    shoved = xr.Dataset(
        {
            "recovered": (dims, [[[[1, 1], [0, 1]], [[1, 1], [1, 1]]]]),
            "counted": (dims, [[[[1, 1], [1, 1]], [[0, 0], [0, 0]]]]),
        },
        {"object": ["hardware_box"], "shift": [0.1, 0.4]},
    )
    _, *rows = hardware.shift_table(shoved)
    assert rows == [["10 cm", "3 of 4 [30, 95]"], ["40 cm", "0 of 0 [0, 100]"]]


def test_speeds_are_drawn_by_batch(drawn):
    rows = [("box", "fast", 64, 100.0), ("box", "fast", 512, 300.0), ("box", "C", 8, 50.0)]
    (ax,) = drawn(throughput, rows, {"C"}).axes
    fast, level = ax.lines
    assert fast.get_xydata().tolist() == [[64, 100.0], [512, 300.0]]
    assert list(level.get_ydata()) == [50.0, 50.0]


def test_a_report_is_one_self_contained_html_file(tmp_path):
    picture = Picture("dot", lambda: Figure(figsize=(0.1, 0.1)))
    sections = [Section("Numbers", "in *words*", [["a", "b"], ["1", "2"]], picture)]
    path = report.write_report(tmp_path, "A <title>", "intro", sections)
    page = (tmp_path / "report.html").read_text()
    assert "<td>1</td>" in page
    assert 'src="data:image/png;base64,' in page
    assert "dot.png" not in page
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in page
    assert "A &lt;title&gt;" in page
    assert path == tmp_path / "report.md"
    assert "![Numbers](dot.png)" in path.read_text()
    assert (tmp_path / "dot.png").read_bytes() == picture.png()


def test_a_table_without_rows_is_the_word_none():
    section = Section("Correlated quantities", "Above 0.5.", [["first", "second"]])
    assert section._repr_markdown_() == "## Correlated quantities\n\nAbove 0.5.\n\nNone."


def test_a_report_embeds_a_film(tmp_path):
    film = tmp_path / "push.mp4"
    film.write_bytes(b"film")
    report.write_report(tmp_path, "push", "", [Section("Film", film=film)])
    text, page = ((tmp_path / f"report.{kind}").read_text() for kind in ("md", "html"))
    assert '<video src="push.mp4" controls' in text
    assert "[push.mp4](push.mp4)" in text
    assert '<video src="data:video/mp4;base64,ZmlsbQ==" controls' in page


def test_a_report_fits_a_narrow_screen(tmp_path):
    """Wide tables and figures scroll, and long words break."""
    wide = Picture("wide", lambda: Figure(figsize=(11, 6)))
    table = [["quantity"] * 12, ["1234567890"] * 12]
    sections = [Section("a" * 200, "`" + "b" * 200 + "`", table, wide)]
    report.write_report(tmp_path, "wide", "", sections)
    with chromium.opened(tmp_path / "profile", "--headless=new") as browser:
        size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get((tmp_path / "report.html").as_uri())
        width = browser.execute_script("return document.documentElement.scrollWidth")
        shown = "return document.querySelector('img').getBoundingClientRect().width"
        assert width == 390
        assert browser.execute_script(shown) > 500


def test_fig_6_shows_contact_on_the_side_and_covers_nothing_by_a_legend(drawn):
    time = np.arange(5.0)
    ones = np.ones(5)
    path = np.stack([-time, -time], axis=1)
    qpos = np.zeros((5, 10))
    qpos[:, :2], qpos[:, 3:5], qpos[:, 6] = path, path + 0.5, 1
    columns = dict.fromkeys(("v_x", "v_y", "omega", "a_r", "contact_type", "realigning"), ones)
    trace = xr.Dataset(
        {name: ("time", values) for name, values in columns.items()}
        | {"qpos": (("time", "joint"), qpos), "p_world_contact": (("time", "axis"), path)}
        | {"l": ("time", 0.3 * np.sign(time - 2)), "half_length": 0.4, "half_width": 0.3}
        | {"outline": (("corner", "axis"), 0.2 * np.eye(2)), "d_success": 0.05}
        | {"p_world_target": ("axis", [1.0, 1.0]), "outcome_success": 1, "outcome_time": 4.0},
        {"time": time},
    )
    figure = drawn(one_trial, trace, "a push")
    path, _, offset, _, rate = figure.axes
    low, high = offset.get_ylim()
    l = offset.lines[0].get_ydata()  # noqa: E741
    assert low < -0.31 < min(l) < max(l) < 0.31 < high
    (a_r,) = rate.lines
    assert not np.isclose(a_r.get_ydata()[0], rate.get_ylim()).any()
    legends = [ax.get_legend() for ax in figure.axes if ax.get_legend()]
    assert len(legends) == 3
    for legend in legends:
        box = legend.get_window_extent()
        assert not any(box.overlaps(ax.get_window_extent()) for ax in figure.axes)
    names = [text.get_text() for text in path.get_legend().get_texts()]
    assert names == ["base", "contact point", "object", "target"]


# --- bounds --------------------------------------------------------------------------------


def test_the_bound_of_the_best_of_many_holds_where_the_plain_one_fails():
    """The best of twenty candidates, all of which fail in a tenth of the worlds."""
    rng = default_rng(0)
    least = rng.binomial(200, 0.1, (2000, 20)).min(axis=1)
    counts, times = np.unique(least, return_counts=True)

    def covered(best_of):
        holds = [statistics.fails_at_most(int(k), 200, best_of) >= 0.1 for k in counts]
        return np.average(holds, weights=times)

    assert covered(20) >= 0.95
    assert covered(1) < 0.6


def test_the_interval_of_cvar_covers():
    """The CVaR of the tail t of an exponential distribution is 1 - log t."""
    rng = default_rng(0)
    intervals = np.array([statistics.cvar_interval(rng.exponential(size=400)) for _ in range(400)])
    truth = 1 - np.log(0.05)
    assert np.mean((intervals[:, 0] <= truth) & (truth <= intervals[:, 1])) > 0.9
    assert statistics.cvar_interval(np.arange(10.0)) == (0, np.inf)  # one value in the tail
    assert statistics.cvar_interval(np.zeros(100)) == (0, 0)


def test_statistics_equal_those_of_scipy():
    rng = default_rng(0)
    methods = {"wilson": statistics.wilson, "exact": statistics.clopper_pearson}
    for trials, (method, function) in itertools.product((1, 2, 7, 60, 4096), methods.items()):
        for successes in {0, trials, *rng.integers(0, trials + 1, 5).tolist()}:
            for level in ((), (0.9,)):
                interval = stats.binomtest(successes, trials).proportion_ci(*level, method=method)
                ours = function(successes, trials, *level)
                assert_allclose(ours, interval, atol=1e-12)
    for count in (2, 3, 12):
        trials = rng.integers(5, 50, count)
        binned = Bins(np.zeros(count), rng.binomial(trials, 0.8), trials)
        table = np.stack([binned.successes, trials - binned.successes])
        expected = stats.chi2_contingency(table).pvalue
        assert_allclose(statistics.equal_rates_p(binned), expected, rtol=1e-9)
    p = rng.uniform(size=20) ** 3
    expected = stats.false_discovery_control(p)
    assert_allclose(statistics.false_discovery(p), expected, rtol=1e-12)
    assert statistics.false_discovery([]).size == 0
    first = xr.DataArray([True] * 9 + [False] * 3)
    second = xr.DataArray([False] * 7 + [True] * 5)
    assert statistics.compare(first, second).p == pytest.approx(stats.binomtest(3, 10).pvalue)
