"""Run the notebooks and keep what they print and draw.

python tools/run_notebooks.py [notebooks/01_the_paper.ipynb …]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

from processor import plain_environment

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))


def executed(path: Path) -> Any:
    """The notebook with fresh outputs, run in its own folder; without times. Raises CellExecutionError."""
    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(notebook, kernel_name="python3", timeout=600, record_timing=False, resources=place)
    client.execute(env=plain_environment())
    drop_progress(notebook)
    return notebook


def drop_progress(notebook: Any) -> None:
    """Leave out the line of progress of `cr.run`, which is there where a run took long, and empty in the end."""
    for cell in notebook.cells:
        if "outputs" in cell:
            cell.outputs = [one for one in cell.outputs if one.get("data") != {"text/plain": ""}]


def printed(notebook: Any) -> list[str]:
    """What its cells print and give, in order; pictures by their format only."""
    texts: list[str] = []
    for cell in notebook.cells:
        stream = None
        for output in cell.get("outputs", []):
            if "text" not in output:
                texts.append(", ".join(sorted(output.get("data", {}))))
            elif stream is not None and output.get("name") == stream:
                texts[-1] += output["text"]  # one text may come in several pieces, by how busy the machine is
            else:
                texts.append(output["text"])
            stream = output.get("name")
    return texts


def main() -> None:
    parser = argparse.ArgumentParser(description="Run notebooks and keep their outputs.")
    parser.add_argument("notebooks", type=Path, nargs="*", default=NOTEBOOKS, help="default: all")
    for path in parser.parse_args().notebooks:
        nbformat.write(executed(path), path)


if __name__ == "__main__":
    main()
