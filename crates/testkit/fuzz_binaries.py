#!/usr/bin/env python3
"""Damaged inputs and absurd flags through the real programs: `just fuzz-binaries CASES SEED`.

A tiny mirror goes through every stage once. Then, case by case, one command of every stage is run again with
copies of its inputs of which one is damaged (bytes, the header or the numbers of a .npy file, the manifest, a
file in the place of another, a file that is no file), or with absurd values of its flags, as `--help` lists
them, or both. What must hold, whatever comes in:

* the program ends within 20 s, with 0 (done), 1 (done, the verdict is negative) or 2 (could not run);
* nothing says "internal error" or "panicked", no signal ends it;
* with 2 there is one message that starts with "error: ", and no output;
* its memory stays below its budget, and its inputs are unchanged byte for byte.

Every case has a number, and a case is made from its number and the seed alone:

    fuzz_binaries.py --programs target/release --work out/fuzz-binaries --seed 1 --only 17

repeats case 17, prints its command and leaves its files there. Python 3.9 or later, without packages.
"""

import argparse
import hashlib
import json
import math
import os
import random
import re
import resource
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

LIMIT_S = 20
# What every run is given, and what it may reach: its budget counts arrays, not code, stacks and what the
# allocator keeps.
MEMORY_GIB = 0.25
MOST_RESIDENT_MIB = 512
ADDRESS_SPACE_BYTES = 4 << 30
# A program that writes without end is a defect too.
LARGEST_FILE_BYTES = 1 << 30

RECIPE = {
    "name": "tiny",
    "doc": "Small enough that every stage runs in milliseconds.",
    "seed": 7,
    "pixels": [21, 16],
    "width_mm": 8.0,
    "aperture": "rectangle",
    "legendre": [{"order": [2, 0], "amplitude_nm": 13.0}, {"order": [1, 1], "amplitude_nm": -4.0}],
    "scale": {"rms_nm": 10.0},
    "tif": {"peak_nm_per_s": 10.0, "half_size_mm": 2.0, "shape": {"gaussian": {"sigma_mm": 0.6}}},
}

# Four corners of a part that lies 100 mm along x and 50 mm along y from the origin of the machine.
FIDUCIALS = """map_x_mm,map_y_mm,machine_x_mm,machine_y_mm,uncertainty_mm
0,0,100,50,0.005
8,0,108,50,0.005
8,6,108,56,0.005
0,6,100,56,0.005
"""

# Heights on rings, which lie on no grid.
POINTS = "".join(
    f"{r * math.cos(k * math.pi / 6):.4f} {r * math.sin(k * math.pi / 6):.4f} {0.1 * r * r:.4f}\n"
    for r in (1, 2, 3, 4) for k in range(12)
)

# 4 x 3 pixels of 0.5 mm, as Gwyddion writes them: the header is filled up to a multiple of 4 bytes.
GSF_HEADER = b"Gwyddion Simple Field 1.0\nXRes = 4\nYRes = 3\nXReal = 0.002\nYReal = 0.0015\nXYUnits = m\nZUnits = m\n"
GSF = GSF_HEADER + bytes(4 - len(GSF_HEADER) % 4) + struct.pack("<12f", *(1e-9 * k for k in range(12)))

# Two plans of the recipe. The paths are those of the base, wherever a case has its copy of the file.
SWEEP = """mirror: {{fixture: {base}/recipe.json}}
machine: {base}/machine.json
plans:
  path: raster
  pitch_mm: {{from: 1, to: 2, step: 1}}
  time_elasticity: 0.5
"""

# What `planish-sweep table` says of them.
TABLE = {
    "name": "sweep", "mirror": "tiny", "has_process": False,
    "constraints": {"max_time_s": 100.0, "keep_limits": True},
    "plans": [
        {"id": f"raster-joint-{i}", "path": "raster", "method": "joint", "settings": {"pitch_mm": i}, "status": "done",
         "message": None, "report": None, "again": f"just run raster pitch_mm={i}",
         "numbers": {"total_time_s": 10.0 / i, "rms_nm": i, "rms_detilted_nm": i, "below_95_percent_nm": None,
                     "limits_kept": True}}
        for i in (1, 2)
    ],
}

