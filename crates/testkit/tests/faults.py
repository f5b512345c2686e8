#!/usr/bin/env python3
"""Kills, races, full and read-only disks, and power failures: what is lost?

    python3 crates/testkit/tests/faults.py BINARIES [--kills N] [--races N] [--only NAME]

Every stage is run in a directory that holds its result for one setting (the old one), with another
setting (the new one), and is disturbed:

* killed at every system call that changes the disk (by strace, in every thread), and at random moments;
* beside a second run with the old setting and the same output;
* on a disk that is full after some kilobytes, and on one that cannot be written;
* killed in the same way on a file system of its own, of whose image a copy is taken at that moment: what
  a power failure leaves. The copy is mounted, and its file system recovers from its journal.

Whatever happens, the directory must hold the old result or the new one, byte for byte. Where a stage has several
outputs, some may be missing after a kill, but no old one may stand beside a new one. A stage that reads them changes
nothing. The next run must end well, make the result whole, and leave nothing temporary. Every violation is printed; the
exit code is 1 when there is one.

Needs Linux, Python 3 and strace; the power failures need root and a loop device, and are skipped with a
message without them.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]

# System calls that change what a disk holds, or promise that it does.
CALLS = ["mkdir", "write", "pwrite64", "ftruncate", "fdatasync", "fsync", "renameat2", "rename", "unlink", "rmdir"]

# Kills at one kind of call, in one stage: the calls after these are repetitions of the same kind.
MOST_KILLS_PER_CALL = 12

# Corners of the coupon on a machine, turned by a hundredth of a degree.
FIDUCIALS = """map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm
0,0,100,50,0.005
20,0,120,50.0035,0.005
20,12,119.998,62.0035,0.005
0,12,99.998,62,0.005
"""

RECIPE = (ROOT / "fixtures/coupon.json").read_text()
MACHINE = (ROOT / "fixtures/machines/ion-beam.json").read_text()


class Stage:
    """A stage with two settings, and what a reader of its output looks at."""

    def __init__(self, name, old, new, reader=None):
        self.name, self.commands, self.reader = name, [old.split(), new.split()], reader.split() if reader else None


# Every path is relative to a directory that holds `in` (read-only inputs) and `out`.
PLAN = "--tool-path in/path --dwell in/dwell --machine in/machine.json"
MAPS = "--surface in/surface --tif in/tif"
LEARNT = "--out out/a --corrected-tif out/tif --corrected-transform out/place --learnt-error-budget out/error_budget.json --force"
DECIDED = "--surface in/surface --trajectory in/trajectory --tolerance in/tolerance"
STAGES = [
    Stage("fixture", "planish-fixture in/recipe.json --out out --force", "planish-fixture in/other.json --out out --force",
          "planish-toolpath raster --surface out/surface --tif out/tif --pitch-mm 2 --step-mm 2 --out read --force"),
    Stage("import", "planish-import surface in/map.csv --unit nm --pixel-mm 0.25 --out out/a --picture out/a.svg --force",
          "planish-import surface in/map.csv --unit um --pixel-mm 0.25 --out out/a --picture out/a.svg --force",
          "planish-surface prepare --surface out/a --out read --force"),
    Stage("surface", "planish-surface prepare --surface in/surface --level piston --out out/a --force",
          "planish-surface prepare --surface in/surface --level plane --out out/a --force"),
    Stage("surface-psd", "planish-surface psd --surface in/surface --out out/a --force",
          "planish-surface psd --surface in/surface --detrend mean --out out/a --force"),
    Stage("surface-draw", "planish-surface draw --surface in/surface --out out/a.svg --force",
          "planish-surface draw --surface in/surface --section-y-mm 3 --out out/a.svg --force"),
    Stage("toolpath", f"planish-toolpath raster {MAPS} --pitch-mm 2 --step-mm 2 --out out/a --force",
          f"planish-toolpath raster {MAPS} --pitch-mm 1 --step-mm 2 --out out/a --force"),
    Stage("toolpath-draw", "planish-toolpath draw --tool-path in/path --out out/a.svg --force",
          "planish-toolpath draw --tool-path in/path --surface in/surface --out out/a.svg --force"),
    Stage("dwell", f"planish-dwell bounded-least-squares {MAPS} --tool-path in/path --min-dwell-s 0.1 --out out/a --force",
          f"planish-dwell bounded-least-squares {MAPS} --tool-path in/path --min-dwell-s 0.2 --out out/a --force"),
    Stage("schedule", f"planish-schedule trig-spline {PLAN} --dwell-density-out out/dwell_density --out out/a --force",
          f"planish-schedule trig-spline --repair local {PLAN} --dwell-density-out out/dwell_density --out out/a --force",
          "planish-schedule program --dwell-density out/dwell_density --out read.nc --force"),
    Stage("interpolate", "planish-schedule interpolate --dwell-density in/dwell_density --cycle-s 0.1 --out out/a.npy --force",
          "planish-schedule interpolate --dwell-density in/dwell_density --cycle-s 0.2 --out out/a.npy --force"),
    Stage("bspline-feed", f"planish-bspline-feed {MAPS} --tool-path in/path --machine in/machine.json --feed-source vrr --out out --force",
          f"planish-bspline-feed {MAPS} --tool-path in/path --machine in/machine.json --out out --force",
          "planish-schedule program --dwell-density out/dwell_density --out read.nc --force"),
    Stage("simulate", "planish-simulate --trajectory in/trajectory --tif in/tif --surface in/surface --out out/a --force",
          "planish-simulate --trajectory in/trajectory --tif in/tif --surface in/surface --integral direct --steps 2 --out out/a --force"),
    Stage("verify", "planish-verify --trajectory in/trajectory --machine in/machine.json --out out/a --force",
          "planish-verify --trajectory in/trajectory --machine in/slow.json --other-machine --out out/a --force"),
    Stage("refine", f"planish-refine {MAPS} --tool-path in/path --machine in/machine.json --max-rounds 1 --out out --force",
          f"planish-refine {MAPS} --tool-path in/path --machine in/machine.json --max-rounds 2 --out out --force",
          "planish-verify --trajectory out/trajectory --machine in/machine.json --out read --force"),
    Stage("joint", f"planish-joint {MAPS} --tool-path in/path --machine in/machine.json --max-iterations 2 --out out --force",
          f"planish-joint {MAPS} --tool-path in/path --machine in/machine.json --max-iterations 3 --out out --force",
          "planish-verify --trajectory out/trajectory --machine in/machine.json --out read --force"),
    Stage("tolerance", "planish-tolerance --trajectory in/trajectory --tif in/tif --surface in/surface --error-budget in/error_budget.json --simulated-runs 1 --out out/a --force",
          "planish-tolerance --trajectory in/trajectory --tif in/tif --surface in/surface --error-budget in/error_budget.json --simulated-runs 2 --out out/a --force"),
    Stage("register", "planish-register fit in/fiducials.csv --out out/a --force",
          "planish-register fit in/fiducials.csv --model affine --out out/a --force",
          "planish-register apply --transform out/a --trajectory in/trajectory --out read --force"),
    Stage("reconcile", f"planish-reconcile --before in/surface --after in/after --trajectory in/trajectory --tif in/tif {LEARNT}",
          f"planish-reconcile --before in/surface --after in/after --trajectory in/trajectory --tif in/tif --hold rotation {LEARNT}",
          "planish-register apply --transform out/place --trajectory in/trajectory --out read --force"),
    Stage("decide", f"planish-campaign decide {DECIDED} --out out/a --force",
          f"planish-campaign decide {DECIDED} --least-gain-percent 10 --out out/a --force"),
    Stage("export", "planish-export gcode --trajectory in/trajectory --machine in/machine.json --out out/p.ngc --force",
          "planish-export gcode --trajectory in/trajectory --machine in/machine.json --count-mm 0.001 --out out/p.ngc --force",
          "planish-import program out/p.ngc --controller gcode --about out/p.ngc.json --out read --force"),
    Stage("compare", "planish-compare report in/run --out out/a --force", "planish-compare report in/run --mirror coupon --out out/a --force"),
]

# What makes the inputs above.
PREPARATION = """
planish-fixture in/recipe.json --out in/fixture
planish-surface prepare --surface in/fixture/surface --level piston --out in/surface
planish-toolpath raster --surface in/surface --tif in/fixture/tif --pitch-mm 2 --step-mm 1 --out in/path
planish-dwell bounded-least-squares --surface in/surface --tif in/fixture/tif --tool-path in/path --out in/dwell
planish-schedule pvt --tool-path in/path --dwell in/dwell --machine in/machine.json --out in/trajectory
planish-schedule trig-spline --tool-path in/path --dwell in/dwell --machine in/machine.json --dwell-density-out in/dwell_density --out in/spline
planish-simulate --trajectory in/trajectory --tif in/fixture/tif --surface in/surface --out in/removal
planish-verify --trajectory in/trajectory --machine in/machine.json --out in/verdict
planish-simulate --trajectory in/trajectory --tif in/fixture/tif --surface in/surface --error-budget in/error_budget.json --measured-out in/after --out in/truth
planish-tolerance --trajectory in/trajectory --tif in/fixture/tif --surface in/surface --error-budget in/error_budget.json --draws 1000 --simulated-runs 0 --out in/tolerance
"""


def tree(directory):
    """Every file below `directory` with its bytes; temporary ones left out."""
    files = {}
    for path in sorted(directory.rglob("*")):
        if path.is_file() and not any(part.startswith(".planish-") for part in path.relative_to(directory).parts):
            files[str(path.relative_to(directory))] = path.read_bytes()
    return files


def places(*trees):
    """Outputs in these trees, each with its files: an artifact has a manifest, and other files stand alone."""
    found = {}
    for name in {name for tree in trees for name in tree}:
        parent = name.rpartition("/")[0]
        is_artifact = any(f"{parent}/manifest.json" in tree for tree in trees)
        found.setdefault(parent if is_artifact else name, set()).add(name)
    return found


def is_whole_or_lacks(found, whole, every):
    """Whether the files are those of one run, perhaps without some of its outputs."""
    if any(found[name] != whole.get(name) for name in found):
        return False
    return all(not names & found.keys() or names & found.keys() == names & whole.keys() for names in every.values())


def temporaries(directory):
    return [str(p.relative_to(directory)) for p in directory.rglob(".planish-*")]


class Faults:
    def __init__(self, binaries, work):
        self.binaries, self.work = binaries, work
        self.violations, self.counts = [], {}
        self.environment = {**os.environ, "PATH": f"{binaries}:{os.environ['PATH']}", "RAYON_NUM_THREADS": "2"}

    def run(self, command, where, prefix=(), **options):
        return subprocess.run([*prefix, *command], cwd=where, env=self.environment, stdout=subprocess.DEVNULL,
                              stderr=subprocess.PIPE, text=True, errors="replace", **options)

    def good(self, command, where):
        result = self.run(command, where)
        if result.returncode not in (0, 1):
            sys.exit(f"{' '.join(command)}: exit {result.returncode}: {result.stderr}")

    def prepare(self, stages):
        """Inputs, and the old and new result of every stage."""
        base = self.work / "base"
        inputs = base / "in"
        inputs.mkdir(parents=True)
        small = RECIPE.replace('"pixels": [81, 49]', '"pixels": [41, 25]')
        (inputs / "recipe.json").write_text(small)
        (inputs / "other.json").write_text(small.replace('"seed": 2012', '"seed": 2013'))
        (inputs / "machine.json").write_text(MACHINE)
        (inputs / "error_budget.json").write_text((ROOT / "fixtures/error-budgets/ion-beam.json").read_text())
        (inputs / "fiducials.csv").write_text(FIDUCIALS)
        (inputs / "slow.json").write_text((ROOT / "fixtures/machines/ion-beam-slow.json").read_text())
        generator = random.Random(1)
        rows = [",".join(f"{generator.gauss(0, 5):.3f}" for _ in range(20)) for _ in range(15)]
        (inputs / "map.csv").write_text("\n".join(rows) + "\n")
        for line in PREPARATION.strip().splitlines():
            self.good(line.split(), base)
        shutil.copytree(inputs / "fixture/tif", inputs / "tif")
        for part in ["trajectory", "removal", "verdict"]:
            shutil.copytree(inputs / part, inputs / "run/methods/pvt" / part)
        for part in ["surface", "dwell"]:
            shutil.copytree(inputs / part, inputs / "run" / part)
        shutil.copytree(inputs / "path", inputs / "run/tool_path")
        self.base = base
        self.results = {}
        for stage in stages:
            trees = []
            for number, command in enumerate(stage.commands):
                where = self.work / "golden" / stage.name / str(number)
                self.fresh(where)
                self.good(command, where)
                trees.append(tree(where / "out"))
            if trees[0] == trees[1]:
                sys.exit(f"{stage.name}: both settings give the same bytes; give two that differ")
            self.results[stage.name] = trees

    def fresh(self, where, old=None):
        """An empty place with the inputs, and the old result of `old`."""
        if where.exists():
            shutil.rmtree(where)
        where.mkdir(parents=True)
        os.symlink(self.base / "in", where / "in")
        if old:
            shutil.copytree(self.work / "golden" / old.name / "0" / "out", where / "out")

    def count(self, kind, stage, outcome):
        row = self.counts.setdefault((kind, stage.name), {})
        row[outcome] = row.get(outcome, 0) + 1

    def violation(self, kind, stage, what):
        self.count(kind, stage, "LOST")
        self.violations.append(f"{kind} {stage.name}: {what}")
        print(f"VIOLATION {self.violations[-1]}", flush=True)

    def judge(self, kind, stage, where, what, again=True):
        """Old or new, perhaps without some of several outputs; a reader changes nothing, and the next run ends well."""
        old, new = self.results[stage.name]
        every = places(old, new)
        found, hidden = tree(where / "out"), sorted(temporaries(where / "out"))
        if stage.reader:
            self.run(stage.reader, where)
            if (found, hidden) != (tree(where / "out"), sorted(temporaries(where / "out"))):
                self.violation(kind, stage, f"{what}: {stage.reader[0]} changed what it read")
        of_one_run = [is_whole_or_lacks(found, whole, every) for whole in (old, new)]
        if found not in (old, new) and not (len(every) > 1 and any(of_one_run)):
            parts = {name: "old" if data == old.get(name) else "new" if data == new.get(name) else f"{len(data)} bytes"
                     for name, data in found.items()}
            self.violation(kind, stage, f"{what}: neither old nor new: {parts}")
            return
        self.count(kind, stage, "old" if found == old else "new" if found == new else "part")
        if not again:
            return
        result = self.run(stage.commands[1], where)
        if result.returncode not in (0, 1) or tree(where / "out") != new:
            self.violation(kind, stage, f"{what}: the next run ended with {result.returncode}: {result.stderr.strip()}")
        elif temporaries(where):
            self.violation(kind, stage, f"{what}: left {temporaries(where)}")

    def killed_at(self, stage, call, number, where):
        """Runs the new setting and kills it at this call; whether it was reached."""
        prefix = ["strace", "-f", "-qq", "-o", "/dev/null", "-e", f"trace={call}",
                  "-e", f"inject={call}:signal=KILL:when={number}"]
        return self.run(stage.commands[1], where, prefix=prefix).returncode not in (0, 1, 2)

    def kills(self, stage, most):
        """At every call that changes the disk, then at random moments."""
        where, done = self.work / "kills", 0
        for call in CALLS:
            for number in range(1, MOST_KILLS_PER_CALL + 1):
                if done >= most:
                    return
                self.fresh(where, stage)
                if not self.killed_at(stage, call, number, where):
                    break
                self.judge("kill", stage, where, f"killed at {call} {number}")
                done += 1
        generator = random.Random(stage.name)
        while done < most:
            self.fresh(where, stage)
            process = subprocess.Popen(stage.commands[1], cwd=where, env=self.environment,
                                       stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            pause = generator.uniform(0, 0.06)
            try:
                process.wait(pause)
            except subprocess.TimeoutExpired:
                sent = generator.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
                process.send_signal(sent)
                process.wait()
                if sent != signal.SIGKILL and temporaries(where):
                    self.violation("kill", stage, f"{sent.name} after {pause:.4f} s left {temporaries(where)}")
            self.judge("kill", stage, where, f"killed after {pause:.4f} s")
            done += 1

    def races(self, stage, rounds):
        """Both settings at once, into the same output; every other round with nothing there before."""
        where = self.work / "races"
        old, new = self.results[stage.name]
        for number in range(rounds):
            self.fresh(where, stage if number % 2 else None)
            processes = [subprocess.Popen(command, cwd=where, env=self.environment, stdout=subprocess.DEVNULL,
                                          stderr=subprocess.PIPE, text=True) for command in stage.commands]
            ends = [(process.communicate()[1], process.returncode) for process in processes]
            found = tree(where / "out")
            bad = [(text.strip(), code) for text, code in ends if code not in (0, 1)]
            if bad:
                self.violation("race", stage, f"a run ended with {bad}")
            elif found not in (old, new):
                self.violation("race", stage, f"a mixture: {sorted(found)}")
            elif temporaries(where):
                self.violation("race", stage, f"left {temporaries(where)}")
            else:
                self.count("race", stage, "old" if found == old else "new")

    def image(self, mebibytes):
        """A file system of its own in a file; None where that cannot be had."""
        image, mount = self.work / "disk.img", self.work / "disk"
        mount.mkdir(exist_ok=True)
        with open(image, "wb") as file:
            file.truncate(mebibytes << 20)
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        # commit: no periodic writing in the background; what is on the disk is what was asked for.
        for command in (["mkfs.ext4", "-q", "-F", "-m", "0", image], ["mount", "-o", "loop,commit=600", image, mount]):
            try:
                result = subprocess.run(command, **quiet)
            except FileNotFoundError as error:
                result = subprocess.CompletedProcess(command, 1, stderr=str(error))
            if result.returncode:
                print(f"skipped: no file system in an image here ({result.stderr.strip()})")
                return None
        return image, mount

    def on_disk(self, mount, stage):
        """The old result of `stage` on the mounted disk, safely there."""
        where = mount / "place"
        self.fresh(where, stage)
        subprocess.run(["sync", "-f", mount], check=True)
        return where

    def power_failures(self, stage):
        """A copy of the image at the end of a run, and after kills at the calls that write."""
        made = self.image(32)
        if not made:
            return False
        image, mount = made
        copy, second = self.work / "copy.img", self.work / "copy"
        second.mkdir(exist_ok=True)
        try:
            for call, number in [(None, 0)] + [(call, n) for call in CALLS for n in (1, 2, 4)]:
                where = self.on_disk(mount, stage)
                if call is None:
                    self.good(stage.commands[1], where)
                elif not self.killed_at(stage, call, number, where):
                    continue
                shutil.copyfile(image, copy)
                subprocess.run(["mount", "-o", "loop", copy, second], check=True)
                try:
                    what = f"power failure at {call} {number}" if call else "power failure after the end"
                    if call is None and tree(second / "place" / "out") != self.results[stage.name][1]:
                        lost = {n: len(d) for n, d in tree(second / "place" / "out").items()}
                        self.violation("power", stage, f"{what}: not the new result: {lost}")
                    else:
                        self.judge("power", stage, second / "place", what)
                finally:
                    subprocess.run(["umount", second], check=True)
        finally:
            subprocess.run(["umount", mount], check=True)
        return True

    def full_and_read_only(self, stage):
        """A disk without room, and one that cannot be written: exit 2 with a message, nothing lost."""
        made = self.image(8)
        if not made:
            return False
        image, mount = made
        try:
            where = self.on_disk(mount, stage)
            for kind in ("full", "read-only"):
                filler = mount / "filler"
                if kind == "full":
                    with open(filler, "wb", buffering=0) as file:
                        for size in (1 << 20, 1 << 12):
                            try:
                                while file.write(b"x" * size):
                                    pass
                            except OSError:
                                pass  # no room for one more of this size
                    subprocess.run(["sync", "-f", mount], check=True)
                else:
                    filler.unlink()
                    subprocess.run(["mount", "-o", "remount,ro", mount], check=True)
                result = self.run(stage.commands[1], where)
                if result.returncode != 2 or "error:" not in result.stderr:
                    self.violation(kind, stage, f"ended with {result.returncode}: {result.stderr.strip()}")
                elif temporaries(where):
                    self.violation(kind, stage, f"left {temporaries(where)}")
                else:
                    old = self.results[stage.name][0]
                    if tree(where / "out") != old:
                        self.violation(kind, stage, "the old result is not whole")
                    else:
                        self.count(kind, stage, "old")
        finally:
            subprocess.run(["umount", mount], check=True)
        return True

    def table(self):
        print(f"\n{'disturbance':12} {'stage':14} {'old':>5} {'new':>5} {'part':>5} {'lost':>5}")
        totals = {}
        for (kind, name), row in self.counts.items():
            numbers = [row.get(key, 0) for key in ("old", "new", "part", "LOST")]
            totals[kind] = [a + b for a, b in zip(totals.get(kind, [0] * len(numbers)), numbers)]
            print(f"{kind:12} {name:14} " + " ".join(f"{number:5}" for number in numbers))
        for kind, numbers in totals.items():
            print(f"{kind:12} {'all':14} " + " ".join(f"{number:5}" for number in numbers))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binaries", type=Path)
    parser.add_argument("--kills", type=int, default=1000, help="in all")
    parser.add_argument("--races", type=int, default=200, help="in all")
    parser.add_argument("--only", help="one stage")
    arguments = parser.parse_args()
    if not shutil.which("strace"):
        sys.exit("strace is missing; install it")
    stages = [s for s in STAGES if arguments.only in (None, s.name)]
    with tempfile.TemporaryDirectory(prefix="planish-faults-") as work:
        faults = Faults(arguments.binaries.resolve(), Path(work))
        faults.prepare(stages)
        share = lambda total: -(-total // len(stages))
        disks = True
        for stage in stages:
            print(f"{stage.name} ...", flush=True)
            faults.kills(stage, share(arguments.kills))
            faults.races(stage, share(arguments.races))
            disks = disks and faults.power_failures(stage) and faults.full_and_read_only(stage)
        faults.table()
        print(f"\n{len(faults.violations)} violations")
        for line in faults.violations:
            print(f"  {line}")
        return 1 if faults.violations else 0


if __name__ == "__main__":
    sys.exit(main())
