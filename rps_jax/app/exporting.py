"""Laws for robots and browsers: `rps export c`, `rps export js`, `rps export onnx`."""

import functools
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from rps_jax.app.export import program as programs
from rps_jax.app.export.program import Program
from rps_jax.control.registry import LawLike
from rps_jax.errors import not_allowed
from rps_jax.lowering.routine import identifier
from rps_jax.record import files, folder
from rps_jax.record.options import option
from rps_jax.robot.robot import RobotLike, parse_robot
from rps_jax.robot.skin import SkinLike
from rps_jax.runs.question import Command, call_of
from rps_jax.trials.case import suited_laws
from rps_jax.trials.progress import ProgressCallback


@dataclass(frozen=True)
class Export(Command[Path]):
    """Export of a law with its parameters, and of the skin of a robot, to another language."""

    EXAMPLES: ClassVar[Collection[str]] = ()  # files that users edit, and that stay as they are

    law: LawLike | None = None
    """The law: its name, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow, as rps,K_h=0.3 or rps,tuned.json. By default rps_plus, or the first
    law that the robot can follow."""
    robot: RobotLike = "ideal"
    """The robot, whose boards the skin has: its name, or a JSON file of its size, boards, drive and
    limits."""
    skin: SkinLike = "capacitive"
    """The skin with taxels: capacitive, with changes, as capacitive,threshold=0.3."""
    prefix: str = ""
    """Prefix of all names, a name of C; by default the law's."""
    out: Path | str | None = option(None, kw_only=True)
    """Folder that is written; by default runs/ and the command's name."""

    @functools.cached_property
    def program(self) -> Program:
        """Traced law and skin."""
        law = self.law
        if law is None:
            (law,) = suited_laws(parse_robot(self.robot), laws=["rps_plus"])
        return programs.program(law, self.robot, self.skin)

    @property
    def named(self) -> str:
        """Prefix of all names."""
        return self.prefix or identifier(self.program.label)

    def check(self) -> None:
        if self.prefix and identifier(self.prefix) != self.prefix:
            raise not_allowed("prefix", self.prefix, "write a name of C, as my_law")
        _ = self.program
        folder.ensure_writable(Path(self.out or self.default_folder))

    def texts(self) -> Mapping[str, str | bytes]:
        """Return the contents of the files, by name."""
        raise NotImplementedError

    def execute(self, callback: ProgressCallback) -> Path:
        out, texts = Path(self.out or self.default_folder), self.texts()
        for name, text in texts.items():
            content = text if isinstance(text, bytes) else text.encode()
            path = out / name
            if name in self.EXAMPLES and path.exists() and path.read_bytes() != content:
                kept = f"{path} is kept, since it differs from the example: remove it for a new one"
                warnings.warn(kept, stacklevel=2)
            else:
                files.write_bytes(path, content)
        return out / next(iter(texts))


@dataclass(frozen=True)
class ExportC(Export):
    """Write a law and a skin as one C99 header, with an example that measures itself."""

    EXAMPLES = ("main.c",)

    def texts(self) -> Mapping[str, str | bytes]:
        """Return the header and the example."""
        from rps_jax.app.export import folder

        return folder.files(self.program, self.named)


@dataclass(frozen=True)
class ExportJs(Export):
    """Write a law and a skin as one JavaScript module."""

    def texts(self) -> Mapping[str, str | bytes]:
        from rps_jax.app.export import js

        return {f"{self.named}.mjs": js.module(self.program, self.named)}


@dataclass(frozen=True)
class ExportOnnx(Export):
    """Write a law as ONNX, with named inputs and outputs and an explicit memory."""

    batch: int | None = option(None, 1, 100_000, kw_only=True)
    """Number of worlds that a model steps at once, along a first axis; by default one, without
    it."""

    def texts(self) -> Mapping[str, str | bytes]:
        """Return the model of the step."""
        from rps_jax.app.export import onnx_model

        return onnx_model.models(self.program, self.named, self.batch)


export_c = call_of(ExportC)
export_js = call_of(ExportJs)
export_onnx = call_of(ExportOnnx)
