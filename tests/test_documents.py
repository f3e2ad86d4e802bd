"""The documents: README stays short, links lead somewhere, code cites sections that exist, commands and code run."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import rasterio
from helpers import COMMAND, invoke

from sat_intervals.cli import main
from sat_intervals.config import Config
from sat_intervals.demo import make_scene
from sat_intervals.workflows.demo import write_views

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "METHOD.md", *sorted((ROOT / "docs").glob("*.md"))]
MOST_WORDS, MOST_WORDS_OF_A_SENTENCE = 1500, 30


def prose(text: str) -> str:
    """Return a document without code blocks, tables, pictures and the targets of links."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(\||!\[).*$", "", text, flags=re.MULTILINE)
    return re.sub(r"\]\([^)]*\)", "]", text)


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of all paragraphs, list items and headings."""
    for block in re.split(r"\n\s*\n|\n(?=[#-])", prose(text)):
        yield from re.split(r"(?<=[.!?])[*_]*\s+", block)


def anchors(document: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a document."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def sections(text: str) -> Iterator[int]:
    """Yield the numbers of the sections of METHOD.md that a text cites."""
    text = re.sub(r"\s+#?\s*", " ", text)
    for one in re.finditer(r"METHOD\.md, sections? (\d+(?:(?:, | and | to )\d+)*)", text):
        yield from map(int, re.findall(r"\d+", one[1]))


def test_readme__is_short() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= MOST_WORDS
    long = [" ".join(one.split()) for one in sentences(text) if len(one.split()) > MOST_WORDS_OF_A_SENTENCE]
    assert long == []


def test_readme__begins_with_commands_that_work_without_an_environment() -> None:
    first = [line.partition("  #")[0].rstrip() for line in next(blocks(ROOT / "README.md", "")).splitlines()]
    assert first[:2] == ["make demo", ". .venv/bin/activate"]
    assert "make test" in first
    assert all(re.search(rf"^{name}: ", (ROOT / "Makefile").read_text(), re.MULTILINE) for name in ("demo", "test"))
    steps = (ROOT / ".ci" / "run").read_text()
    assert steps.index("--skip-nothing make test\n") < steps.index("make EXTRAS=")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: file.name)
def test_links__lead_to_files_and_headings(document: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = document.parent / name if name else document
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_code__cites_sections_that_exist() -> None:
    numbers = {int(n) for n in re.findall(r"^## (\d+)\. ", (ROOT / "METHOD.md").read_text(), re.MULTILINE)}
    folders = ("sat_intervals", "cli", "configs", "tests", "docs")
    files = [
        file for folder in folders for ending in ("py", "yaml", "md") for file in (ROOT / folder).rglob(f"*.{ending}")
    ]
    cited = {(file.name, number) for file in files for number in sections(file.read_text())}
    assert len(cited) > 10
    assert {one for one in cited if one[1] not in numbers} == set()
    old = [file.name for file in files if file != Path(__file__) and re.search(r"method: section", file.read_text())]
    assert old == []


# What three dots at the end of a command stand for.
SENSORS = " --left-model left.geom --right-model right.geom --left-grid left_grid.tif --right-grid right_grid.tif"


def blocks(document: Path, language: str) -> Iterator[str]:
    """Yield the code blocks of a document in a language."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", document.read_text(), re.MULTILINE | re.DOTALL)
    yield from (code for of, code in found if of == language)


def commands() -> list[tuple[str, str]]:
    """Return the name of the document and the line of each command, without comments, redirections and prompts."""
    found = []
    for document in DOCUMENTS:
        for line in "".join(blocks(document, "")).splitlines():
            if line.removeprefix("$ ").startswith("sat-intervals "):
                line = re.sub(r"\s+(#|>).*", "", line.removeprefix("$ "))
                found.append((document.name, re.sub(r" \.\.\.$", SENSORS, line)))
    return found


def test_commands__have_arguments_and_options_that_exist() -> None:
    found = commands()
    assert len(found) > 40
    for document, line in found:
        name, *words = shlex.split(line)[1:]
        assert name in main.commands, (document, line)
        main.commands[name].make_context(name, words)  # raises for what it does not know
    assert {shlex.split(line)[1] for document, line in found if document == "gallery.md"} == main.commands.keys()


