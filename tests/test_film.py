"""Films of several trials in a grid: size, rows, labels, and tiles that stop with their trial."""

import dataclasses
import tracemalloc
from itertools import islice

import numpy as np
import pytest
from helpers import decode, refusal, refusing, rps, setting_of, slow

from rps_jax.app import film
from rps_jax.app.cli import flags
from rps_jax.control import registry
from rps_jax.control.laws.rps import RPSParams
from rps_jax.robot.robot import Robot
from rps_jax.runs.plan import Plan, open_run
from rps_jax.world import video
from rps_jax.world.domain import DOMAINS

pytestmark = pytest.mark.filterwarnings("ignore:os.fork")  # as in test_video

ENGINE = "quasistatic"
FPS = 12


def plan_of(*names):
    """Return a plan of two worlds per object."""
    domain = dataclasses.replace(DOMAINS["wide"], objects=names)
    setting = setting_of(20.0, ENGINE)
    return Plan(domain, 2 * len(names), {"rps": RPSParams.paper()}, setting)


def tiles(images, rows, columns):
    """Return the tiles of images, (count, rows, columns, height, width, 3)."""
    count, height, width, _ = images.shape
    cut = images.reshape(count, rows, height // rows, columns, width // columns, 3)
    return cut.swapaxes(2, 3).astype(int)


def differ(a, b):
    return (np.abs(a - b).max(axis=-1) > 60).sum() > 20


def in_order(takes, name="labels"):
    return film._in_grid_order([getattr(take, name) for take in takes], takes)


def test_a_film_shows_each_trial_in_its_tile_and_holds_the_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(film, "_FILM_SIZE", (320, 180))  # smaller is drawn sooner
    open_run(tmp_path, plan_of("random_cylinder"))
    out = tmp_path / "two.mp4"
    assert rps(f"film {tmp_path} --grid 2x4 --seconds 2 --speed 4.8 --out {out}") == 0
    content = out.read_bytes()
    assert "exists: choose another file" in refusal(capsys, f"film {tmp_path} --out {out}")
    assert out.read_bytes() == content
    assert film.Film(tmp_path, out=out).in_free_place().out == tmp_path / "two-2.mp4"
    assert film.Film(tmp_path, out=out, overwrite=True).in_free_place().out == out
    images = decode(out)
    # 20 control steps of 0.02 s a frame: at 0, 0.4, ... 2 s, and the last for a second more.
    assert images.shape == (6 + FPS, 134, 2 * 240, 3)  # two worlds fill the picture
    cells = tiles(images, 1, 2)
    for column in (0, 1):
        assert cells[0, 0, column].std() > 10
        assert differ(cells[0, 0, column], cells[5, 0, column])
        assert not differ(cells[5, 0, column], cells[-1, 0, column])


def test_a_place_without_a_trial_is_grey(tmp_path):
    (take,) = film.of_sweep(tmp_path, plan_of("random_box"), ["rps"], "first", (1, 1))
    shots = [video.Shot(take.part.worlds.qpos[0], np.zeros(2), "")] * 3
    drawn = [video.Tile(take.scenes[0], (1.0, 1.0))] * 3
    options = {"shape": film.fitted_grid(3, (5, 5)), "size": (160, 90)}
    video.render(drawn, [shots], tmp_path / "x.mp4", **options)
    ((row, (last, empty)),) = tiles(decode(tmp_path / "x.mp4"), 2, 2)
    assert min(cell.std() for cell in (*row, last)) > 10
    assert np.abs(empty - 58).mean() < 1


GRIDS = {
    "": (5, 5),
    **{"--worlds " + " ".join(map(str, range(n))): (12, 12) for n in (1, 4, 9)},
    "--laws one two": (2, 3),
    "--laws one two --worlds 0 1 2 3 4": (2, 12),
    "--laws one": (5, 5),
    "--grid 2x4": (2, 4),
}


@pytest.mark.parametrize("words", GRIDS)
def test_a_film_has_room_for_the_named_worlds(words):
    command, _ = flags.parse(film.Film, "film", [*f"run {words}".split()])
    assert command.shape == GRIDS[words]


@pytest.mark.parametrize(
    ("count", "room", "grid"),
    [
        *((n * n, (12, 12), (n, n)) for n in (1, 2, 3, 4, 5, 12)),
        (2, (5, 5), (1, 2)),
        (3, (5, 5), (2, 2)),
        (5, (5, 5), (2, 3)),
        (7, (5, 5), (3, 3)),
        (24, (4, 6), (4, 6)),
        (7, (2, 4), (2, 4)),
        (3, (12, 1), (3, 1)),
        (2, (3, 4), (1, 2)),
    ],
)
def test_a_grid_has_the_largest_tiles(count, room, grid):
    assert film.fitted_grid(count, room) == grid


def test_each_law_has_a_row_of_the_grid():
    assert film.fitted_grid(10, (2, 12), rows=2) == (2, 5)
    assert film.fitted_grid(5, (5, 5), rows=1) == (2, 3)


def test_more_worlds_than_the_grid_holds_are_refused(tmp_path):
    plan = plan_of("random_cylinder", "random_box")
    rule = "number of worlds = 4 is not allowed: the film has room for 3: .* a larger --grid"
    with refusing(rule):
        film.of_sweep(tmp_path, plan, ["rps"], (0, 1, 2, 3), (1, 3))


def test_worlds_of_several_objects_keep_their_order(tmp_path):
    plan = plan_of("random_cylinder", "random_box")
    takes = film.of_sweep(tmp_path, plan, ["rps"], "first", (1, 3))
    assert [list(take.tiles) for take in takes] == [[0, 2], [1]]
    assert in_order(takes) == [f"world {i}" for i in range(3)]
    families = [scene.family for scene in in_order(takes, "scenes")]
    assert families == ["cylinder", "box", "cylinder"]


def test_worlds_are_filmed_by_their_indices(tmp_path):
    plan = plan_of("random_cylinder", "random_box")
    takes = film.of_sweep(tmp_path, plan, ["rps"], (2, 1), (1, 3))
    assert in_order(takes) == ["world 2", "world 1"]
    for wrong in ((1, 1), (-1,), (plan.worlds,)):
        with refusing("worlds"):
            film.of_sweep(tmp_path, plan, ["rps"], wrong, (1, 3))


def test_several_laws_have_a_row_each_and_a_world_a_column(tmp_path):
    base_plan = plan_of("random_box", "random_cylinder")
    plan = dataclasses.replace(base_plan, laws={"one": RPSParams.paper(), "two": RPSParams.nps()})
    takes = film.of_sweep(tmp_path, plan, ["two", "one"], "first", (2, 3))
    assert in_order(takes) == [f"{law}, world {i}" for law in ("two", "one") for i in range(3)]
    assert list(takes[-1].tiles) == [4]
    with refusing("a row for each of 2 laws"):
        film.of_sweep(tmp_path, plan, ["two", "one"], "first", (3, 2))
    with refusing("unknown law 'three'"):
        film.of_sweep(tmp_path, plan, ["three"], "first", (1, 3))


def test_a_finished_trial_is_labelled_and_not_drawn_again(tmp_path):
    setting = setting_of(60.0, "mujoco")
    near = dataclasses.replace(DOMAINS["paper"], objects=("box",), targets=((0.6, 0.0), (2.0, 2.0)))
    plan = Plan(near, 2, {"rps": RPSParams.paper()}, setting)
    (take,) = film.of_sweep(tmp_path, plan, ["rps"], "first", (1, 2))
    ((ended, first), *_, (_, previous), (over, last)) = islice(film._shots(take, setting, 50), 20)
    assert not ended
    assert [shot.label for shot in first] == ["world 0\n0 s", "world 1\n0 s"]
    assert not over
    assert last[0].label.startswith("world 0\nreached at ")
    assert last[0] is previous[0]
    assert last[1] is not previous[1]


@pytest.mark.parametrize("law", ["unicycle", slow("pose")])
def test_a_film_shows_mode_and_memory_of_the_law(law, tmp_path):
    domain = dataclasses.replace(DOMAINS["paper"], objects=("box",), targets=((-2.0, 0.1),))
    domain = dataclasses.replace(domain, robot=Robot(drive="differential"))
    plan = Plan(domain, 1, {law: registry.LAWS[law]}, setting_of(60.0, "mujoco"))
    (take,) = film.of_sweep(tmp_path, plan, [law], "first", (1, 1))
    shots = [shot for _, (shot,) in islice(film._shots(take, plan.setting, 50), 40)]
    assert np.isnan(shots[0].remembered).all()
    middle, qpos = np.asarray(shots[-1].remembered), np.asarray(shots[-1].qpos)
    assert np.linalg.norm(middle - qpos[3:5]) < 0.2
    modes = {shot.label.partition(" s")[2] for shot in shots}
    assert modes == {"", ", backing off", ", driving around the object"}


def test_the_memory_of_a_film_does_not_grow_with_its_length(tmp_path):
    (take,) = film.of_sweep(tmp_path, plan_of("random_box"), ["rps"], "first", (1, 1))
    tile = video.Tile(take.scenes[0], (1.0, 1.0))
    shot = video.Shot(take.part.worlds.qpos[0], np.zeros(2), "")

    def peak(count):
        tracemalloc.start()
        frames = ([shot] for _ in range(count))
        video.render([tile], frames, tmp_path / "x.mp4", shape=(1, 1), size=(320, 180))
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak_bytes

    peak(1)
    assert peak(30) < peak(3) + 320 * 180 * 3 * 10  # ten pictures


@pytest.mark.parametrize(
    ("grid", "size"), [("4x6", (320, 180)), ("1x1", (1280, 720)), ("12x1", (160, 90))]
)
def test_tiles_are_as_large_as_fits(grid, size):
    width, height = film._tile_size(film.Film(grid=grid).shape)
    assert (width, height) == pytest.approx(size, abs=2)
    assert width % 2 == height % 2 == 0


def test_more_trials_than_places_are_refused(tmp_path):
    (take,) = film.of_sweep(tmp_path, plan_of("random_box"), ["rps"], "first", (1, 2))
    tiles = [video.Tile(scene, (1.0, 1.0)) for scene in take.scenes]
    with refusing("grid = 1x1 is not allowed: it must have room for all 2 trials"):
        video.render(tiles, [], tmp_path / "x.mp4", shape=(1, 1), size=(320, 180))
