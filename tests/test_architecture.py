"""Rules of the architecture: which folder imports which, where each library is imported, how large functions are."""

import ast
import importlib.util
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]

# Top to bottom. A room is a folder or a module in `sat_intervals/`; it imports only rooms of lower floors.
FLOORS = [
    {"cli"},
    {"show", "workflows"},
    {"evaluate"},
    {"heights", "run", "interop"},
    {"results", "prepare"},
    {"match", "raster"},
    {"kernels", "config", "store"},
    {"products", "tiling", "machine", "progress", "demo", "errors", "configs"},
]
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
MOST_ENTRIES, MOST_ARROWS = 20, 107

# The only room that may import a library.
HOMES = {
    "cars": "interop",
    "click": "cli",
    "dask": "run",
    "dask_jobqueue": "run",
    "distributed": "run",
    "fsspec": "store",
    "llvmlite": "kernels",
    "matplotlib": "show",
    "laspy": "heights",
    "numba": "kernels",
    "onnxruntime": "match",
    "pyarrow": "heights",
    "pyogrio": "heights",
    "pyproj": "raster",
    "rasterio": "raster",
    "rich": "cli",
    "scipy": "heights",
    "shapely": "heights",
    "shareloc": "heights",
}

# Without docstrings. Callbacks of click commands are exempt from the limit of parameters: they have one per option.
MOST_FUNCTION_LINES, MOST_MODULE_LINES, MOST_PARAMETERS = 45, 300, 8
OVER_THE_LIMITS = {
    "sat_intervals.demo": "one generator of scenes, for pairs and for many views",
    "sat_intervals.demo.make_scene": "what a scene is made of, by name",
    "sat_intervals.demo.make_views": "what views of a scene are made of, by name",
    "sat_intervals.interop.cars_method.run": "its parameters are those of CARS' method",
    "sat_intervals.kernels.plane_sweep.sweep": "the arrays of a kernel",
    "sat_intervals.run.pair.match_pair": "what a run takes, with a matcher of one's own",
    "sat_intervals.workflows.calibrate.calibrate": "how pairs are matched and compared with their truth, by name",
    "sat_intervals.workflows.change.change": "what is compared and at which rate, by name",
    "sat_intervals.workflows.dsm.make_surface": "what a surface of runs takes, by name",
    "sat_intervals.workflows.rectify.rectify": "what raw images need, by name",
    "sat_intervals.workflows.surface.surface": "what the steps of both ways take, by name",
}

# Test files without a module of their name: they test several modules together.
LAWS = {
    "./architecture", "./documents", "./package", "./release", "cli/commands", "cli/coverage", "cli/messages",
    "interop/otb", "match/accuracy", "match/pandora", "raster/raster", "run/damage", "run/kept_files",
    "run/row_warnings", "run/survival", "run/waits", "show/pictures",
}  # fmt: skip

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
FOLDERS = {"sat_intervals": ROOT / "sat_intervals"} | {
    package: ROOT / folder for package, folder in PYPROJECT["tool"]["setuptools"]["package-dir"].items()
}


def modules() -> dict[str, Path]:
    """The file of every module: ``sat_intervals.cli.app`` is ``cli/app.py``."""
    return {
        ".".join([package, *file.relative_to(folder).with_suffix("").parts]): file
        for package, folder in FOLDERS.items()
        for file in sorted(folder.rglob("*.py"))
    }


@cache
def nodes() -> dict[str, list[ast.AST]]:
    """All nodes of every module, itself first."""
    return {module: list(ast.walk(ast.parse(file.read_text()))) for module, file in modules().items()}


def imports() -> Iterator[tuple[str, str]]:
    """Every module with every full name that it imports, anywhere in it."""
    for module, inside in nodes().items():
        for node in inside:
            if isinstance(node, ast.Import):
                yield from ((module, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                relative = "." * node.level + (node.module or "")
                base = importlib.util.resolve_name(relative, module.rpartition(".")[0])
                yield from ((module, f"{base}.{alias.name}") for alias in node.names)


def room(name: str) -> str:
    """``store`` of ``sat_intervals.store.tiles``."""
    return name.split(".")[1] if "." in name else ""


def test_floors__a_room_imports_only_lower_floors() -> None:
    arrows = {
        (room(module), room(name))
        for module, name in imports()
        if name.startswith("sat_intervals") and module != "sat_intervals.__init__" and room(module) != room(name)
    }
    print(f"{len(arrows)} arrows between rooms")
    assert sorted((a, b) for a, b in arrows if FLOOR_OF.get(a, 99) >= FLOOR_OF.get(b, -1)) == []
    assert len(arrows) <= MOST_ARROWS
    entries = {entry.name for entry in FOLDERS["sat_intervals"].iterdir() if entry.name != "__pycache__"}
    assert {Path(entry).stem for entry in entries} - {"__init__"} == set(FLOOR_OF) - {"cli", "configs"}
    assert len(entries) <= MOST_ENTRIES


def test_homes__a_library_is_imported_in_its_home_only() -> None:
    libraries = {(room(module), name.partition(".")[0]) for module, name in imports()}
    assert sorted((a, library) for a, library in libraries if HOMES.get(library, a) != a) == []


def test_homes__records_are_written_in_one_place() -> None:
    """Elsewhere numbers of NumPy would end a command after all its work."""
    dumping = {module for module, file in modules().items() if "json.dumps(" in file.read_text()}
    ours = {name.removeprefix("sat_intervals.") for name in dumping}
    assert ours == {
        "products",
        "store.manifest",
        "heights.point_files",
        "config.calibration",
        "config.sections",
        "config.wording",
        "show.report.page",
    }


def test_limits__functions_parameters_and_modules_stay_small() -> None:
    over = {}
    for module, file in modules().items():
        documented = {line for node in nodes()[module] for line in docstring_lines(node)}
        if (lines := len(file.read_text().splitlines()) - len(documented)) > MOST_MODULE_LINES:
            over[module] = f"{lines} lines"
        for node in nodes()[module]:
            if isinstance(node, ast.FunctionDef):
                lines = len(set(range(node.lineno, node.end_lineno + 1)) - documented)
                given = node.args
                parameters = [*given.posonlyargs, *given.args, given.vararg, *given.kwonlyargs, given.kwarg]
                count = 0 if is_callback(node) else len([*filter(None, parameters)])
                if lines > MOST_FUNCTION_LINES or count > MOST_PARAMETERS:
                    over[f"{module}.{node.name}"] = f"{lines} lines, {count} parameters"
    assert {name: over.get(name) for name in over.keys() ^ OVER_THE_LIMITS.keys()} == {}


def docstring_lines(node: ast.AST) -> range:
    has_one = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node)
    return range(node.body[0].lineno, node.body[0].end_lineno + 1) if has_one else range(0)


def is_callback(node: ast.FunctionDef) -> bool:
    return any(ast.unparse(decorator).startswith("click.command(") for decorator in node.decorator_list)


def test_tests__mirror_the_package() -> None:
    folders = {"cli": ROOT / "cli"}
    for file in (ROOT / "tests").rglob("test_*.py"):
        room = file.parent.relative_to(ROOT / "tests").as_posix()
        tested = folders.get(room, ROOT / "sat_intervals" / room)
        name = file.stem.removeprefix("test_")
        assert tested.is_dir(), file
        assert (tested / name).is_dir() or (tested / f"{name}.py").exists() or f"{room}/{name}" in LAWS, file
