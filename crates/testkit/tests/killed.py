#!/usr/bin/env python3
"""Runs of whole pipelines that are killed after every command, and run again: the same bytes?

    python3 crates/testkit/tests/killed.py BINARIES [--only NAME] [--inside N]

Every pipeline runs once undisturbed. Then it runs in an empty directory and is killed (SIGKILL) after its first
command, and again after its second one, and so on. From each of these states, a copy is run to its end. Its exit
code and every byte that it leaves must be those of the undisturbed run. With --inside N, N more runs of each pipeline
are killed while a command works, each at a random moment.

The commands are those of the pipeline: programs in front of the real ones count them, leave --wall-time out,
because times differ from run to run, and kill planish-run. The exit code is 1 if a run differs.
"""

import argparse
import fcntl
import os
import random
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]

# Time for which a directory may stay locked after the kill of its run: the program that killed it ends last.
MOST_WAIT_S = 10

SHIM = """#!/bin/sh
n=$(($(cat "$KILLED/count") + 1)); echo "$n" > "$KILLED/count"
name=${0##*/}; skip=
for word; do
    shift
    if [ "$skip" ]; then skip=; continue; fi
    case $word in --wall-time) skip=yes; continue ;; esac
    set -- "$@" "$word"
done
if [ "$n" = "$KILL_INSIDE" ]; then
    "$BINARIES/$name" "$@" & inner=$!
    sleep "$PAUSE_S"; kill -9 "$PPID" "$inner"; exit 2
fi
"$BINARIES/$name" "$@"; code=$?
if [ "$n" = "$KILL_AFTER" ]; then kill -9 "$PPID"; fi
exit "$code"
"""

COUPON = "fixture=coupon refine=no frames=0 pitch_mm=2 step_mm=2"
NO_JERK = "machine=fixtures/machines/ion-beam-no-jerk-limit.json"

# Words of planish-run. Paths are relative to a directory with the fixtures; `own` holds a map and a tool as bare arrays.
CASES = {
    "raster": f"run raster {COUPON} plan_joint=no export=galil",
    "raster-named": f"run raster {COUPON} plan_joint=no export=csv program_of=pvt passes=2",
    "raster-errors": f"run raster {COUPON} plan_joint=no error_budget=fixtures/error-budgets/ion-beam.json export=xps",
    "raster-specified": f"run raster {COUPON} plan_joint=no specification=fixtures/specifications/x-ray-mirror.json",
    "raster-axes": f"run raster {COUPON} plan_joint=no machine=fixtures/machines/ion-beam-xyz.json export=pmac",
    "raster-own": "run raster surface=own/surface tif=own/tif refine=no frames=3 plan_joint=no pitch_mm=2 "
                  "machine=fixtures/machines/ion-beam.json",
    "raster-joint": "run raster fixture=coupon frames=0 pitch_mm=4 export=galil",
    "maze": f"run maze {COUPON} plan_joint=no export=galil",
    "spiral": "run spiral fixture=disk-20 refine=no frames=0 plan_joint=no pitch_mm=2 export=galil",
    "random-adaptive": f"run random-adaptive {COUPON} plan_joint=no export=galil",
    "multi-pitch": "run multi-pitch fixture=coupon refine=no frames=0 classes=2 min_pitch_mm=1 export=galil",
    "line": "run line fixture=lines/line-250 refine=no frames=0 step_mm=4 export=galil",
    "bspline": f"run bspline fixture=coupon {NO_JERK} frames=0 pitch_mm=2 step_mm=2 export=gcode",
    "trig-spline": f"run trig-spline fixture=coupon {NO_JERK} frames=0 pitch_mm=2 cycle_s=0.1",
    "compare-dwell": "run compare-dwell fixture=coupon pitch_mm=2 step_mm=2 skip='bcls nnls tikhonov-lsqr tikhonov-l-curve "
                     "truncated-svd lucy-richardson lucy-richardson-map rifta udo udo-shift'",
    "compare": "stage raster compare fixture=coupon frames=0 pitch_mm=4 step_mm=4",
    "campaign": "campaign coupon runs=1 refine=no pitch_mm=2 step_mm=2",
    "tolerance": f"tolerance raster {COUPON}",
}

# Settings of a run that goes before in the same directory.
OVER = {
    "raster-over-errors": (CASES["raster-errors"].replace("pitch_mm=2", "pitch_mm=3"), CASES["raster"]),
    "raster-over-plain": (CASES["raster"].replace("pitch_mm=2", "pitch_mm=3"), CASES["raster-errors"]),
}


def tree(directory):
    """Every file below `directory` with its bytes, but the lock, which names the process."""
    return {str(path.relative_to(directory)): path.read_bytes() for path in sorted(directory.rglob("*"))
            if path.is_file() and path.name != "run.lock"}


