"""Execute the notebooks' texts, and write `.ipynb` files with their outputs.

    python notebooks/execute.py [01_the_law ...]

The tutorials run in an empty folder, since they need the package alone.
The kernel is the running interpreter, independent of installed kernels. The files name no machine
and no time, so that a difference is one of cells or results.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import jupytext
import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).resolve().parent
TEXTS = tuple(sorted(FOLDER.glob("[0-9]*.py")))
TUTORIALS = tuple(text for text in TEXTS if text.stem[:2] in ("07", "08", "09", "11"))
KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}


class ThisPython(AsyncKernelManager):
    """Kernel manager that starts the running interpreter for any kernel name."""

    @property
    def kernel_spec(self) -> KernelSpec:
        """Specification of a kernel of the running interpreter."""
        argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name=KERNEL["display_name"], language="python")


def execute(texts: Sequence[Path], folder: Path = FOLDER) -> list[NotebookNode]:
    """Execute texts in a folder and return notebooks with outputs.

    A cell that fails raises CellExecutionError.

    One kernel executes them all in sequence and deletes its names in between. Otherwise imports
    would take most of the time.
    """
    notebooks = [jupytext.read(text) for text in texts]
    joined = nbformat.v4.new_notebook()
    for notebook in notebooks:
        joined.cells += [nbformat.v4.new_code_cell("%reset -f"), *notebook.cells]
    NotebookClient(
        joined,
        kernel_manager_class=ThisPython,
        timeout=600,
        record_timing=False,
        resources={"metadata": {"path": str(folder)}},
    ).execute()
    for notebook in notebooks:
        notebook.metadata = {"jupytext": {"formats": "ipynb,py:percent"}, "kernelspec": KERNEL}
        _set_ids(notebook)
    return notebooks


def _set_ids(notebook: NotebookNode) -> None:
    """Set the ids of cells and the counts of code cells, as if this notebook ran alone."""
    count = 0
    for i, cell in enumerate(notebook.cells):
        cell.id = f"cell-{i}"
        if cell.cell_type == "code":
            count += 1
            cell.execution_count = count
            for output in cell.outputs:
                if output.output_type == "execute_result":
                    output.execution_count = count


def main() -> None:
    """Execute the notebooks that the command line names, by default all."""
    parser = argparse.ArgumentParser(description="Execute notebooks, and write their outputs.")
    stems = [text.stem for text in TEXTS]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(stems)}")
    names = parser.parse_args().names
    if unknown := set(names) - set(stems):
        parser.error(f"unknown notebook {', '.join(sorted(unknown))}: choose of {', '.join(stems)}")
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # before the kernel imports MuJoCo
    with tempfile.TemporaryDirectory() as empty:
        for group, folder in ((set(TEXTS) - set(TUTORIALS), FOLDER), (TUTORIALS, Path(empty))):
            texts = [text for text in TEXTS if text in group and (not names or text.stem in names)]
            for text, notebook in zip(texts, execute(texts, folder), strict=True):
                nbformat.write(notebook, text.with_suffix(".ipynb"))


if __name__ == "__main__":
    main()
