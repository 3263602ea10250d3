"""Notebooks of the package in a folder of the user: `rps notebooks`."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.record.options import option
from rps_jax.runs.question import Command, call_of
from rps_jax.trials.progress import ProgressCallback
from rps_jax.world import objects

NAMES = (  # of those that need the package alone; all others read results of the repository
    "01_the_law",
    "02_one_push",
    "03_paper",
    "04_robustness",
    "06_fitting",
    "07_custom_law",
    "08_analysis",
    "09_gymnasium",
    "10_gradients",
    "11_rooms",
)
_METADATA = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}


@dataclass(frozen=True)
class Notebooks(Command[Path]):
    """Copy the notebooks that need the package alone, without outputs, into a folder."""

    out: Path | str | None = option("notebooks", positional=True)
    """Folder for the notebooks, which is created; it must have no files of their names."""

    def check(self) -> None:
        folder = run_folder.ensure_writable(Path(self.out or ""))
        names = [*(f"{name}.ipynb" for name in NAMES), "drawing.py"]
        if existing := [name for name in names if (folder / name).exists()]:
            rule = "choose another folder, or delete it"
            raise InputError(f"out = {folder} already has {existing[0]}: {rule}.")

    def execute(self, callback: ProgressCallback) -> Path:
        """Write the notebooks and the module of their figures; return the folder."""
        source, folder = objects.mjcf_folder().with_name("notebooks"), Path(self.out or "")
        for name in NAMES:
            text = (source / f"{name}.py").read_text("utf-8")
            files.write_text(folder / f"{name}.ipynb", notebook(text))
        files.write_text(folder / "drawing.py", (source / "drawing.py").read_text("utf-8"))
        return folder


notebooks = call_of(Notebooks)


def notebook(text: str) -> str:
    """Return the content of a notebook (JSON), from its text with cells marked by `# %%`."""
    cells = []
    for block in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        mark, _, source = block.partition("\n")
        if "markdown" in mark:
            source = re.sub(r"^# ?", "", source, flags=re.MULTILINE)
            # Links to pages of the repository, which a copy has not, become their texts.
            source = re.sub(r"!?\[([^]]*)\]\(\.\./[^)]*\)", r"\1", source)
            cell = {"cell_type": "markdown"}
        else:
            cell = {"cell_type": "code", "execution_count": None, "outputs": []}
        cells.append(cell | {"metadata": {}, "source": source.strip("\n")})
    content = {"cells": cells, "metadata": _METADATA, "nbformat": 4, "nbformat_minor": 4}
    return json.dumps(content, indent=1) + "\n"
