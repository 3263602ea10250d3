"""Pictures and videos: small, drawn from qpos alone."""

import contextlib
import itertools
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import decode, slow

from rps_jax import errors
from rps_jax.world import rendering, scene, video

# imageio_ffmpeg's reader, used here alone, forks; JAX warns that its threads might then lock.
pytestmark = pytest.mark.filterwarnings("ignore:os.fork")

SMALL = (160, 120)  # [px]
FAR = (50.0, 50.0)  # [m] a target out of sight
NOWHERE = (np.nan, np.nan)
PLAIN = {"p_world_target": FAR, "size": SMALL}
every_camera = pytest.mark.parametrize("camera", ["above", "oblique"])
on_linux = pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere MuJoCo needs no choice of GL"
)


@pytest.fixture(scope="module")
def box():
    return scene.load("box")


def render(scene, frames, path, *, p_world_target, p_world_contacts=None, **options):
    """Write a video of one trial."""
    contacts = itertools.repeat(NOWHERE) if p_world_contacts is None else p_world_contacts
    shots = ([video.Shot(*pair, "")] for pair in zip(frames, contacts, strict=False))
    video.render([video.Tile(scene, p_world_target)], shots, path, **options)


def drive(loaded, count=5):
    """Return frames in which base and object move ahead by 0.2 m per frame."""
    frames = np.tile(scene.initial_qpos(loaded), (count, 1))
    frames[:, [0, 3]] += 0.2 * np.arange(count)[:, None]
    return list(frames)


def changed(a, b):
    """Return rows and columns (n, 2) of the pixels in which two images differ clearly."""
    return np.argwhere(np.abs(a.astype(int) - b).max(axis=-1) > 60)


def red(image):
    """Return rows and columns (n, 2) of the pixels with the red of the flag."""
    r, g, _ = np.moveaxis(image.astype(int), -1, 0)
    return np.argwhere(r - g > 100)


@contextlib.contextmanager
def fails_in_one_sentence(words=""):
    with pytest.raises(video.VideoError, match=words or None) as caught:
        yield
    assert re.fullmatch(r"((?!\. ).)*\.", str(caught.value))


def test_a_video_holds_every_frame_of_a_moving_robot(box, tmp_path):
    path = tmp_path / "push.mp4"
    render(box, iter(drive(box)), path, p_world_target=(2.0, 1.0), size=SMALL)
    images = decode(path)
    assert images.shape == (5, 120, 160, 3)
    assert all(image.std() > 10 for image in images)
    assert all(len(changed(a, b)) > 20 for a, b in itertools.pairwise(images))
    assert os.listdir(tmp_path) == ["push.mp4"]


def test_the_contact_point_leaves_a_path_with_gaps(box, tmp_path):
    def last_image(contacts):
        path, frames = tmp_path / "push.mp4", [scene.initial_qpos(box)] * len(contacts)
        options = {"p_world_target": FAR, "size": (240, 180), "camera": "above"}
        render(box, frames, path, p_world_contacts=contacts, **options)
        return decode(path)[-1]

    nothing = NOWHERE
    blank = last_image([nothing] * 6)
    points = [(1.0, 1.0), (1.0, 0.5), (1.0, -0.5), (1.0, -1.0), nothing]
    whole = last_image([*points, nothing])
    gap = last_image([*points[:2], nothing, *points[2:]])
    middle = 120  # px: the column of y = 0
    assert middle in changed(blank, whole)[:, 1]
    assert middle not in changed(blank, gap)[:, 1]
    assert 0 < len(changed(blank, gap)) < len(changed(blank, whole))


@pytest.mark.parametrize("camera", [slow("above"), "oblique"])
def test_a_partially_redrawn_image_equals_the_whole_image(box, camera):
    options = {"p_world_target": (1.0, 1.0), "size": (320, 180), "camera": camera}
    frames = np.tile(scene.initial_qpos(box), (6, 1))
    frames[:, 3:5] += [(0.1 * i, 0.12 * i) for i in range(5)] + [(30, 30)]  # past the flag, away
    for drawn, qpos in zip(video.images(box, frames, **options), frames, strict=True):
        assert len(changed(drawn, video.images(box, [qpos], **options)[0])) < 6