# How the base is made; {name} is a path in it. The order matters, each line writes what later ones read.
# What has no --out writes nothing that others read.
BASE = """
planish-fixture {recipe.json} --out {mirror}
planish-surface prepare --surface {mirror/surface} --level plane --out {run/surface}
planish-tool prepare --tif {mirror/tif} --out {tif}
planish-surface psd --surface {run/surface} --band-per-mm 0.1 0.5 --out {psd}
planish-surface draw --surface {run/surface} --out {draw.svg}
planish-toolpath raster --surface {run/surface} --tif {tif} --pitch-mm 1 --step-mm 1 --out {run/tool_path}
planish-toolpath maze --surface {run/surface} --tif {tif} --pitch-mm 1.5 --out {maze}
planish-toolpath random-adaptive --surface {run/surface} --tif {tif} --pitch-mm 1.5 --out {adaptive}
planish-toolpath multi-pitch --surface {run/surface} --tif {tif} --max-velocity-mm-per-s 3 --step-mm 1 --out {multi}
planish-toolpath spiral --surface {run/surface} --tif {tif} --pitch-mm 1 --step-mm 1 --out {spiral}
planish-toolpath passes --tool-path {spiral} --passes 2 --return --out {passes}
planish-toolpath inspect --tool-path {run/tool_path} --surface {run/surface}
planish-toolpath draw --tool-path {run/tool_path} --surface {run/surface} --out {path.svg}
planish-dwell bounded-least-squares --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --min-dwell-s 0.05 --out {run/dwell}
planish-dwell bcls --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --machine {machine.json} --out {bcls}
planish-dwell non-negative-least-squares --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --out {nnls}
planish-dwell tikhonov-lsqr --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --out {lsqr}
planish-dwell truncated-svd --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --out {tsvd}
planish-dwell lucy-richardson --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --out {lucy}
planish-dwell rifta --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --out {rifta}
planish-dwell udo --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --out {udo}
planish-schedule pvt --tool-path {run/tool_path} --dwell {run/dwell} --machine {machine.json} --out {run/methods/pvt/trajectory}
planish-schedule pvt-as-published --tool-path {run/tool_path} --dwell {run/dwell} --machine {machine.json} --out {published}
planish-schedule constant-acceleration --tool-path {run/tool_path} --dwell {run/dwell} --machine {machine.json} --out {ca}
planish-schedule stop-at-corners --tool-path {run/tool_path} --dwell {run/dwell} --machine {machine.json} --out {stop}
planish-schedule trig-spline --tool-path {run/tool_path} --dwell {run/dwell} --machine {machine.json} --out {trig}
planish-schedule average-velocity --tool-path {run/tool_path} --dwell {run/dwell} --machine {machine.json} --out {average}
planish-schedule position --tool-path {run/tool_path} --dwell {run/dwell} --machine {machine.json} --out {position}
planish-bspline-feed --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --machine {machine.json} --out {bspline}
planish-simulate --trajectory {run/methods/pvt/trajectory} --tif {tif} --surface {run/surface} --out {run/methods/pvt/removal}
planish-simulate --trajectory {run/methods/pvt/trajectory} --tif {tif} --surface {run/surface} --frames 3 --out {frames}
planish-verify --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --out {run/methods/pvt/verdict}
planish-refine --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --machine {machine.json} --out {refined}
planish-refine pareto --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --machine {machine.json} --min-dwell-s-per-mm 0.02 --prices 2 --out {pareto}
planish-joint --surface {run/surface} --tif {tif} --tool-path {run/tool_path} --machine {machine.json} --out {feed-plan}
planish-tolerance --trajectory {run/methods/pvt/trajectory} --tif {tif} --surface {run/surface} --error-budget {error_budget.json} --draws 1000 --simulated-runs 2 --out {tolerance}
planish-export galil --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --count-mm 0.0001 --out {p.dmc}
planish-export xps --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --count-mm 0.0001 --out {p.trj}
planish-export pmac --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --count-mm 0.0001 --out {p.pmc}
planish-export gcode --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --count-mm 0.0001 --out {p.ngc}
planish-export csv --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --count-mm 0.0001 --out {p.csv}
planish-export ros --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --count-mm 0.0001 --out {p.ros.json}
planish-export aerotech --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --count-mm 0.0001 --out {p.ab}
planish-import program {p.ab} --controller aerotech --about {p.ab.json} --out {from-aerotech}
planish-export automation1 --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --out {p.automation1}
planish-import program {p.automation1} --controller automation1 --about {p.automation1.json} --out {from-automation1}
planish-export sinumerik --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --out {p.sinumerik}
planish-import program {p.sinumerik} --controller sinumerik --about {p.sinumerik.json} --out {from-sinumerik}
planish-export sinumerik-poly --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --out {p.sinumerik-poly}
planish-import program {p.sinumerik-poly} --controller sinumerik-poly --about {p.sinumerik-poly.json} --out {from-sinumerik-poly}
planish-export twincat --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --out {p.twincat}
planish-import program {p.twincat} --controller twincat --about {p.twincat.json} --out {from-twincat}
planish-export xps-pt --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --out {p.xps-pt}
planish-import program {p.xps-pt} --controller xps-pt --about {p.xps-pt.json} --out {from-xps-pt}
planish-export zaber --trajectory {run/methods/pvt/trajectory} --machine {machine.json} --out {p.zaber}
planish-import program {p.zaber} --controller zaber --about {p.zaber.json} --out {from-zaber}
planish-import program {p.ros.json} --controller ros --about {p.ros.json.json} --out {from-ros}
planish-toolpath raster --surface {run/surface} --tif {tif} --pitch-mm 1 --step-mm 1 --machine {lab.json} --out {lab-path}
planish-schedule pvt --tool-path {run/tool_path} --dwell {run/dwell} --machine {lab.json} --out {lab-motion}
planish-verify --trajectory {lab-motion} --machine {lab.json} --out {lab-verdict}
planish-export pmac --trajectory {lab-motion} --machine {lab.json} --tool-output 1 --out {lab.pmc}
planish-import program {lab.pmc} --controller pmac --about {lab.pmc.json} --out {from-lab}
planish-import program {p.dmc} --controller galil --about {p.dmc.json} --out {from-galil}
planish-import program {p.trj} --controller xps --about {p.trj.json} --out {from-xps}
planish-import program {p.pmc} --controller pmac --about {p.pmc.json} --out {from-pmac}
planish-import program {p.ngc} --controller gcode --out {from-gcode}
planish-import program {p.csv} --controller csv --out {from-csv}
planish-import trace {p.csv} --tool-on tool_on --most-gap-s 5 --planned {run/methods/pvt/trajectory} --out {as-run}
planish-simulate --trajectory {run/methods/pvt/trajectory} --tif {tif} --surface {run/surface} --error-budget {error_budget.json} --measured-out {after} --out {truth}
planish-reconcile --before {run/surface} --after {after} --trajectory {run/methods/pvt/trajectory} --tif {tif} --hold magnification --out {reconciliation}
planish-reconcile --before {run/surface} --after {after} --trajectory {run/methods/pvt/trajectory} --tif {tif} --hold magnification --error-budget {error_budget.json} --corrected-tif {learnt-tif} --corrected-transform {learnt-place} --learnt-error-budget {learnt.json} --out {learnt}
planish-campaign measure --surface {run/surface} --error-budget {error_budget.json} --out {measured}
planish-campaign decide --surface {run/surface} --trajectory {run/methods/pvt/trajectory} --tolerance {tolerance} --out {decision}
planish-register fit {fiducials.csv} --out {where}
planish-register fit {fiducials.csv} --machine {machine.json} --out {where-on-axes}
planish-register place --machine {lab.json} --out {place}
planish-register apply --transform {where} --trajectory {run/methods/pvt/trajectory} --out {on-machine}
planish-import surface {run/surface/height_nm.npy} --unit nm --pixel-mm 0.5 --picture {a.svg} --out {from-npy}
planish-import surface {run/surface} --flip-x --out {from-directory}
planish-import surface {points.xyz} --unit nm --coordinate-unit mm --grid-mm 0.5 --out {from-points}
planish-import surface {map.gsf} --out {from-gsf}
planish-tool from-maps {tif/rate_nm_per_s.npy} --rate --unit nm --pixel-mm 0.5 --out {tif-from-npy}
planish-tool from-maps {tif/rate_nm_per_s.npy} --unit nm --pixel-mm 0.5 --dwell-s 30 --half-size-mm 1 --baseline none --out {spot}
planish-surface psd --removal {run/methods/pvt/removal} --out {psd-removal}
planish-sweep expand {sweep.yaml} --out {sweep}
planish-compare sweep {table.json} --out {sweep-report}
planish-compare diff --max-difference 1 {run/surface} {from-directory}
planish-compare report {run} --measured {mirror/surface} --out {run/report}
planish-run program --run {run} --of pvt --controller galil
"""