# What a machine of tests lacks, or what takes long, and where it is tried instead.
NOT_RUN = {
    "s3://": "tests/store/test_remote.py",
    "LEFT.TIF": "tests/heights/test_rectify.py, with a raw pair made up",
    "pair/left.tif": "likewise",
    "surface left.tif right.tif out/ --resolution 1": "likewise",
    "dsm run/": "likewise",
    "2014_1.tif": "likewise",
    "2015_1.tif": "likewise",
    "change before/": "tests/workflows/test_change.py, with surfaces made up",
    "lidar.tif": "tests/evaluate/test_dsm.py: there are no heights of others for the demo scene",
    "dsm one/": "tests/heights/test_dsm.py, with runs made up",
    "heights.yaml": "tests/heights/test_dsm.py, with a calibration made up",
    "sat-intervals reference": "tests/heights/test_reference.py, likewise",
    "--truth out/truth.tif": "tests/heights/test_reference.py, with the truth of reference",
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files that the documents name, made of a small scene and its sensor models."""
    folder = tmp_path_factory.mktemp("documents")
    assert invoke("demo", folder, "--size", "160", "200", "--quiet").exit_code == 0
    subprocess.run([sys.executable, ROOT / "docs" / "pictures" / "demo_cameras.py", folder], check=True)
    for name in ("intervals.tif", "validity.tif", "run.json"):
        (folder / name).unlink()
    copies = {
        "left": ["left.vrt", "stereo/run-L.tif", "TILE/pair_1/rectified_ref.tif"],
        "truth": ["disparity.tif"],
        "right": ["right.vrt", "stereo/run-R.tif", "TILE/pair_1/rectified_sec.tif"],
    }
    for pair in ("pair1", "pair2", "pair3", "PAIRS..."):
        (folder / pair).mkdir()
        (folder / pair / "meta.json").write_text('{"disparity": [-12, 40]}')
        for side in ("left", "right", "truth"):
            copies.setdefault(side, []).append(f"{pair}/{side}.tif")
    copies |= {f"{side}_model": [f"raw_{side}.tif"] for side in ("left", "right")}
    for side, names in copies.items():
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(folder / f"{side}.tif", folder / name)
    for path in write_views(folder / "views", 160, 200, 3)[0]:
        shutil.copy(path, folder)
    (folder / "pairs.csv").write_text("name,left,right,minimum,maximum\na,left.tif,right.tif,-12,40\n")
    (folder / "cluster.yaml").write_text("disparity: {minimum: -12, maximum: 40}\ncluster: {workers: 2}\n")
    return folder


_REPLACES = r"sat-intervals (match .*(?<!--dry-run)$|surface|batch|export|(range|dsm|calibrate) .*--output)"


def in_documents(line: str) -> str:
    """Return a command of a document for the files of `place`; a command replaces the files of those before."""
    line = re.sub(r"(left|right)\.geom", r"\1_model.tif", line)
    line = line.replace("--row 640", "--row 64").replace("--disparity -60 0", "--disparity -12 40")
    return f"{line} --overwrite" if re.match(_REPLACES, line) else line


@pytest.mark.process
@pytest.mark.peer("shareloc", "matplotlib")
def test_commands__of_all_documents_run(place: Path) -> None:
    subprocess.run([COMMAND, "range", "left.tif", "right.tif", "--output", "range.tif"], cwd=place, check=True)
    settings = subprocess.run([COMMAND, "config", "--preset", "satellite"], capture_output=True, text=True, check=True)
    (place / "settings.yaml").write_text(settings.stdout)
    for line, document in {in_documents(line): document for document, line in commands()}.items():
        if any(words in line for words in NOT_RUN):
            continue
        words = shlex.split(line)
        if "--dry-run" in words:
            (place / "slurm.yaml").write_text(
                "disparity: {minimum: 0, maximum: 9}\ncluster: {kind: slurm, memory: 1GB}\n"
            )
            words[words.index("cluster.yaml")] = "slurm.yaml"
        done = subprocess.run([COMMAND, *words[1:]], cwd=place, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, (document, line, done.stderr)


# What the code of documents is given.
GIVEN = """
import numpy as np
import rasterio

left, right = (rasterio.open(f"{side}.tif").read(1) for side in ("left", "right"))
"""


@pytest.mark.process
@pytest.mark.peer("pandora", "xdem", "shareloc")
def test_code__of_all_documents_runs(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each in a process of its own: Pandora asks for other keys once it has had a network."""
    from raw import raw_pair  # needs the extra `dsm`

    monkeypatch.chdir(place)
    raw_pair(place / "raw", make_scene(400, 500, seed=3))
    count = 0
    for document in DOCUMENTS:
        for code in blocks(document, "python"):
            shutil.rmtree(place / "out", ignore_errors=True)
            assert invoke("match", "left.tif", "right.tif", "out", "--disparity", -12, 40).exit_code == 0
            if "match_pair" in code or ".surface(" in code:
                shutil.rmtree(place / "out")
            if "lidar.tif" in code or "later/" in code:
                assert invoke("dsm", "out", "--resolution", 1, *shlex.split(in_documents(SENSORS))).exit_code == 0
                _write_lidar(place)
                shutil.copytree(place / "out", place / "later", dirs_exist_ok=True)
            code = code.replace('.surface(["left.tif", "right.tif"]', '.surface(["raw/left.tif", "raw/right.tif"]')
            code = GIVEN + code.replace("profile(640)", "profile(64)")
            done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
            assert done.returncode == 0, (document, code, done.stderr)
            count += 1
    assert count >= 2


def _write_lidar(place: Path) -> None:
    """Write heights whose distances from the surface are as wide as its intervals."""
    random = np.random.default_rng(0)
    with rasterio.open(place / "out" / "dsm.tif") as surface:
        height, lower, upper = surface.read([1, 2, 3])
        lidar = height + (upper - lower) / 2 * random.uniform(-1, 1, height.shape)
        with rasterio.open(place / "lidar.tif", "w", **surface.profile | {"count": 1}) as file:
            file.write(lidar.astype(np.float32), 1)


def module_of(name: str) -> ModuleType:
    """Return a script of docs/ as a module."""
    spec = spec_from_file_location(f"docs_{name}", ROOT / "docs" / f"{name}.py")
    assert spec
    assert spec.loader
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.peer("matplotlib", "shareloc")
@pytest.mark.usefixtures("thinned")
def test_notebook__runs_and_prints_what_it_has_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In less than a minute on two cores, compilation apart; numbers may differ between processors."""
    monkeypatch.chdir(tmp_path)
    file = ROOT / "docs" / "notebook.ipynb"
    stored = json.loads(file.read_text())
    made = module_of("run_notebook").executed(stored)

    def said(notebook: dict[str, Any]) -> list[str]:
        outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
        return [re.sub(r"-?[\d.]+", "#", "".join(one.get("text", "picture"))) for one in outputs]

    assert said(made) == said(stored)
    assert said(made).count("picture") == 5
    assert file.stat().st_size < 400_000


def test_site__has_a_page_for_every_document_and_every_setting() -> None:
    site = module_of("site")
    listed = set(re.findall(r"([\w-]+\.md)", (ROOT / "mkdocs.yml").read_text()))
    made = {"index.md", "notebook.md", "commands.md", "settings-reference.md", "python-reference.md", "CHANGELOG.md"}
    assert listed == made | {document.name for document in DOCUMENTS} - {"README.md"}
    settings = site.settings_reference()
    for name, field in Config.model_fields.items():
        assert f"## `{name}`" in settings
        for model in site.models_of(field.annotation):
            assert all(f"| `{key}` |" in settings for key in model.model_fields)
    assert "| `size` | whole number, >= 64, <= 16384, multiple of 64 | `1024` |" in settings
    text = site.command_reference()
    assert all(f"### {name}\n" in text and f"Usage: sat-intervals {name} " in text for name in main.commands)
    assert (
        site.adapted("[a](../METHOD.md#1) [b](docs/x.md) [c](../README.md)")
        == "[a](METHOD.md#1) [b](x.md) [c](index.md)"
    )
    assert site.adapted("[docs/x.md](docs/x.md#y)") == "[x](x.md#y)"
    long = "sat-intervals match left.tif right.tif " + " ".join(["--left-mask mask.tif"] * 5)
    lines = site.adapted(long).split(" \\\n")
    assert [len(line) <= 80 for line in lines] == [True, True]
    assert " ".join(line.strip() for line in lines) == long
    assert site.adapted("![a](.github/pictures/b.png)") == "[![a](pictures/b.png)](pictures/b.png)"