def test_a_pin_marks_what_the_law_remembers_and_leaves_no_trace(box):
    qpos, tile = scene.initial_qpos(box), video.Tile(box, FAR)
    pins = [NOWHERE, (-0.9, 0.9), (0.9, -0.9), NOWHERE]
    with rendering.open_renderers([tile], (320, 180), "oblique") as (renderer,):
        plain, *marked, last = [renderer.draw(qpos, NOWHERE, pin) for pin in pins]
    for image, column in zip(marked, (-1, 1), strict=True):
        assert len(pin := changed(plain, image)) > 20
        assert (column * (pin[:, 1] - 160) > 0).all()
    assert not len(changed(plain, last))


def test_a_trail_drawn_in_parts_equals_one_drawn_at_once(box):
    options = {"p_world_target": FAR, "size": (320, 180), "camera": "oblique"}
    frames = np.tile(scene.initial_qpos(box), (40, 1))
    frames[:, [0, 3]] += np.linspace(0, 1, 40)[:, None]
    frames[:, [1, 4]] += np.linspace(0, -1, 40)[:, None]
    far = frames.copy()
    far[:-1, 3:5] = (-2.9, -2.9)  # behind the trail, so that all of it is drawn anew at last
    parts, whole = (video.images(box, poses, **options)[-1] for poses in (frames, far))
    assert len(changed(parts, whole)) < 6


def test_above_is_a_map_with_x_up_and_y_left(box):
    qpos = scene.initial_qpos(box)
    (image,) = video.images(box, [qpos], p_world_target=(1.5, 2.0), size=(320, 180), camera="above")
    metre = 180 / 6  # px
    row, column = np.median(red(image), axis=0)
    assert row == pytest.approx(90 - 1.5 * metre, abs=3)
    assert column == pytest.approx(160 - 2.0 * metre, abs=3)


@every_camera
def test_the_camera_follows_a_base_that_drives_away(box, camera):
    options = {"p_world_target": FAR, "size": (320, 180), "camera": camera}
    poses = np.tile(scene.initial_qpos(box), (4, 1))
    poses[:2, [0, 3]] += 12.0
    poses[:2, [1, 4]] -= 9.0
    poses[1::2, 3] += 99.0  # the object is out of sight
    far, without, near, ground = (video.images(box, [qpos], **options)[0] for qpos in poses)
    assert len(changed(far, without)) > 0.7 * len(changed(near, ground)) > 50


@every_camera
def test_both_cameras_see_targets_on_all_sides(box, camera):
    qpos = scene.initial_qpos(box)
    for target in itertools.product((-2.5, 2.5), repeat=2):
        (image,) = video.images(box, [qpos], p_world_target=target, size=(320, 180), camera=camera)
        pixels = red(image)
        assert len(pixels) > 5
        assert (pixels > 0).all()
        assert (pixels < (179, 319)).all()


def test_the_collision_capsule_of_a_drum_is_not_drawn():
    drum = scene.load("cylinder")
    qpos = scene.initial_qpos(drum)
    (image,) = video.images(drum, [qpos], **PLAIN)
    drum.model.geom("object_side").size = [1.0, 1.0, 0.0]
    assert np.array_equal(image, video.images(drum, [qpos], **PLAIN)[0])


def test_an_unwritable_path_is_refused_in_one_sentence(box, tmp_path):
    for path in (tmp_path / "missing" / "push.mp4", tmp_path):
        with fails_in_one_sentence("could not be written"):
            render(box, drive(box), path, **PLAIN)