# Most of what users get wrong, and what breaks arithmetic.
NUMBERS = """0 -0 -1 1 2 0.5 nan inf -inf 1e-300 1e-9 1e-3 1e3 1e6 1e9 1e300 -1e300 1000000 4294967296
9007199254740993 18446744073709551615 99999999999999999999 1,2 ,""".split() + ["", "x", "\x1b[2J", "\u00b5"]

# Flags that say where something goes.
OUTPUTS = ("--out", "--picture", "--measured-out", "--corrected-tif", "--corrected-transform", "--learnt-error-budget")

# What flags take that count something.
COUNTS = "0 1 2 3 7 20 100 10000 1000000 4294967295 18446744073709551615".split()

# Flags that ask for so many whole simulations or plans: 10 000 and 100 are half a minute of work that was asked for, and
# more are refused.
WORK = {"--simulated-runs": ("10000", "1000"), "--prices": ("100", "7")}


def main():
    # This program damages devices and pipes into its cases; it must not read one itself.
    resource.setrlimit(resource.RLIMIT_AS, (2 << 30, resource.RLIM_INFINITY))
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--programs", type=Path, default=Path("target/release"))
    parser.add_argument("--work", type=Path, default=Path("out/fuzz-binaries"))
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="repeat one case and keep its files")
    args = parser.parse_args()
    programs, work = args.programs.resolve(), args.work.resolve()
    base = make_base(programs, work / "base")
    commands = [line for line in BASE.split("\n") if line]
    flags = {line: numeric_flags(programs, line) for line in commands}
    numbers = [args.only] if args.only is not None else range(args.cases)
    failures, ends, seconds, resident = [], Counter(), Counter(), Counter()
    started = time.monotonic()
    for number in numbers:
        at = work / "case"
        case = Case(number, args.seed, commands, flags, programs, base, at)
        end = case.run()
        name = " ".join(w for w in case.line.split()[:2] if re.match("[a-z]", w))
        ends[name, end["code"] if end["code"] in (0, 1, 2) else "other"] += 1
        seconds[name] = max(seconds[name], end["seconds"])
        resident[name] = max(resident[name], end["resident_mib"])
        if args.only is not None:
            print(case.shown, *case.damage, end["said"], end, sep="\n")
        if end["problem"]:
            failures.append((number, case, end))
    table(ends, seconds, resident)
    print(f"{len(numbers)} cases, seed {args.seed}, {time.monotonic() - started:.0f} s, {len(failures)} failures")
    for number, case, end in failures:
        print(f"\n{number}: {end['problem']}\n  {case.shown}\n  {'; '.join(case.damage) or 'inputs as they are'}")
        print("  " + "\n  ".join(end["said"].strip().splitlines()[:3]))
        print(f"  again: {shlex.quote(sys.argv[0])} --programs {args.programs} --work {args.work}"
              f" --seed {args.seed} --only {number}")
    sys.exit(1 if failures else 0)


