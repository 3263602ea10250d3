"""Execute the notebooks anew and write them, with their outputs, beside their texts.

    python notebooks/execute.py [01_the_law ...]

The kernel is the interpreter that runs this, whatever kernels are installed. What is written names
no machine and no time, so that only cells and results make a difference.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import jupytext
import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbformat import NotebookNode

from rps_jax.world import rendering

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


def execute(texts: Sequence[Path]) -> list[NotebookNode]:
    """The notebooks of texts, with their outputs; raises CellExecutionError if a cell fails.

    One kernel executes them all, one after the other, and forgets its names in between: most of the
    time would go into imports otherwise.
    """
    notebooks = [jupytext.read(text) for text in texts]
    whole = nbformat.v4.new_notebook()
    for notebook in notebooks:
        whole.cells += [nbformat.v4.new_code_cell("%reset -f"), *notebook.cells]
    NotebookClient(
        whole,
        kernel_manager_class=ThisPython,
        timeout=600,
        record_timing=False,
        resources={"metadata": {"path": str(HERE)}},
    ).execute()
    for notebook in notebooks:
        notebook.metadata = {"jupytext": {"formats": "ipynb,py:percent"}, "kernelspec": KERNEL}
        _number(notebook)
    return notebooks


def _number(notebook: NotebookNode) -> None:
    """Name its cells and count those of code, as if it had been executed alone."""
    count = 0
    for i, cell in enumerate(notebook.cells):
        cell.id = f"cell-{i}"
        if cell.cell_type == "code":
            count += 1
            cell.execution_count = count
            for output in cell.outputs:
                if output.output_type == "execute_result":
                    output.execution_count = count


def main(names: list[str]) -> None:
    """Execute the notebooks of these names, by default all."""
    rendering.choose_gl()  # before the kernel imports MuJoCo for any of them
    texts = [text for text in TEXTS if not names or text.stem in names]
    for text, notebook in zip(texts, execute(texts), strict=True):
        nbformat.write(notebook, text.with_suffix(".ipynb"))


if __name__ == "__main__":
    main(sys.argv[1:])