def test_an_unfinished_video_does_not_change_the_old_file(box, tmp_path):
    path = tmp_path / "push.mp4"
    path.write_bytes(b"old")

    def broken():
        yield from drive(box)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(box, broken(), path, **PLAIN)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["push.mp4"]


def test_an_ffmpeg_that_fails_is_one_sentence(box, tmp_path, monkeypatch):
    for program in ("/bin/false", "/no/such/program"):
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", program)
        with fails_in_one_sentence():
            render(box, drive(box), tmp_path / "push.mp4", **PLAIN)
        fixes = video.check()
        assert not fixes["rendering"]
        assert fixes["ffmpeg"]


INVALID = [
    *({"frames": frames} for frames in ([], [np.full(10, np.nan)], [np.zeros(3)])),
    *({"size": size} for size in ((161, 120), (8000, 120))),
    {"p_world_target": (np.nan, 0.0)},
    {"camera": "abov"},
    {"fps": 0},
]


@pytest.mark.parametrize("change", INVALID)
def test_input_that_cannot_be_drawn_is_refused(box, tmp_path, change):
    options = {"frames": drive(box)} | PLAIN | change
    with pytest.raises(errors.InputError):
        render(box, path=tmp_path / "push.mp4", **options)
    assert not os.listdir(tmp_path)


def test_this_machine_can_draw_and_encode():
    assert video.check() == {"rendering": "", "ffmpeg": ""}


def python(code):
    """Run code in another process."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True)


def test_an_import_changes_nothing_and_without_rendering_the_check_names_the_fix(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    done = python(
        "import os, sys; before = dict(os.environ); from rps_jax.world import video; "
        "assert 'mujoco' not in sys.modules and before == dict(os.environ); print(video.check())"
    )
    assert "apt install libegl1" in done.stdout
    assert done.stderr == ""


def test_no_renderer_is_made_without_a_context(monkeypatch):
    """Of GLFW, which then ends the process on some machines."""
    mujoco = rendering._import_mujoco()
    context = SimpleNamespace(GLContext=lambda *_: SimpleNamespace(_context=None))
    monkeypatch.setattr(mujoco.rendering.classic, "gl_context", context)
    monkeypatch.setattr(mujoco, "Renderer", lambda *_, **__: pytest.fail("a renderer is made"))
    with fails_in_one_sentence("apt install libegl1"):
        rendering.check_rendering()


@on_linux
def test_an_egl_that_does_not_work_is_no_fault_of_the_users_variables(monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "none")  # MuJoCo then cannot import EGL
    done = python("import os; from rps_jax.world import video; print(video.check(), os.environ)")
    assert "apt install libegl1" in done.stdout
    assert "MUJOCO_GL = " not in done.stdout
    assert "'MUJOCO_GL'" not in done.stdout


def test_an_existing_choice_of_gl_is_respected(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    rendering.choose_gl.__wrapped__()
    assert os.environ["MUJOCO_GL"] == "osmesa"


@on_linux
def test_rendering_works_without_a_display_after_importing_mujoco(monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    code = "import mujoco; from rps_jax.world import video; print(video.check())"
    assert python(code).stdout == "{'rendering': '', 'ffmpeg': ''}\n"


@pytest.mark.parametrize("size", [(960, 540), (320, 180), (160, 90)])
def test_the_label_of_a_tile_is_large_and_inside_of_it(size):
    """Also the longest names of a film of six laws, in its tiles of 320 by 180 pixels."""
    blank = np.full((size[1], size[0], 3), 200, np.uint8)
    renderer = SimpleNamespace(draw=lambda *_: blank)
    shot = video.Shot((), (), "force_push_published, world 12\nreached at 104 s")
    image = video._labelled(renderer, shot)
    letters = (image > 220).all(axis=2)[2:-2, 2:-2]
    assert letters.any()
    assert not letters[:, -3:].any()
    plate = (image[2:-2, 2:-2] < 150).all(axis=2).any(axis=1).sum()  # [px] height of both lines
    assert plate >= min(36, size[1] / 5)