def make_base(programs, base):
    """The inputs of all stages; made once and kept."""
    made = base / "made"
    if made.exists():
        return base
    shutil.rmtree(base, ignore_errors=True)
    base.mkdir(parents=True)
    (base / "recipe.json").write_text(json.dumps(RECIPE))
    fixtures = Path(__file__).resolve().parents[2] / "fixtures"
    shutil.copy(fixtures / "machines/ion-beam.json", base / "machine.json")
    shutil.copy(fixtures / "machines/ion-beam-lab.json", base / "lab.json")
    shutil.copy(fixtures / "error-budgets/ion-beam.json", base / "error_budget.json")
    (base / "fiducials.csv").write_text(FIDUCIALS)
    (base / "points.xyz").write_text(POINTS)
    (base / "map.gsf").write_bytes(GSF)
    (base / "sweep.yaml").write_text(SWEEP.format(base=base))
    (base / "table.json").write_text(json.dumps(TABLE))
    for line in BASE.split("\n"):
        if not line:
            continue
        arguments = [re.sub(r"^\{(.*)\}$", lambda m: str(base / m[1]), word) for word in line.split()]
        done = subprocess.run([programs / arguments[0], *arguments[1:]], capture_output=True, text=True)
        if done.returncode not in (0, 1):
            sys.exit(f"the base cannot be made: {line}\n{done.stderr}")
    made.write_text("")
    return base