class Killed:
    def __init__(self, binaries, work):
        self.binaries, self.work, self.different = binaries, work, []
        shims = work / "programs"
        shims.mkdir()
        for program in binaries.iterdir():
            if program.name.startswith("planish-") and os.access(program, os.X_OK) and program.is_file():
                (shims / program.name).write_text(SHIM)
                (shims / program.name).chmod(0o755)
        self.environment = {**os.environ, "PLANISH_PROGRAMS": str(shims), "PLANISH_SHARE": str(ROOT),
                            "BINARIES": str(binaries), "KILLED": str(work), "RAYON_NUM_THREADS": "2"}
        self.own = work / "own"
        made = [str(binaries / "planish-fixture"), str(ROOT / "fixtures/coupon.json"), "--out", str(self.own)]
        subprocess.run(made, check=True, capture_output=True)
        for part in ["surface", "tif"]:
            (self.own / part / "manifest.json").unlink()

    def run(self, words, where, kill_after="", kill_inside="", pause_s="0"):
        """Runs to the end or the kill: exit code, number of commands, and the last lines that it said.

        Every run is in the directory of one name while it works: a run states the absolute paths of its inputs.
        """
        self.wait(where / "o")
        place, where = where, self.work / "here"
        place.rename(where)
        (self.work / "count").write_text("0\n")
        environment = {**self.environment, "KILL_AFTER": str(kill_after), "KILL_INSIDE": str(kill_inside),
                       "PAUSE_S": pause_s}
        ended = subprocess.run([self.binaries / "planish-run", *words, "out=o"], cwd=where, env=environment,
                               stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace")
        self.wait(where / "o")
        where.rename(place)
        return ended.returncode, int((self.work / "count").read_text()), ended.stderr.strip().splitlines()[-3:]

    def wait(self, out):
        """Waits until no process has a directory of the run."""
        for lock in [*out.rglob("run.lock")] if out.is_dir() else []:
            with open(lock) as file:
                since = time.monotonic()
                while True:
                    try:
                        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        break
                    except BlockingIOError:
                        if time.monotonic() - since > MOST_WAIT_S:
                            sys.exit(f"{lock} stays locked")
                        time.sleep(0.01)

    def fresh(self, name, before=None):
        where = self.work / name
        shutil.rmtree(where, ignore_errors=True)
        where.mkdir()
        os.symlink(ROOT / "fixtures", where / "fixtures")
        os.symlink(self.own, where / "own")
        if before and (before / "o").exists():
            shutil.copytree(before / "o", where / "o", symlinks=True)
        return where

    def judge(self, name, what, words, where, undisturbed):
        """Runs again from the state in `where`, to the end."""
        code, _, said = self.run(words, where)
        found, (expected_code, expected) = tree(where / "o"), undisturbed
        names = sorted(n for n in found.keys() | expected.keys() if found.get(n) != expected.get(n))
        if code == expected_code and not names:
            return True
        problem = f"{name}: {what}: exit {code} for {expected_code}, {len(names)} files differ: {names[:8]} {said}"
        self.different.append(problem)
        print(f"DIFFERENT {problem}", flush=True)
        return False

    def case(self, name, words, before, inside):
        begun = time.monotonic()
        first = self.fresh("first")
        if before:
            code, _, said = self.run(before, first)
            if code not in (0, 1):
                sys.exit(f"{name}: the run before it ends with {code}: {said}")
        whole = self.fresh("whole", first)
        code, commands, said = self.run(words, whole)
        if code not in (0, 1):
            sys.exit(f"{name}: the undisturbed run ends with {code}: {said}")
        undisturbed = code, tree(whole / "o")
        same = self.judge(name, "run again after its end", words, whole, undisturbed)
        good, tried = int(same), 1
        state = self.fresh("state", first)
        generator = random.Random(name)
        within = set(generator.sample(range(1, commands + 1), min(inside, commands)))
        for command in range(1, commands + 1):
            if command in within:
                where = self.fresh("again", state)
                pause_s = f"{generator.uniform(0, 0.08):.4f}"
                self.run(words, where, kill_inside=command, pause_s=pause_s)
                good += self.judge(name, f"killed in command {command} after {pause_s} s", words, where, undisturbed)
                tried += 1
            code, reached, said = self.run(words, state, kill_after=command)
            if code >= 0:
                self.different.append(f"{name}: ended with {code} before command {command}: {said}")
                print(f"DIFFERENT {self.different[-1]}", flush=True)
                break
            where = self.fresh("again", state)
            good += self.judge(name, f"killed after command {command}", words, where, undisturbed)
            tried += 1
        seconds = time.monotonic() - begun
        print(f"{name:20} exit {undisturbed[0]} {commands:4} commands {good:4} of {tried:4} the same {seconds:6.0f} s",
              flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binaries", type=Path)
    parser.add_argument("--only", help="names of cases, separated by commas")
    parser.add_argument("--inside", type=int, default=4, help="kills within a command, for every case")
    arguments = parser.parse_args()
    cases = {name: (words, None) for name, words in CASES.items()}
    cases.update({name: (words, before) for name, (before, words) in OVER.items()})
    wanted = arguments.only.split(",") if arguments.only else list(cases)
    with tempfile.TemporaryDirectory(prefix="planish-killed-") as work:
        killed = Killed(arguments.binaries.resolve(), Path(work))
        for name in wanted:
            words, before = cases[name]
            killed.case(name, shlex.split(words), shlex.split(before) if before else None, arguments.inside)
        print(f"\n{len(killed.different)} different")
        return 1 if killed.different else 0


if __name__ == "__main__":
    sys.exit(main())
