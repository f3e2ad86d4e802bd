"""Run docs/notebook.ipynb in the current folder and store what its cells print and draw.

usage: python docs/run_notebook.py (`make notebook`)
"""

import io
import json
import os
from base64 import b64encode
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

os.environ["MPLBACKEND"] = "agg"
import matplotlib.pyplot as plt
from PIL import Image

NOTEBOOK = Path(__file__).with_name("notebook.ipynb")
COLOURS, DPI = 64, 76


def executed(notebook: dict[str, Any]) -> dict[str, Any]:
    """Return a notebook with the outputs of its cells of code, which run in their order."""
    names: dict[str, Any] = {}
    cells, number = [], 0
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            number, printed = number + 1, io.StringIO()
            with redirect_stdout(printed):
                exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
            text = printed.getvalue().splitlines(keepends=True)
            said = [{"name": "stdout", "output_type": "stream", "text": text}] if text else []
            cell = cell | {"execution_count": number, "outputs": said + pictures()}
        cells.append(cell)
    return notebook | {"cells": cells}


def pictures() -> list[dict[str, Any]]:
    """Return the open figures as outputs of a cell, and close them."""
    found = []
    for number in plt.get_fignums():
        drawn, small = io.BytesIO(), io.BytesIO()
        plt.figure(number).savefig(drawn, dpi=DPI)
        Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(small, "png", optimize=True)
        data = {"image/png": b64encode(small.getvalue()).decode()}
        found.append({"data": data, "metadata": {}, "output_type": "display_data"})
    plt.close("all")
    return found


if __name__ == "__main__":
    made = json.dumps(executed(json.loads(NOTEBOOK.read_text())), indent=1, ensure_ascii=False)
    NOTEBOOK.write_text(made + "\n")