def numeric_flags(programs, line):
    """Flags of a command that take a value which is no directory, file, name or one of a list."""
    words = line.split()
    called = words[:2] if len(words) > 1 and re.match(r"[a-z]", words[1]) else words[:1]
    text = subprocess.run([programs / called[0], *called[1:], "--help"], capture_output=True, text=True).stdout
    found = re.findall(r"^\s+(?:-\w, )?(--[a-z0-9-]+)((?: <[^>]+>)+)([^\n]*(?:\n(?!\s+(?:-\w, )?--).*)*)", text, re.M)
    return [
        (flag, values.count("<"))
        for flag, values, about in found
        if not re.search(r"DIR|FILE|NAME|\.json", values)
        and "possible values" not in " ".join(about.lower().split())
        and flag not in ("--memory-gib", "--wall-time", "--out")
    ]


class Case:
    """One command, with what is damaged."""

    def __init__(self, number, seed, commands, flags, programs, base, at):
        self.random = random.Random(f"{seed} {number}")
        self.line = self.random.choice(commands)
        self.at, self.damage = at, []
        shutil.rmtree(at, ignore_errors=True)
        at.mkdir(parents=True)
        words, self.inputs, self.outputs = self.line.split(), [], []
        for i, word in enumerate(words):
            name = word[1:-1] if word.startswith("{") else None
            if name is None:
                continue
            place = at / name.replace("/", "-")
            if words[i - 1] in OUTPUTS:
                self.outputs.append(place)
            else:
                # A file keeps its name: an ending tells the format.
                copy = shutil.copytree if (base / name).is_dir() else shutil.copy
                copy(base / name, place)
                self.inputs.append(place)
            words[i] = str(place)
        kind = self.random.choice(["files", "flags", "both"])
        if kind != "flags" and self.inputs:
            for _ in range(self.random.choice([1, 1, 1, 2])):
                self.damage_file(base)
        if kind != "files":
            words = self.absurd(words, flags[self.line])
        self.arguments = [str(programs / words[0]), *words[1:], "--memory-gib", str(MEMORY_GIB)]
        self.shown = shlex.join(words)

    def absurd(self, words, flags):
        """Absurd values for some flags, in the place of those that are there."""
        for flag, count in self.random.sample(flags, min(len(flags), self.random.choice([1, 1, 2, 3]))):
            if flag in words:
                at = words.index(flag)
                del words[at:at + 1 + count]
            given = [self.random.choice(self.random.choice([NUMBERS, COUNTS])) for _ in range(count)]
            if flag in WORK:
                given = [WORK[flag][1] if value == WORK[flag][0] else value for value in given]
            # With `=` a value that starts with a hyphen is a value.
            words = [*words, f"{flag}={given[0]}"] if count == 1 else [*words, flag, *given]
        return words

    def damage_file(self, base):
        target = self.random.choice(self.inputs)
        files = sorted(target.rglob("*")) if target.is_dir() else [target]
        # What an earlier damage left may be no file any more.
        files = [p for p in files if p.is_file() and not p.is_symlink()]
        if not files:
            return
        if target.is_dir() and self.random.random() < 0.5:
            # Without a manifest the arrays are read as a user's own, and no hash protects them.
            manifest = target / "manifest.json"
            if manifest in files:
                manifest.unlink()
            files = [f for f in files if f.name != "manifest.json"]
            if not files:
                return
            self.damage.append(f"{target.name} without its manifest")
        file = self.random.choice(files)
        ways = [bytes_changed, cut, swapped, no_file]
        if file.suffix == ".npy":
            ways += [npy_header, npy_numbers, npy_numbers, npy_numbers]
        if file.suffix == ".json":
            ways += [json_changed] * 5
        way = self.random.choice(ways)
        try:
            what = way(self.random, file, base)
        except (struct.error, UnicodeError):
            # Damaged before: no array any more.
            what = bytes_changed(self.random, file, base)
        self.damage.append(f"{file.relative_to(self.at)}: {what}")

    def run(self):
        before = fingerprint(self.inputs)
        log = self.at / "log"
        started = time.monotonic()
        with open(log, "wb") as out:
            child = subprocess.Popen(
                self.arguments, cwd=self.at, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=out,
                start_new_session=True, preexec_fn=limited,
            )
            hung = False
            while True:
                pid, status, usage = os.wait4(child.pid, os.WNOHANG)
                if pid:
                    break
                if time.monotonic() - started > LIMIT_S:
                    hung = True
                    os.kill(child.pid, signal.SIGKILL)
                    _, status, usage = os.wait4(child.pid, 0)
                    break
                time.sleep(0.002)
        child.returncode = 0  # reaped above
        code = os.waitstatus_to_exitcode(status)
        seconds, resident = time.monotonic() - started, usage.ru_maxrss / 1024
        said = log.read_text(errors="replace")
        errors = sum(line.startswith("error: ") for line in said.splitlines())
        left = [p for p in self.outputs if os.path.lexists(p)]
        problem = None
        if hung:
            problem = f"runs on after {LIMIT_S} s"
        elif "internal error" in said or "panicked" in said:
            problem = "internal error"
        elif code not in (0, 1, 2):
            problem = f"ended with {code}"
        elif resident > MOST_RESIDENT_MIB:
            problem = f"took {resident:.0f} MiB with --memory-gib {MEMORY_GIB}"
        elif fingerprint(self.inputs) != before:
            problem = "an input changed"
        elif code == 2 and errors != 1:
            problem = f"exit code 2 with {errors} messages"
        elif code == 2 and left:
            problem = f"exit code 2, but wrote {left[0].name}"
        elif "\x1b" in said:
            problem = "an escape sequence reached the terminal"
        return {"code": code, "seconds": seconds, "resident_mib": resident, "said": said, "problem": problem}


