"""Images and videos of trials, from their qpos."""

from __future__ import annotations

import contextlib
import os
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rps_jax import errors
from rps_jax.world.rendering import (
    NO_CONTACT,
    SceneRenderer,
    Tile,
    VideoError,
    check_rendering,
    open_renderers,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from rps_jax.world.scene import Scene

SIZE = (960, 540)  # [px] width, height

_EMPTY = 58  # grey of a place in a grid without a trial
_INK = (24, 26, 30)  # RGB around labels and tiles
_PLATE = 170  # opacity behind a label, of 255
_LABEL = 9  # [1] heights of a line of text in a tile

_FIX_FFMPEG = "ffmpeg was not found or does not run: run `pip install imageio-ffmpeg`."


class Shot(NamedTuple):
    """Content of a tile in one frame."""

    qpos: ArrayLike  # (10,) as for `images`
    p_world_contact: ArrayLike  # (2,) [m], NaN without contact
    label: str
    remembered: ArrayLike = NO_CONTACT  # (2,) [m] object's middle, NaN if the law remembers none


def check() -> dict[str, str]:
    """Return how to fix drawing and encoding on this machine; an empty text if they work."""
    fixes = {}
    for name, attempt in (("rendering", check_rendering), ("ffmpeg", _try_encoding)):
        try:
            attempt()
            fixes[name] = ""
        except VideoError as error:
            fixes[name] = str(error)
    return fixes


def images(
    scene: Scene,
    frames: Iterable[ArrayLike],
    *,
    p_world_target: ArrayLike,
    lines: Mapping[str, np.ndarray] = MappingProxyType({}),
    size: tuple[int, int] = SIZE,
    camera: str = "oblique",
) -> list[np.ndarray]:
    """Return RGB images (height, width, 3) uint8, each with the path of the base until then.

    Args:
      scene: of `scene.load`.
      frames: qpos (10,): base x, y [m], yaw [rad]; object position [m] and quaternion, in the
        world.
      p_world_target: (2,) [m] of the flag.
      lines: path and walls of a task, see `Course.lines`.
      size: width and height [px].
      camera: name of a camera of the scene: oblique or above.

    Raises:
      InputError: a qpos, target, size or camera that cannot be used.
      VideoError: this machine cannot draw.
    """
    with open_renderers([Tile(scene, p_world_target, lines)], size, camera) as (renderer,):
        return [renderer.draw(qpos, NO_CONTACT) for qpos in frames]


def render(
    tiles: Sequence[Tile],
    frames: Iterable[Sequence[Shot]],
    path: str | os.PathLike[str],
    *,
    shape: tuple[int, int] = (1, 1),
    size: tuple[int, int] = SIZE,
    fps: int = 25,
    camera: str = "oblique",
) -> None:
    """Write an MP4 (H.264, yuv420p) of trials side by side, with paths of bases and contacts.

    Frames are drawn and encoded one by one as they come, so memory does not grow with them. The
    file appears at `path` when it is complete, and a file already there stays until then.

    Args:
      tiles: of the grid, row by row; it may have room for more.
      frames: the content of each tile, frame by frame; a tile with the same object as in the
        last frame is not drawn again.
      path: the file to write.
      shape: rows and columns of the grid.
      size: width and height of a tile [px], even numbers.
      fps: frames per second of the video.
      camera: name of a camera of the scenes: oblique or above.

    Raises:
      InputError: no frames, or a shot, target, rate, size or camera that cannot be used.
      VideoError: this machine cannot draw or encode, or `path` cannot be written.
    """
    errors.check_finite("fps", fps, above=0, at_most=1000)
    if any(n % 2 for n in size):
        raise errors.not_allowed("size", size, "H.264 needs two even numbers")
    (rows, columns), (width, height) = shape, size
    if not 0 < len(tiles) <= rows * columns:
        rule = f"it must have room for all {len(tiles)} trials, and at least one"
        raise errors.not_allowed("grid", f"{rows}x{columns}", rule)
    whole = np.full((rows * height, columns * width, 3), _EMPTY, np.uint8)
    cells = whole.reshape(rows, height, columns, width, 3).swapaxes(1, 2)
    with (
        open_renderers(tiles, size, camera) as renderers,
        _encoder(Path(path), (columns * width, rows * height), fps) as sink,
    ):
        shown: list[Shot | None] = [None] * len(tiles)
        for shots in frames:
            for i, (renderer, shot) in enumerate(zip(renderers, shots, strict=True)):
                if shot is not shown[i]:
                    cells[divmod(i, columns)] = _labelled(renderer, shot)
                    shown[i] = shot
            sink(whole)
        if shown[0] is None:
            raise errors.not_allowed("frames", [], "a video needs at least one frame")


def _labelled(renderer: SceneRenderer, shot: Shot) -> np.ndarray:
    """Draw a tile; a label adds a text on a plate, as large as fits, and a frame."""
    drawn = renderer.draw(shot.qpos, shot.p_world_contact, shot.remembered)
    if not shot.label:
        return drawn
    image = Image.fromarray(drawn)
    draw = ImageDraw.Draw(image, "RGBA")
    fits = 1.8 * image.width / max(map(len, shot.label.splitlines()))
    font = ImageFont.load_default(min(fits, 40, max(16, image.height / _LABEL)))
    _, _, right, bottom = draw.multiline_textbbox((5, 1), shot.label, font)
    draw.rectangle((0, 0, right + 4, bottom + 4), fill=(*_INK, _PLATE))
    draw.text((5, 1), shot.label, "white", font)
    draw.rectangle((0, 0, image.width - 1, image.height - 1), outline=_INK)
    return np.asarray(image)


@contextlib.contextmanager
def _encoder(
    path: Path, size: tuple[int, int], fps: int
) -> Iterator[Callable[[np.ndarray | bytes], None]]:
    """Yield a function that encodes RGB images; write `path` only if all succeed."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise VideoError(_FIX_FFMPEG) from error
    part = path.parent / f".{path.stem}.{os.getpid()}.part.mp4"
    try:
        part.touch()
        sink = imageio_ffmpeg.write_frames(
            str(part),
            size,
            fps=fps,
            codec="libx264",
            quality=7,
            macro_block_size=2,
            output_params=["-preset", "veryfast"],  # half the time, and no larger
        )
        with contextlib.closing(sink):
            with warnings.catch_warnings():  # JAX warns of forks; this one only starts ffmpeg
                warnings.simplefilter("ignore", RuntimeWarning)
                sink.send(None)
            yield sink.send
        if part.stat().st_size == 0:  # a silent death of ffmpeg goes unnoticed by its wrapper
            raise VideoError(_FIX_FFMPEG)
        os.replace(part, path)
    except OSError as error:
        # ffmpeg's own failure comes as an OSError too, with the end of its log as the message.
        reason = error.strerror or str(error).strip().splitlines()[-1]
        if error.filename and error.filename == os.environ.get("IMAGEIO_FFMPEG_EXE"):
            rule = f"it does not run ({reason}): name another ffmpeg, or unset it"
            fault = errors.not_allowed("IMAGEIO_FFMPEG_EXE", error.filename, rule)
            raise VideoError(fault) from error
        raise VideoError(
            f"{path} could not be written ({reason}): choose a folder that exists, can be "
            "written to and has space left; if it does, run `pip install imageio-ffmpeg`."
        ) from error
    except RuntimeError as error:
        raise VideoError(_FIX_FFMPEG) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


def _try_encoding() -> None:
    with (
        tempfile.TemporaryDirectory() as folder,
        _encoder(Path(folder) / "black.mp4", (16, 16), 1) as sink,
    ):
        sink(bytes(16 * 16 * 3))
