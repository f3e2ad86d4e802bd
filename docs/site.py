"""Build the documentation site in site/; run it by ``make docs``. A warning of Zensical is an error.

Pages are README.md, METHOD.md, CHANGELOG.md, docs/*.md and the notebook with their links adapted. The references of
commands, settings and Python are generated from click, pydantic and docstrings. Commands make pictures of the gallery.
"""

import json
import re
import shutil
import subprocess
import sys
import textwrap
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

import click
from pydantic import BaseModel
from pydantic.fields import FieldInfo

import sat_intervals
from sat_intervals.cli.app import STEPS
from sat_intervals.config import Config

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "build" / "docs"
CAMERAS = "--left-model demo/left_model.tif --right-model demo/right_model.tif"
GRIDS = "--left-grid demo/left_grid.tif --right-grid demo/right_grid.tif"
COMPARED = "--dsm demo/dsm.tif --reference demo/lidar.tif"
LOCAL = "--set disparity.local=true"
# Commands of the gallery, run in the folder of its pictures: title, command, what it shows.
GALLERY = (
    ("A scene with exact truth", "sat-intervals demo demo --size 700 700", ""),
    ("Maps, misses, rows", "sat-intervals plot demo --dpi 90", "demo/overview.png demo/errors.png demo/rows.png"),
    ("A run at another coverage", "sat-intervals match demo/left.tif demo/right.tif half --coverage 0.5", ""),
    ("Coverage and width of both runs", "sat-intervals plot demo --dpi 90 --beside half", "demo/coverage.png"),
    ("A row", "sat-intervals plot demo --dpi 90 --row 350 --columns 100 500", "demo/profile.png"),
    ("The page of a run", "sat-intervals report demo", "demo/report.html"),
    ("Sensor models and heights of the scene", "python docs/pictures/demo_cameras.py demo", ""),
    ("A surface model", f"sat-intervals dsm demo --resolution 1 {CAMERAS} {GRIDS}", ""),
    ("Margins from heights", f"sat-intervals calibrate {COMPARED} --output heights.yaml", ""),
    ("The calibrated surface", "sat-intervals dsm demo --resolution 1 --calibration heights.yaml", ""),
    ("Its heights and half widths", "sat-intervals plot demo --dpi 90", "demo/dsm.png"),
    (
        "Its errors, half widths beside those needed, and a line across it",
        f"sat-intervals evaluate {COMPARED} --pictures demo --overwrite",
        "demo/dsm-errors.png demo/dsm-reliability.png demo/dsm-profile.png",
    ),
    ("A relief, with local ranges", f"sat-intervals demo relief --size 500 500 --relief 60 {LOCAL}", ""),
    ("Its maps", "sat-intervals plot relief --dpi 90", "relief/overview.png"),
    ("Raw images of a scene, and the surface of all", "sat-intervals demo many --images 5 --size 300 340", ""),
    ("Its heights and half widths", "sat-intervals plot many --dpi 90", "many/dsm.png"),
)  # fmt: skip


def adapted(text: str) -> str:
    """Adapt the links of a document, which are those of the repository, to the pages of the site.

    A picture is a link to itself, in full size. Long commands are folded.
    """
    text = re.sub(r"\[(?:docs/)?(\w+)\.md\]\(", r"[\1](", text)
    text = re.sub(r"\]\((?:\.\./)?README\.md", "](index.md", text)
    text = re.sub(r"\]\((?:\.\./)?docs/", "](", text)
    text = re.sub(r"\]\((?:\.\./)?\.github/pictures/", "](pictures/", text)
    text = text.replace("](notebook.ipynb)", "](notebook.md)")
    text = re.sub(r"!\[([^\]]*)\]\(([^)]*)\)", r"[![\1](\2)](\2)", text)
    text = re.sub(r"^(?:sat-intervals|otbcli_|parallel_stereo)[^#|'\"\n]{78,}$", folded, text, flags=re.MULTILINE)
    return text.replace("](../", "](")


def folded(command: re.Match[str]) -> str:
    """Return a long command on several lines, as a shell reads it."""
    return " \\\n".join(textwrap.wrap(command[0], 76, break_on_hyphens=False, subsequent_indent="    "))


def settings_reference() -> str:
    """Return the page of all settings, from the models."""
    lines = [
        "# Settings",
        "",
        "All keys with their types, ranges and defaults. [settings.md](settings.md) explains them.",
        "",
    ]
    for name, field in Config.model_fields.items():
        models = list(models_of(field.annotation))
        lines += [f"## `{name}`", ""]
        if not models:
            lines += [f"{described(field)}: {kind_of(field)}. Default `{field.default}`.", ""]
        elif NoneType in get_args(field.annotation):
            lines += ["`null` switches the step off.", ""]
        for model in models:
            lines += [f"### {title_of(model)}", ""] if len(models) > 1 else []
            lines += ["| key | values | default | meaning |", "|---|---|---|---|"]
            for key, one in model.model_fields.items():
                default = "required" if one.is_required() else f"`{one.get_default(call_default_factory=True)}`"
                lines.append(f"| `{key}` | {kind_of(one)} | {default} | {described(one)} |")
            lines.append("")
    return "\n".join(lines)