def limited():
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE_BYTES, ADDRESS_SPACE_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE_BYTES, LARGEST_FILE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def fingerprint(paths):
    """Names, kinds and bytes of everything under `paths`."""
    found = []
    for path in paths:
        for p in [path, *sorted(path.rglob("*"))] if path.is_dir() and not path.is_symlink() else [path]:
            if p.is_symlink():
                found.append((str(p), os.readlink(p)))
            elif p.is_file():
                found.append((str(p), hashlib.sha256(p.read_bytes()).hexdigest()))
            else:
                found.append((str(p), "directory" if p.is_dir() else os.path.lexists(p)))
    return found


def bytes_changed(rand, file, _):
    data = bytearray(file.read_bytes())
    count = rand.choice([1, 1, 2, 8])
    for _ in range(count if data else 0):
        at = rand.randrange(len(data))
        way = rand.randrange(4)
        if way == 0:
            data[at] ^= 1 << rand.randrange(8)
        elif way == 1:
            data[at] = rand.choice([0, 255, 127, 128, 10, 45, 57])
        elif way == 2:
            del data[at:at + rand.randrange(1, 20)]
        else:
            data[at:at] = data[max(0, at - rand.randrange(1, 40)):at]
        if not data:
            break
    file.write_bytes(data)
    return f"{count} byte(s) changed"


