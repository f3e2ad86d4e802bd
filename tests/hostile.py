"""Disturb commands at random moments and judge what they leave: deaths, power loss, errors, swapped inputs, links.

    python tests/hostile.py FOLDER [--minutes 60] [--seed 1] [--trial N]

A trial runs a command in a child of this process. The child counts its calls to the system that concern files, by an
audit hook of Python, and disturbs itself at random ones. If it died, its files are damaged as by a power loss; then
the same command runs again. It is a finding if

- a command ends with status 0, and its results differ from those of an undisturbed run on the inputs that it names;
- what is the user's, or an earlier run that was not replaced, is nowhere any more;
- a command hangs, crashes, or says that something should not happen.

Findings are printed with the number of their trial, which repeats it: the same disturbances, at the same moments as
far as threads allow. Their folders are kept. The exit status is 1 if there are any.
"""

import argparse
import errno
import hashlib
import json
import os
import random
import re
import runpy
import shutil
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import rasterio

from sat_intervals.cli import main
from sat_intervals.demo import make_scene
from sat_intervals.run.output import OUTPUTS

CAMERAS = Path(__file__).parents[1] / "docs" / "pictures" / "demo_cameras.py"
# Calls that are counted, as Python names them.
OF_FILES = {f"os.{name}" for name in ("rename", "link", "symlink", "remove", "rmdir", "mkdir", "listdir", "scandir")}
OF_FILES |= {"open", "os.truncate", "fcntl.flock", "ctypes.dlsym"}  # renameat2 is called by ctypes
PATIENCE = 120.0  # seconds
DIED = 137
IMAGES, SENSORS = ("left", "right", "mask", "truth"), ("left_model", "right_model", "left_grid", "right_grid")
P1 = {"A": 8, "B": 9}  # settings in two versions
KINDS = [
    *("match", "match --keep-tiles", "match --store", "match --store --keep-tiles", "match --left-mask"),
    *("match --overwrite", "match --overwrite --keep-tiles", "match --overwrite --store"),
    *("surface", "surface --keep-tiles", "batch", "triangulate", "dsm", "stac", "report", "project", "plot"),
    *("export --to otb", "export --to asp", "export --to cars", "export --to s2p", "reference", "calibrate"),
]
RESULTS = {
    "match": ["out/intervals.tif", "out/validity.tif"],
    "surface": ["out/intervals.tif", "out/validity.tif", "out/points.tif", "out/dsm.tif"],
    "batch": ["out/one/intervals.tif", "out/one/validity.tif", "out/one/dsm.tif"],
    "triangulate": ["out/points.tif"],
    "dsm": ["out/dsm.tif"],
    "export --to otb": ["target/disparity.tif", "target/mask.tif"],
    "export --to asp": ["target/export-F.tif"],
    "export --to cars": ["target/epi_disp.tif", "target/epi_disp_interval_bounds_inf.tif", "target/epi_disp_mask.tif"],
    "export --to s2p": ["target/rectified_disp.tif", "target/rectified_disp_confidence.tif"],
    "reference": ["out/truth.tif"],
    "calibrate": ["target/levels.yaml"],
}
# Files of a finished run that are not there when a command begins.
BEFORE = {"triangulate": ["dsm.tif", "points.tif", "points.json"], "dsm": ["dsm.tif"]}
BEFORE |= {command: [] for command in ("export", "stac", "report", "project", "plot", "reference")}
DAMAGES = {
    "empty": lambda content, at: b"",
    "half": lambda content, at: content[: len(content) // 2],
    "page": lambda content, at: content[: len(content) // 4096 * 4096],
    "zeros": lambda content, at: bytes(len(content)),
    "tail": lambda content, at: content[:at] + bytes(len(content) - at),
    "bit": lambda content, at: content[:at] + bytes(byte ^ 1 for byte in content[at : at + 1]) + content[at + 1 :],
}
ERRORS = errno.EIO, errno.ENOSPC, errno.EACCES, errno.EMFILE, errno.ESTALE, errno.EDQUOT, errno.EROFS


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def snapshot(folder):
    """Digests of files and targets of links below a folder, by path."""
    found = {}
    for place, folders, files in os.walk(folder):
        for path in (Path(place, name) for name in (*files, *folders)):
            if path.is_symlink():
                found[path] = f"-> {os.readlink(path)}"
            elif path.is_file():
                found[path] = digest(path)
    return found


# ---- Commands in children --------------------------------------------------------------------------------------------
class Moments:
    """An audit hook that counts calls that concern a folder, and acts at some; raises the error that an action returns.

    Relative names are those of calls in open folders.
    """

    def __init__(self, top, actions):
        self.top, self.actions, self.count = str(top), dict(actions), 0
        self.lock, self.own = threading.Lock(), threading.local()

    def __call__(self, event, arguments):
        if event not in OF_FILES or getattr(self.own, "acts", False):
            return
        place = os.fsdecode(arguments[0]) if isinstance(arguments[0], (str, bytes, os.PathLike)) else ""
        is_inside = place.startswith((self.top, "/proc/self/fd/"))
        if not is_inside and (event == "open" or os.path.isabs(place)):
            return
        with self.lock:
            self.count += 1
            action = self.actions.pop(self.count, None)
        if action:
            self.own.acts = True
            try:
                error = action()
            finally:
                self.own.acts = False
            if error:
                raise OSError(error, os.strerror(error), place or None)


def forked(function, said=None):
    """Run a function in a child; return its process."""
    if child := os.fork():
        return psutil.Process(child)
    status = 1
    try:
        if said:
            for stream in (1, 2):
                os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        status = function() or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def run(top, command, actions=None, dies_after=None):
    """Run a command; return its status, None if it hung, what it said, and the number of its moments."""
    said, count = Path(f"{top}.said"), Path(f"{top}.count")
    for file in (said, count):
        file.unlink(missing_ok=True)

    def call():
        moments = Moments(top, actions or {})
        sys.addaudithook(moments)
        try:
            main.main(args=list(map(str, command)), prog_name="sat-intervals")
        except SystemExit as end:
            moments.own.acts = True
            count.write_text(str(moments.count))
            return end.code

    child = forked(call, said)
    try:
        status = child.wait(dies_after or PATIENCE)
    except psutil.TimeoutExpired:
        child.kill()
        child.wait()
        status = DIED if dies_after else None
    return status, said.read_text(errors="replace"), int(count.read_text()) if count.exists() else 0


def results_of(kind):
    return RESULTS.get(kind, RESULTS.get(kind.split()[0], []))


def pixels_of(top, kind):
    """Digests of a command's results, of rasters only the pixels.

    They are read in a child: this process must not have GDAL's threads.
    """
    target = Path(f"{top}.pixels")

    def read():
        warnings.simplefilter("ignore")
        found = {}
        for name in results_of(kind):
            if not name.endswith(".tif"):
                with suppress(OSError):
                    content = (top / name).read_bytes().replace(bytes(top), b"")  # it names the inputs
                    content = re.sub(rb"CRC-32 [0-9a-f]{8}", b"", content)  # that of the content with the names
                    found[name] = hashlib.sha256(content).hexdigest()
                continue
            with suppress(rasterio.errors.RasterioIOError), rasterio.open(top / name) as file:
                found[name] = hashlib.sha256(file.read().tobytes()).hexdigest()
        target.write_text(json.dumps(found))

    assert forked(read).wait() == 0
    return json.loads(target.read_text())


class Scenes:
    """Inputs in the versions A and B, finished runs, and what undisturbed commands write."""

    def __init__(self, folder):
        self.folder, self.known, self.moments = folder, {}, {}
        folder.mkdir(parents=True)
        assert forked(self._make).wait() == 0
        self.versions = {digest(self.input(name, version)): version for name in IMAGES for version in "AB"}
        for name, kind, versions in (
            ("finished", "surface", {}),
            ("foreign", "match --keep-tiles", {"right": "B"}),
            ("earlier", "match --keep-tiles", {"left": "B", "right": "B", "settings": "B"}),
        ):
            self.undisturbed(folder / name, kind, versions)  # its images must stay where they are
        assert forked(self._make_heights).wait() == 0

    def input(self, name, version):
        return self.folder / version / f"{name}.tif"

    def _make(self):
        warnings.simplefilter("ignore")  # grids and models have no transform
        for version, seed in (("A", 1), ("B", 2)):
            (self.folder / version).mkdir()
            scene, mask = make_scene(150, 170, seed=seed), np.zeros((150, 170), np.uint8)
            mask[20:50, 30 * seed : 30 * seed + 40] = 1
            for name, pixels in zip(IMAGES, (scene.left, scene.right, mask, scene.truth), strict=True):
                kind = {"height": 150, "width": 170, "count": 1, "dtype": pixels.dtype, "crs": "EPSG:32631"}
                kind["transform"] = rasterio.Affine(0.5, 0, 3e5, 0, -0.5, 48e5)
                with rasterio.open(self.input(name, version), "w", driver="GTiff", **kind) as file:  # of equal sizes
                    file.write(pixels, 1)
            sys.argv = ["demo_cameras.py", str(self.folder / version)]
            runpy.run_path(str(CAMERAS), run_name="__main__")
        for name, shift in zip(SENSORS, (1.5, -1.0, 1.5, -1.0), strict=True):
            with rasterio.open(self.input(name, "A")) as file:
                pixels, profile, rpcs = file.read(), file.profile, file.rpcs
            if rpcs:
                rpcs.samp_off += shift
                profile["rpcs"] = rpcs
            else:
                pixels[0] += shift
            self.input(name, "B").unlink()
            with rasterio.open(self.input(name, "B"), "w", **profile) as file:
                file.write(pixels)

    def _make_heights(self):
        with rasterio.open(self.folder / "finished" / "out" / "dsm.tif") as file:
            heights, profile = file.read(1), file.profile | {"count": 1}
        for version, factor in (("A", 1.0), ("B", 1.2)):
            with rasterio.open(self.input("heights", version), "w", **profile) as file:
                file.write(heights * factor, 1)

    def settings(self, version, overlap):
        sections = {"disparity": {"minimum": -12, "maximum": 14}, "cluster": {"workers": 1, "retries": 0}}
        sections |= {"tiles": {"size": 64, "overlap": overlap}, "sgm": {"p1": P1[version], "p2": 40}}
        return json.dumps(sections)

    def prepare(self, top, kind, versions, overlap):
        """Make the folder of a command; return its words."""
        shutil.rmtree(top, ignore_errors=True)
        (inputs := top / "inputs").mkdir(parents=True)
        (top / "target").mkdir()
        (inputs / "meta.json").write_text(json.dumps({"disparity": [-12, 14], "group": "demo"}))
        for name in (*IMAGES, *SENSORS, *(["heights"] if kind == "reference" else [])):
            shutil.copy(self.input(name, versions.get(name, "A")), inputs)
        (settings := inputs / "settings.yaml").write_text(self.settings(versions.get("settings", "A"), overlap))
        command, *options = kind.split()
        if command in BEFORE:
            shutil.copytree(self.folder / "finished" / "out", top / "out")
            for name in BEFORE[command]:
                (top / "out" / name).unlink()
        pair, out = [inputs / "left.tif", inputs / "right.tif"], top / "out"
        sensors = [word for name in SENSORS for word in (f"--{name.replace('_', '-')}", inputs / f"{name}.tif")]
        values = {"--store": [top / "store"], "--left-mask": [inputs / "mask.tif"]}
        end = ["--config", settings, "--quiet", *(word for name in options for word in (name, *values.get(name, [])))]
        if command == "batch":
            table = ["name,left,right," + ",".join(SENSORS) + ",resolution"]
            table.append(",".join(map(str, ["one", *pair, *(inputs / f"{name}.tif" for name in SENSORS), 1])))
            (top / "pairs.csv").write_text("\n".join(table) + "\n")
        return {
            "match": ["match", *pair, out, *end],
            "surface": ["surface", *pair, out, *end, *sensors, "--resolution", "1"],
            "batch": ["batch", top / "pairs.csv", out, *end],
            "triangulate": ["triangulate", out, *sensors],
            "dsm": ["dsm", out, "--resolution", "1"],
            "export": ["export", out, top / "target" / ("export" if "asp" in options else ""), *options],
            "reference": ["reference", out, *sensors, "--heights", inputs / "heights.tif", "--ellipsoid", "--quiet"],
            "calibrate": ["calibrate", inputs, "--output", top / "target" / "levels.yaml", *end],
            "plot": ["plot", out, "--truth", inputs / "truth.tif", "--row", "60"],
        }.get(command, [command, out])

    def undisturbed(self, top, kind, versions, overlap="exact"):
        """Run a command; return the number of its moments."""
        status, said, count = run(top, self.prepare(top, kind, versions, overlap))
        assert status == 0, said
        return count

    def expected(self, kind, versions, overlap):
        """What an undisturbed command writes, see `pixels_of`."""
        if kind.split()[0] == "match":
            kind = "match --left-mask" if "--left-mask" in kind else "match"
        key = kind, tuple(sorted(versions.items())), overlap
        if key not in self.known:
            self.undisturbed(self.folder / "clean", kind, versions, overlap)
            self.known[key] = pixels_of(self.folder / "clean", kind)
        return self.known[key]


class Trial:
    """A command in a folder of its own beside files of the user, and what disturbs it."""

    def __init__(self, scenes, top, number):
        self.scenes, self.top, self.random = scenes, top, random.Random(number)
        self.kind, self.overlap = self.random.choice(KINDS), self.random.choice([20, "exact"])
        if self.kind not in scenes.moments:
            without = self.kind.replace(" --overwrite", "")
            scenes.moments[self.kind] = scenes.undisturbed(scenes.folder / "clean", without, {}, self.overlap)
        self.command = scenes.prepare(top, self.kind, {}, self.overlap)
        self.out, self.store, self.target, self.mine = (top / name for name in ("out", "store", "target", "mine"))
        self.swapped, self.done = None, top.with_name(f"{top.name}.done")
        self.done.write_text("")
        (top / "aside").mkdir()
        if "--overwrite" in self.kind:
            shutil.copytree(scenes.folder / "earlier" / "out", self.out)
        self.old = [digest(self.out / name) for name in OUTPUTS if (self.out / name).exists()]
        for name in (*OUTPUTS, "points.tif", "manifest.json", "folder/records/0_0.json", "folder/dsm.tif"):
            (self.mine / name).parent.mkdir(parents=True, exist_ok=True)
            (self.mine / name).write_text(f"mine, {name}")
        shutil.copytree(scenes.folder / "foreign" / "out", self.mine / "run")
        if self.random.random() < 0.3:
            for folder in (self.out, self.out / "tiles", self.target):
                folder.mkdir(parents=True, exist_ok=True)
                (folder / "notes.txt").write_text(f"of the user, {folder}")
        self.users = snapshot(self.mine) | {p: c for p, c in snapshot(top).items() if p.name == "notes.txt"}

    # ---- Disturbances: they run in the child, and note what they did -------------------------------------------------
    def note(self, *words):
        with self.done.open("a") as done:
            done.write(" ".join(map(str, words)) + "\n")

    def noted(self, word):
        return [line.split()[1:] for line in self.done.read_text().splitlines() if line.split()[0] == word]

    def own_files(self):
        """Files of the command in its folders; not the results, which anybody may change when they are published."""
        users, results = set(self.users.values()), (self.out, self.out / "one", self.target)
        found = [item for top in (self.out, self.store, self.target) for item in snapshot(top).items()]
        return sorted(
            path for path, content in found if path.parent not in results and content not in users and content[0] != "-"
        )

    def places(self):
        """Files and folders of the command, but for temporary ones of random names: nobody puts anything there."""
        files = [path for path in self.own_files() if not path.relative_to(self.top).parts[1].startswith(".calibrate-")]
        tops = [folder for folder in (self.out, self.out / "tiles", self.store, self.target) if folder.is_dir()]
        return [*files, *tops, *sorted({path.parent for path in files})]

    def aside(self, path):
        if os.path.lexists(path):
            path.rename(self.top / "aside" / f"{path.name}-{time.monotonic_ns()}")

    def die(self):
        os._exit(DIED)

    def fail(self):
        """An error of the system, of the next call only."""
        error = self.random.choice(ERRORS)
        self.note("fail", errno.errorcode[error])
        return error

    def damage(self):
        """What a power loss does to a file that is not on the disk, or a disk that fails."""
        if files := self.own_files():
            file, how = self.random.choice(files), self.random.choice([*DAMAGES, "gone"])
            self.note("damage", how, file)
            content = file.read_bytes()
            file.unlink() if how == "gone" else file.write_bytes(
                DAMAGES[how](content, self.random.randrange(len(content) + 1))
            )

    def exchange_contents(self):
        """Two files, of one size where there are such, have each other's contents."""
        if len(files := self.own_files()) > 1:
            one = files.pop(self.random.randrange(len(files)))
            other = self.random.choice([f for f in files if f.stat().st_size == one.stat().st_size] or files)
            self.note("exchange_contents", one, other)
            first, second = one.read_bytes(), other.read_bytes()
            one.write_bytes(second)
            other.write_bytes(first)

    def swap(self, version, how):
        """An input is another from now on, with the times of before."""
        file = self.top / "inputs" / ("settings.yaml" if self.swapped == "settings" else f"{self.swapped}.tif")
        new = self.top / "aside" / f"{version}-{file.name}"
        if self.swapped == "settings":
            new.write_text(self.scenes.settings(version, self.overlap))
        else:
            shutil.copy(self.scenes.input(self.swapped, version), new)
        shutil.copystat(file, new)
        self.note("swap", self.swapped, version, how)
        if how == "rename":
            new.replace(file)
        elif how == "write":
            times = file.stat()
            file.write_bytes(new.read_bytes())
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
        elif how == "link":
            file.unlink()
            file.symlink_to(new)
        else:
            folder = shutil.copytree(file.parent, self.top / f"other-inputs-{version}")
            new.replace(folder / file.name)
            self.aside(file.parent)
            folder.rename(file.parent)

    def swap_run(self):
        """The run that a command reads, or one of its files, is another from now on."""
        name = self.random.choice([None, *OUTPUTS])
        self.note("swap_run", name)
        if name is None:
            self.aside(self.out)
            shutil.copytree(self.mine / "run", self.out)
        else:
            new = shutil.copy(self.mine / "run" / name, self.top / "aside" / "new")
            self.aside(self.out / name)
            Path(new).rename(self.out / name)

    def obstruct(self):
        """A link, a pipe or a folder of the user takes the place of something, or is there before it."""
        names = [*OUTPUTS, "tiles", "tiles/records/0_0.json", "tiles/.sat-intervals.lock", "points.json", "dsm.tif"]
        names += [".unpublished-intervals.tif", "stac.json", "report.html", "project.qgz", "width.vrt", "batch.json"]
        names += ["overview.png", "errors.png"]
        places = [self.out / self.random.choice(names), self.top / self.random.choice(results_of(self.kind) or names)]
        place = self.random.choice([*self.places(), *2 * places])
        links = {"file": self.mine / "points.tif", "folder": self.mine / "folder", "run": self.mine / "run"}
        links |= {"nothing": self.top / "nothing", "itself": place}
        how = self.random.choice([*links, "hard", "pipe", "of_the_user"])
        if place.parent.is_dir():
            self.aside(place)
            self.note("obstruct", how, place)
            if how in links:
                place.symlink_to(links[how])
            elif how == "hard":
                place.hardlink_to(self.mine / "manifest.json")
            elif how == "pipe":
                os.mkfifo(place)
            else:
                place.mkdir()
                (place / "file").write_text(f"of the user, {place}")
                self.users[place / "file"] = digest(place / "file")  # other disturbances leave it alone

    def exchange(self):
        """Another folder takes the place of one of the command's."""
        place = self.random.choice([*(path for path in self.places() if path.is_dir()), self.top / "inputs"])
        new = self.random.choice([self.mine / name for name in ("run", "run/tiles", "folder")])
        if new.is_dir() and place.is_dir():
            self.note("exchange", new, place)
            self.aside(place)
            new.rename(place)

    # ---- Course and judgement ----------------------------------------------------------------------------------------
    def disturbances(self):
        """Choose what happens, by moment."""
        most = self.scenes.moments[self.kind]
        moments = [self.random.randint(1, most) for _ in range(3)]
        match theme := self.random.choice(["death", "death", "swap", "swap", "errors", "links", "all"]):
            case "death":
                return theme, {moments[0]: self.die}
            case "errors":
                return theme, dict.fromkeys(moments[: self.random.choice([1, 1, 3])], self.fail)
            case "links":
                return theme, {moment: self.random.choice([self.obstruct, self.exchange]) for moment in moments[:2]}
            case "all":
                ways = self.obstruct, self.exchange, self.damage, self.exchange_contents, self.fail, self.die
                return theme, {moment: self.random.choice(ways) for moment in moments}
        kind = self.kind.split()[0]
        names = ["left", "right", "settings"] if kind in ("match", "surface", "batch", "calibrate") else []
        names += SENSORS if kind in ("surface", "batch", "triangulate", "reference") else []
        names += {"calibrate": ["truth", "truth"], "reference": ["heights", "heights"]}.get(kind, [])
        names += ["mask", "mask"] if "--left-mask" in self.kind else []
        if not names:
            return theme, {moments[0]: self.swap_run}
        self.swapped, how = self.random.choice(names), self.random.choice(["rename", "write", "link", "folder"])
        chosen = {moments[0]: lambda: self.swap("B", how)}
        if self.random.random() < 0.4:
            chosen[moments[0] + self.random.randint(1, 1 + most // 4)] = lambda: self.swap("A", how)
        if self.random.random() < 0.3:
            chosen[moments[0] + self.random.randint(1, 1 + most // 2)] = self.die
        return theme, chosen

    def go(self):
        """Disturb and repeat the command; return the theme, the statuses, and what was found."""
        theme, actions = self.disturbances()
        dies_after = 2 * self.random.random() if theme == "death" and self.random.random() < 0.2 else None
        statuses, finding, command = [], None, self.command
        while not finding and len(statuses) < 4:
            status, said, _ = run(self.top, command, actions, dies_after)
            statuses.append(status)
            finding = self.judged(status, said)
            if status == 0 or self.is_another_run or (status != DIED and len(statuses) > 1):
                break
            actions, dies_after = {}, None
            if status == DIED and theme == "death":
                for _ in range(self.random.randint(0, 3)):
                    self.random.choice([self.damage, self.damage, self.exchange_contents])()
                if self.random.random() < 0.2:
                    actions = {self.random.randint(1, self.scenes.moments[self.kind]): self.die}
        return theme, tuple(statuses), finding

    def judged(self, status, said):
        """What is wrong, or None."""
        if status is None:
            return "hangs"
        if status not in (0, 1, 2, DIED) or "Traceback" in said or "should not happen" in said:
            return f"status {status}: {said}"
        there = Counter(snapshot(self.top).values())
        for how, place in self.noted("obstruct"):
            if how == "of_the_user":
                self.users[Path(place, "file")] = hashlib.sha256(f"of the user, {place}".encode()).hexdigest()
        if lost := [str(path) for path, content in self.users.items() if not there[content]]:
            return f"lost, status {status}: {lost}"
        is_lost = any(not there[content] for content in self.old)
        if is_lost and status not in (0, DIED) and not self.is_right():
            return f"the earlier run is lost, status {status}"
        results = {str(self.top / name) for name in results_of(self.kind)}
        is_changed = any(place in results for _, place in self.noted("obstruct"))
        if status == 0 and not is_changed and not self.is_another_run and not self.is_right():
            return f"wrong results: {said}"
        return None

    @property
    def is_another_run(self):
        """Whether the folder of the command may be another one now."""
        at_out = [place for _, place in self.noted("obstruct") if place in (str(self.out), str(self.target))]
        return bool(at_out or self.noted("exchange") or self.noted("swap_run"))

    def is_right(self):
        """Whether the results are those of the inputs that the run names."""
        found = pixels_of(self.top, self.kind)
        versions = [{}, *([{self.swapped: "B"}] if self.swapped else [])]
        if self.kind.split()[0] in ("match", "surface"):
            versions = [candidate for candidate in versions if self.is_named(candidate)]
        return any(found == self.scenes.expected(self.kind, candidate, self.overlap) for candidate in versions)

    def is_named(self, versions):
        """Whether the report of the run names these versions of its inputs and settings."""
        with suppress(OSError, ValueError, LookupError, TypeError):
            report = json.loads((self.out / "run.json").read_text())
            files = {name: report["inputs"][name] for name in ("left", "right")}
            files |= {"mask": mask} if (mask := files["left"]["mask"]) else {}
            named = {name: self.scenes.versions.get(file["sha256"]) for name, file in files.items()}
            p1 = P1[versions.get("settings", "A")]
            return report["settings"]["sgm"]["p1"] == p1 and all(named[n] == versions.get(n, "A") for n in named)
        return False


def hostile(folder, minutes, seed, trial):
    """Run trials; return the number of findings."""
    scenes, counts, findings = Scenes(folder / "scenes"), Counter(), 0
    end = time.monotonic() + 60 * minutes
    for number in [trial] if trial else range(1_000_000 * seed, 1_000_000 * (seed + 1)):
        if time.monotonic() > end:
            break
        tried = Trial(scenes, folder / "trial", number)
        theme, statuses, finding = tried.go()
        counts[theme, tried.kind.split()[0], statuses] += 1
        if finding or trial:
            print(
                f"trial {number}: {tried.kind}, {theme}, {statuses}: {finding}",
                tried.done.read_text(),
                sep="\n",
                flush=True,
            )
        if finding:
            findings += 1
            with suppress(OSError):
                tried.top.rename(folder / f"trial-{number}")
    for case, count in sorted(counts.items(), key=str):
        print(f"{count:5} {case}")
    print(f"{counts.total()} trials, {findings} findings")
    return findings


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="A new folder.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trial", type=int, help="Number of a trial to repeat.")
    given = parser.parse_args()
    sys.exit(bool(hostile(given.folder.absolute(), given.minutes, given.seed, given.trial)))