def models_of(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models in an annotation, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    else:
        for part in get_args(annotation):
            yield from models_of(part)


def title_of(model: type[BaseModel]) -> str:
    """Return the value by which a kind of section is chosen."""
    for key in ("method", "penalty"):
        if key in model.model_fields and (values := get_args(model.model_fields[key].annotation)):
            return f"`{key}: {values[0]}`" + (" with MC-CNN" if model.__name__ == "MccnnSgm" else "")
    return model.__name__


def kind_of(field: FieldInfo) -> str:
    """Return type and range of a key."""
    limits = []
    for name, sign in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"), ("multiple_of", "multiple of")):
        limits += [f"{sign} {getattr(one, name)}" for one in field.metadata if getattr(one, name, None) is not None]
    return ", ".join([words(field.annotation), *limits]).replace("|", "\\|")


def words(annotation: Any) -> str:
    """Return a type in words."""
    if annotation is NoneType:
        return "null"
    if get_origin(annotation) is Literal:
        return " or ".join(f"`{value}`" for value in get_args(annotation))
    if parts := [
        part for part in get_args(annotation) if part is NoneType or get_origin(part) or isinstance(part, type)
    ]:
        return " or ".join(dict.fromkeys(map(words, parts)))
    names = {int: "whole number", float: "number", bool: "true or false", str: "text"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def described(field: FieldInfo) -> str:
    """Return the meaning of a key for a cell of a table."""
    return " ".join((field.description or "").split()).replace("|", "\\|")


def command_reference() -> str:
    """Return the page of all commands, their own help."""
    lines = ["# Commands", "", "Each section is what `sat-intervals COMMAND --help` prints.", ""]
    for step, commands in STEPS.items():
        lines += [f"## {step}", ""]
        for command in commands:
            context = click.Context(command, info_name=f"sat-intervals {command.name}", terminal_width=78)
            lines += [f"### {command.name}", "", "```text", command.get_help(context), "```", ""]
    return "\n".join(lines)


def python_reference() -> str:
    """Return the page of public names; mkdocstrings puts their docstrings there."""
    names = [f"sat_intervals.{home}.{name}" for name, home in sorted(sat_intervals._HOMES.items())]
    return "\n\n".join(["# Python", "All names are imported from `sat_intervals`.", *(f"::: {name}" for name in names)])


def gallery() -> str:
    """Run the commands of the gallery and return its page, below docs/gallery.md."""
    lines = [adapted((ROOT / "docs" / "gallery.md").read_text()), "Each command below makes the picture under it.", ""]
    folder = PAGES / "gallery-files"
    folder.mkdir()
    for title, command, files in GALLERY:
        program, *arguments = command.split()
        words = ["-c", RUN, *arguments] if program == "sat-intervals" else [str(ROOT / arguments[0]), *arguments[1:]]
        subprocess.run([sys.executable, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        lines += [f"## {title}", "", "```", command, "```", ""]
        for file in files.split():
            if not (folder / file).exists():
                raise FileNotFoundError(f"{command} has not made {file}")
            link = f"gallery-files/{file}"
            lines += [f"[![{title}]({link})]({link})" if file.endswith(".png") else f"[Open the page]({link})", ""]
    for file in [path for path in folder.rglob("*.*") if path.suffix not in (".png", ".html")]:
        file.unlink()
    return "\n".join(lines)


def notebook(target: Path) -> str:
    """Return the page of the notebook, with what its cells have printed; write its pictures to a folder."""
    target.mkdir()
    text = []
    for number, cell in enumerate(json.loads((ROOT / "docs" / "notebook.ipynb").read_text())["cells"]):
        source = "".join(cell["source"])
        text.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for k, output in enumerate(cell.get("outputs", [])):
            if "text" in output:
                text.append(f"```text\n{''.join(output['text'])}```")
            else:
                picture = target / f"{number}-{k}.png"
                picture.write_bytes(b64decode(output["data"]["image/png"]))
                text.append(f"![Pictures of this cell]({target.name}/{picture.name})")
    return "\n\n".join([*text, ""])


# Long commands and wide tables are read without scrolling.
STYLE = """\
.md-typeset pre > code { white-space: pre-wrap; }
.md-typeset table:not([class]) th, .md-typeset table:not([class]) td { min-width: 0; padding: 0.5em 0.6em; }
"""
RUN = "import sys; from sat_intervals.cli import main; sys.argv[0] = 'sat-intervals'; main()"


def write_pages() -> None:
    """Write all pages to build/docs."""
    shutil.rmtree(PAGES, ignore_errors=True)
    PAGES.mkdir(parents=True)
    shutil.copytree(ROOT / ".github" / "pictures", PAGES / "pictures")
    for file in (ROOT / "README.md", ROOT / "METHOD.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")):
        name = "index.md" if file.name == "README.md" else file.name
        (PAGES / name).write_text(adapted(file.read_text()))
    (PAGES / "notebook.md").write_text(adapted(notebook(PAGES / "notebook-files")))
    (PAGES / "settings-reference.md").write_text(settings_reference())
    (PAGES / "style.css").write_text(STYLE)
    (PAGES / "commands.md").write_text(command_reference())
    (PAGES / "python-reference.md").write_text(python_reference())


if __name__ == "__main__":
    write_pages()
    (PAGES / "gallery.md").write_text(gallery())
    subprocess.run([sys.executable, "-m", "zensical", "build", "--clean", "--strict"], cwd=ROOT, check=True)
    print("Open site/index.html")