def cut(rand, file, _):
    data = file.read_bytes()
    at = rand.choice([0, 1, 8, len(data) // 2, max(0, len(data) - 1), rand.randrange(len(data) + 1)])
    file.write_bytes(data[:at])
    return f"cut at byte {at}"


def swapped(rand, file, base):
    same = sorted(p for p in base.rglob(f"*{file.suffix}") if p.is_file())
    other = rand.choice(same)
    file.write_bytes(other.read_bytes())
    return f"is {other.relative_to(base)}"


def no_file(rand, file, _):
    way = rand.choice(["absent", "a directory", "a pipe", "/dev/zero", "a loop", "unreadable name"])
    file.unlink()
    if way == "a directory":
        file.mkdir()
    elif way == "a pipe":
        os.mkfifo(file)
    elif way == "/dev/zero":
        file.symlink_to("/dev/zero")
    elif way == "a loop":
        file.symlink_to(file)
    return way


def npy_header(rand, file, _):
    data = file.read_bytes()
    length = struct.unpack("<H", data[8:10])[0]
    header = data[10:10 + length].decode("latin1")
    shape = rand.choice(["()", "(0,)", "(1,)", "(1, 1)", "(2, 3)", "(1000000, 1000000)", "(99999999999999999999,)",
                         "(-1, 2)", "(3,", "(1, 1, 1, 1)"])
    dtype = rand.choice(["<f8", "<f4", ">f8", "<i8", "|u1", "|b1", "<c16", "|O", "<f2", "<M8[ns]", "|S5"])
    if rand.random() < 0.5:
        what, header = f"shape {shape}", re.sub(r"'shape': \([^)]*\)", f"'shape': {shape}", header)
    elif rand.random() < 0.7:
        what, header = f"dtype {dtype}", re.sub(r"'descr': '[^']*'", f"'descr': '{dtype}'", header)
    else:
        what, header = "Fortran order", header.replace("False", "True")
    header = header.rstrip() + " " * 64
    header = header[:(len(header) + 10) // 64 * 64 - 11] + "\n"
    file.write_bytes(data[:8] + struct.pack("<H", len(header)) + header.encode("latin1") + data[10 + length:])
    return what


def npy_numbers(rand, file, _):
    data = file.read_bytes()
    start = 10 + struct.unpack("<H", data[8:10])[0]
    kind = "q" if b"i8" in data[:start] else "B" if b"u1" in data[:start] else "d"
    count = (len(data) - start) // struct.calcsize(kind)
    values = list(struct.unpack(f"<{count}{kind}", data[start:start + count * struct.calcsize(kind)]))
    if kind == "d":
        v = rand.choice([float("nan"), float("inf"), -1.0, 0.0, 1e-300, 1e300, 1e-9, 1e9, 5e-324, -1e12, 1e6])
    elif kind == "q":
        v = rand.choice([-1, 0, 1 << 62, -(1 << 63), 1000000])
    else:
        v = rand.choice([0, 1, 2, 255])
    way = rand.choice(["one is", "all are", "all times", "half are"])
    if way == "one is" and values:
        values[rand.randrange(count)] = v
    elif way == "all are":
        values = [v] * count
    elif way == "half are":
        values = [v if i % 2 else a for i, a in enumerate(values)]
    elif kind == "d":
        v = rand.choice([1e-12, 1e-6, 1e-3, 1e3, 1e6, 1e9, -1.0, 0.0])
        values = [a * v for a in values]
    file.write_bytes(data[:start] + struct.pack(f"<{count}{kind}", *values))
    return f"{way} {v}"


def json_changed(rand, file, _):
    try:
        value = json.loads(file.read_bytes())
    except ValueError:
        return bytes_changed(rand, file, _)
    places = []

    def walk(inside):
        for key in list(inside) if isinstance(inside, dict) else range(len(inside)):
            places.append((inside, key))
            if isinstance(inside[key], (dict, list)):
                walk(inside[key])

    if isinstance(value, (dict, list)):
        walk(value)
    if not places:
        return bytes_changed(rand, file, _)
    inside, key = rand.choice(places)
    new = rand.choice([None, True, 0, -1, 1e300, 1e-300, 0.5, 10**30, "", "x", "\x1b[2J", "../..", [], {}, [[[]]],
                       "<script>", "height_nm.npy", 5, "gone"])
    if new == "gone":
        del inside[key]
    else:
        inside[key] = new
    file.write_text(json.dumps(value))
    return f"{key} is {new!r}"


def table(ends, seconds, resident):
    names = sorted({name for name, _ in ends})
    print(f"{'program':<42}{'cases':>7}{'done':>7}{'negative':>10}{'refused':>9}{'other':>7}{'most s':>8}{'most MiB':>10}")
    for name in names:
        each = [ends[name, end] for end in (0, 1, 2, "other")]
        print(f"{name:<42}{sum(each):>7}{each[0]:>7}{each[1]:>10}{each[2]:>9}{each[3]:>7}"
              f"{seconds[name]:>8.2f}{resident[name]:>10.0f}")


if __name__ == "__main__":
    main()
