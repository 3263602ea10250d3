"""Execute the notebooks anew and write them, with their outputs, beside their texts.

    python notebooks/execute.py [01_the_law ...]

The kernel is the interpreter that runs this, whatever kernels are installed. What is written names
no machine and no time, so that only cells and results make a difference.
"""

import sys
from pathlib import Path

import jupytext
import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
TEXTS = tuple(sorted(HERE.glob("[0-9]*.py")))
KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}


class ThisPython(AsyncKernelManager):
    """Starts the running interpreter, whatever is asked for."""

    @property
    def kernel_spec(self) -> KernelSpec:
        """Of that interpreter."""
        argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name=KERNEL["display_name"], language="python")


def execute(text: Path) -> nbformat.NotebookNode:
    """The notebook of a text with its outputs; raises CellExecutionError if a cell fails."""
    notebook = jupytext.read(text)
    for i, cell in enumerate(notebook.cells):
        cell.id = f"cell-{i}"
    NotebookClient(
        notebook,
        kernel_manager_class=ThisPython,
        timeout=600,
        record_timing=False,
        resources={"metadata": {"path": str(HERE)}},
    ).execute()
    notebook.metadata = {"jupytext": {"formats": "ipynb,py:percent"}, "kernelspec": KERNEL}
    return notebook


def main(names: list[str]) -> None:
    """Execute the notebooks of these names, by default all."""
    for text in TEXTS:
        if not names or text.stem in names:
            print(text.stem)
            nbformat.write(execute(text), text.with_suffix(".ipynb"))


if __name__ == "__main__":
    main(sys.argv[1:])
