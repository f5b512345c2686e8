#!/usr/bin/env python3
"""Mistakes of a laboratory, made on purpose: which of them does Planish name?

    python3 crates/testkit/tests/mistakes.py BINARIES [--only WORD]

Every mistake is made in files of a small coupon, and given to the program that sees it first. The table has a row per
mistake: `refused` (exit code 2), `verdict` (exit code 1) or `warning` with the words that the mistake deserves, `other` with
other words, and `silent` without any. The same files without the mistake must give no warning: the rows `right`. The exit code
is 1 when more than two mistakes are silent, or a right file is doubted.

Needs Python 3 alone.
"""

import argparse
import json
import math
import re
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
MOST_SILENT = 2
PITCH_MM = 0.25
SHAPE = (49, 81)


def save(path, rows):
    """Writes a float64 .npy of one or two dimensions."""
    flat, shape = (rows, (len(rows),)) if not isinstance(rows[0], list) else (sum(rows, []), (len(rows), len(rows[0])))
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
    header += " " * (63 - (10 + len(header)) % 64) + "\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode()
                     + struct.pack(f"<{len(flat)}d", *flat))


def arrays(path, name, rows, x, y):
    path.mkdir()
    save(path / name, rows)
    save(path / "x_mm.npy", x)
    save(path / "y_mm.npy", y)
    return path


def height(x, y):
    return 0.3 * (x - 10) ** 2 + 0.2 * (y - 6) ** 2 + 2 * math.sin(0.7 * x) * math.cos(0.9 * y)


def surface(path, lateral=1.0, start=0.0, factor=1.0, change=lambda z, x, y: z):
    """The map of a coupon of 20 x 12 mm, with coordinates and heights times a factor."""
    xs, ys = ([PITCH_MM * i for i in range(n)] for n in reversed(SHAPE))
    rows = [[change(factor * height(x, y), x, y) for x in xs] for y in ys]
    return arrays(path, "height_nm.npy", rows, *([start + lateral * v for v in axis] for axis in (xs, ys)))


def tif(path, factor=1.0, lateral=1.0, half=14, floor=0.0):
    """A Gaussian TIF of 10 nm/s and sigma 1 mm."""
    offsets = [PITCH_MM * i for i in range(-half, half + 1)]
    rows = [[factor * (10 * math.exp(-(x * x + y * y) / 2) + floor) for x in offsets] for y in offsets]
    return arrays(path, "rate_nm_per_s.npy", rows, *[[lateral * v for v in offsets]] * 2)


def machine(path, base="ion-beam", change=lambda m: None):
    made = json.loads((ROOT / f"fixtures/machines/{base}.json").read_text())
    change(made)
    path.write_text(json.dumps(made))
    return path


def log(path, head, line, count=400, rate_hz=1000.0, end=""):
    rows = []
    for i in range(count):
        t = i / rate_hz
        rows.append(line(i, t, 10 * (1 - math.cos(math.pi * t / 2)), 3 * t))
    path.write_text(head + "\n".join(rows) + "\n" + end)
    return path


def text(path, content):
    path.write_text(content)
    return path


def profile(path, head, to_x=1.0, to_slope=1.0, end=""):
    rows = [f"{to_x * i},{to_slope * math.sin(0.2 * i):.9f}" for i in range(60)]
    return text(path, head + "\n".join(rows) + "\n" + end)


def xyz(path, head, to_z):
    rows = [f"{0.5 * i} {0.5 * j} {to_z * height(0.5 * i, 0.5 * j):.9f}" for j in range(24) for i in range(40)]
    return text(path, head + "\n".join(rows) + "\n")


def raster(d, **inputs):
    given = {"surface": lambda: surface(d / "surface"), "tif": lambda: tif(d / "tif"),
             "machine": lambda: machine(d / "machine.json")}
    words = sum([[f"--{name}", inputs.get(name, make)()] for name, make in given.items()], [])
    return ["toolpath", "raster", *words, "--pitch-mm", 0.5, "--step-mm", 0.5, *inputs.get("flags", [])]


def prepare(d, map_of, *flags):
    return ["surface", "prepare", "--surface", map_of, *flags]


def trace(file, *flags):
    return ["import", "trace", file, *flags]


def spec(file, *flags):
    return ["surface", "spec", "--profile", file, *flags]


def disk(inverted):
    nan = float("nan")
    return lambda z, x, y: z if (math.hypot(x - 10, y - 6) <= 5.9) != inverted else nan


def travel(mm):
    def change(made):
        for axis in made["axes"]:
            axis["travel_mm"] = [-mm, mm]
    return change


def slow(factor):
    def change(made):
        for axis in made["axes"]:
            axis["max_velocity_mm_per_s"] *= factor
            axis["max_acceleration_mm_per_s2"] *= factor
    return change


def rotary_in_radians(made):
    for axis in made["rotary_axes"]:
        axis["travel_deg"] = [round(math.radians(v), 4) for v in axis["travel_deg"]]


MM = "{0:.4f},{1:.6f},{2:.6f}"


def plain(i, t, x, y):
    return MM.format(t, x, y)


def jump(i, t, x, y):
    return MM.format(t, x + (64 if i >= 200 else 0), y)


def channels(i, t, x, y):
    return f"{i} {x:.6f} {i + 3} {3 * (i + 3) / 1000:.6f}"


def spot(d, swapped):
    """Maps of a test piece before and after a spot of 100 nm."""
    dug = surface(d / "after", change=lambda z, x, y: z - 100 * math.exp(-((x - 10) ** 2 + (y - 6) ** 2) / 2))
    whole = surface(d / "before")
    after, before = (whole, dug) if swapped else (dug, whole)
    return ["import", "tif", after, "--before", before, "--dwell-s", 10, "--half-size-mm", 3, "--align", "none"]


def with_plan(run, d, drift):
    """A log of a plan, whose clock runs fast."""
    def moved(i, t, x, y):
        u = t / (1 + drift)
        return f"{t:.4f},{40 * math.sin(0.8 * u):.9f},{2 * u:.9f}"
    head = "t_s,x_mm,y_mm\n"
    plan = log(d / "plan.csv", head, lambda i, t, x, y: f"{t:.4f},{40 * math.sin(0.8 * t):.9f},{2 * t:.9f}", 4000)
    run(trace(plan), d / "plan")
    return trace(log(d / "log.csv", head, moved, 4000), "--planned", d / "plan")


def floored(run, d, floor_s):
    """Dwell times with a least dwell time."""
    run(raster(d), d / "path")
    return ["dwell", "bounded-least-squares", "--surface", d / "surface", "--tif", d / "tif", "--tool-path", d / "path",
            "--min-dwell-s", floor_s]


def pivot_in_metres(made):
    made["kinematics"]["pivot_mm"] = 0.08


def planned(run, d, **inputs):
    """A plan of the coupon, on inputs that may be mistaken."""
    run(raster(d, **inputs), d / "path")
    mirror = ["--surface", d / "surface", "--tif", d / "tif"]
    run(["dwell", "bounded-least-squares", *mirror, "--tool-path", d / "path", "--min-dwell-s", 0.01], d / "dwell")
    run(["schedule", "pvt", "--tool-path", d / "path", "--dwell", d / "dwell", "--machine", d / "machine.json"], d / "motion")


def budgeted(run, d, size, unit):
    """A plan and the errors of its process."""
    planned(run, d)
    error = {"kind": "rate_scale", "size": size, "unit": unit, "distribution": "normal", "note": "repeatability"}
    process = text(d / "process.json", json.dumps({"name": "process", "errors": [error]}))
    return ["tolerance", "--surface", d / "surface", "--tif", d / "tif", "--trajectory", d / "motion", "--error-budget", process]


def executed(run, d, map_of, tool_of):
    """The motion of a plan, simulated on the map and with the tool that are right."""
    planned(run, d, surface=lambda: map_of(d / "surface"), tif=lambda: tool_of(d / "tif"))
    return ["simulate", "--trajectory", d / "motion", "--surface", surface(d / "right-map"), "--tif", tif(d / "right-tif")]


def pad(d, radius_mm):
    """A pad of 2.5 mm with this radius."""
    offsets = [0.25 * i for i in range(-11, 12)]
    rows = [[max(0.0, 5 * (1 - (x * x + y * y) / 6.25)) for x in offsets] for y in offsets]
    flags = ["--surface", surface(d / "s"), "--tif", arrays(d / "pad", "rate_nm_per_s.npy", rows, offsets, offsets)]
    return ["surface", "tool-edge", *flags, "--pad-radius-mm", radius_mm, "--error", 0.1]


# Name, command in a directory, words that name the mistake; no words for a file without one.
CASES = [
    ("right: log", lambda run, d: trace(log(d / "l.csv", "t (s),x (mm),y (mm)\n", plain)), None),
    ("right: path", lambda run, d: raster(d), None),
    ("right: disk", lambda run, d: prepare(d, surface(d / "s", change=disk(False)), "--aperture-circle-mm", 10, 6, 5.5), None),
    ("right: profile", lambda run, d: spec(profile(d / "p.csv", "x (mm),slope (urad)\n"), "--value-unit", "urad"), None),
    ("right: spot", lambda run, d: spot(d, False), None),
    ("right: drift", lambda run, d: with_plan(run, d, 0), None),
    ("right: budget", lambda run, d: budgeted(run, d, 1, "%"), None),
    ("right: plan", lambda run, d: executed(run, d, surface, tif), None),
    ("right: pad", lambda run, d: pad(d, 2.5), None),
    ("log: um, mm given", lambda run, d: trace(log(d / "l.csv", "t (s),x (micron),y (micron)\n", plain), "--unit", "mm"), "in um"),
    ("log: inches, mm given", lambda run, d: trace(log(d / "l.csv", "t (s),x (in),y (in)\n", plain), "--unit", "mm"), "in in"),
    ("log: unknown unit", lambda run, d: trace(log(d / "l.csv", "t (s),x (furlong),y (mm)\n", plain), "--unit", "mm"), "furlong"),
    ("log: velocities for positions", lambda run, d: trace(log(d / "l.csv", "t_s,x (mm/s),y (mm/s)\n", plain), "--unit", "mm"), "mm/s"),
    ("log: minutes, s given", lambda run, d: trace(log(d / "l.csv", "time (min),x_mm,y_mm\n", plain), "--time-unit", "s"), "in min"),
    ("log: ns, us given", lambda run, d: trace(log(d / "l.csv", "time_ns,x_mm,y_mm\n", plain), "--time-unit", "us"), "in ns"),
    ("log: ms since 1970 as s", lambda run, d: trace(log(d / "l.csv", "time,x_mm,y_mm\n", lambda i, t, x, y: f"{1760000000000 + i},{x:.6f},{y:.6f}"), "--time-unit", "s"), "ms since 1970"),
    ("log: days without a unit", lambda run, d: trace(log(d / "l.csv", "time,x_mm,y_mm\n", lambda i, t, x, y: f"{46082 + t / 86400:.10f},{x:.6f},{y:.6f}")), "days of a spreadsheet"),
    ("log: y recorded 3 ms later", lambda run, d: trace(log(d / "l.csv", "", channels), "--time", 1, "--x", 2, "--y", 4, "--time-unit", "ms", "--unit", "mm"), "time of y"),
    ("log: jump of 64 mm", lambda run, d: trace(log(d / "l.csv", "t_s,x_mm,y_mm\n", jump)), "x jumps by 64"),
    ("log: clock 40 ppm fast", lambda run, d: with_plan(run, d, 40e-6), "40 parts per million"),
    ("log: z beside x and y", lambda run, d: trace(log(d / "l.csv", "t_s,x_mm,y_mm,z_mm\n", lambda i, t, x, y: plain(i, t, x, y) + f",{x}")), "positions of z"),
    ("log: marks of thousands", lambda run, d: trace(log(d / "l.csv", "t_s;x_um;y_um\n", lambda i, t, x, y: f"{i};{1 + i % 9},{i % 1000:03d};2,{i % 1000:03d}"), "--rate-hz", 1000), "thousands"),
    ("log: damaged line", lambda run, d: trace(log(d / "l.csv", "t_s,x_mm,y_mm\n", lambda i, t, x, y: "###" if i == 99 else "broken,line,here" if i == 100 else plain(i, t, x, y))), "line 102"),
    ("profile: arcsec, urad given", lambda run, d: spec(profile(d / "p.csv", "x (mm),slope (arcsec)\n"), "--value-unit", "urad"), "arcsec"),
    ("profile: m, mm given", lambda run, d: spec(profile(d / "p.csv", "x (m),slope (urad)\n"), "--value-unit", "urad", "--position-unit", "mm"), "give --position-unit m"),
    ("profile: slopes of .slp2 as urad", lambda run, d: spec(profile(d / "p.slp2", '[header]\nSlopes_Xmin = "\n', end='"\n[end]\n'), "--value-unit", "urad"), "mrad"),
    ("fiducials: without a unit", lambda run, d: ["register", "fit", text(d / "f.csv", "map_x,map_y,machine_x,machine_y\n0,0,1,1\n5,0,6,1\n0,5,1,6\n")], "without a unit"),
    ("fiducials: degrees", lambda run, d: ["register", "fit", text(d / "f.csv", "map_x_mm,map_y_mm,machine_x (deg),machine_y_mm\n0,0,1,1\n5,0,6,1\n0,5,1,6\n")], "no length"),
    ("TIF in nm/min", lambda run, d: raster(d, tif=lambda: tif(d / "tif", factor=60)), "nm/min"),
    ("TIF in um/s", lambda run, d: raster(d, tif=lambda: tif(d / "tif", factor=1e-3)), "um/s"),
    ("TIF in um/min", lambda run, d: raster(d, tif=lambda: tif(d / "tif", factor=0.06)), "um/min"),
    ("depth of 60 s for a rate", lambda run, d: raster(d, tif=lambda: tif(d / "tif", factor=60)), "depth for a rate"),
    ("heights in um", lambda run, d: prepare(d, surface(d / "s", factor=1e-3), "--level", "piston"), "in um"),
    ("heights in angstrom", lambda run, d: raster(d, surface=lambda: surface(d / "surface", factor=10)), "angstrom"),
    ("map in pixels", lambda run, d: raster(d, surface=lambda: surface(d / "surface", lateral=4)), "pixels"),
    ("TIF in pixels", lambda run, d: raster(d, tif=lambda: tif(d / "tif", lateral=4)), "pixels"),
    ("map in inches", lambda run, d: raster(d, surface=lambda: surface(d / "surface", lateral=1 / 25.4)), "inches"),
    ("map in um", lambda run, d: raster(d, surface=lambda: surface(d / "surface", lateral=1000)), "um"),
    ("travel in cm", lambda run, d: raster(d, machine=lambda: machine(d / "m.json", change=travel(3))), "cm"),
    ("limits in m/s", lambda run, d: raster(d, machine=lambda: machine(d / "m.json", change=slow(1e-3))), "m/s"),
    ("angle of the lines in rad", lambda run, d: raster(d, flags=["--angle-deg", 0.7854]), "radians"),
    ("rotary axes in rad", lambda run, d: raster(d, machine=lambda: machine(d / "m.json", "bonnet-five-axis", rotary_in_radians)), "radians"),
    ("incidences in rad", lambda run, d: ["tool", "incidence", "--surface", surface(d / "s"), "--tif", tif(d / "t"), "--sphere-radius-mm", 60, "--table", text(d / "t.txt", "0 1\n0.3 1.1\n0.6 1.3\n1.2 1.5\n")], "radians"),
    ("baseline under the TIF", lambda run, d: raster(d, tif=lambda: tif(d / "tif", floor=0.5)), "baseline"),
    ("TIF cropped", lambda run, d: raster(d, tif=lambda: tif(d / "tif", half=5)), "cropped"),
    ("diameter for the radius", lambda run, d: prepare(d, surface(d / "s", change=disk(False)), "--aperture-circle-mm", 10, 6, 11.5), "diameter for a radius"),
    ("radius for the diameter", lambda run, d: prepare(d, surface(d / "s", change=disk(False)), "--aperture-circle-mm", 10, 6, 2.9), "half of the radius"),
    ("inverted mask", lambda run, d: prepare(d, surface(d / "s", change=disk(True))), "inverted mask"),
    ("tilt of the measurement", lambda run, d: prepare(d, surface(d / "s", change=lambda z, x, y: z + 30 * x), "--level", "piston"), "tilt"),
    ("9999 for no data", lambda run, d: prepare(d, surface(d / "s", change=lambda z, x, y: 9999.0 if x < 2 else z)), "without data"),
    ("pivot in m", lambda run, d: raster(d, machine=lambda: machine(d / "m.json", "bonnet-five-axis", pivot_in_metres)), "metres"),
    ("budget: fraction as percent", lambda run, d: budgeted(run, d, 0.05, "%"), "would be 5 %"),
    ("budget: percent as fraction", lambda run, d: budgeted(run, d, 5, "1"), 'the unit "%" for 5 %'),
    ("pad: diameter for the radius", lambda run, d: pad(d, 5), "it would be 2.5 mm"),
    ("plan: sign of the map", lambda run, d: executed(run, d, lambda at: surface(at, factor=-1), tif), "sign of the map"),
    ("plan: tool 5 times too weak", lambda run, d: executed(run, d, surface, lambda at: tif(at, factor=0.2)), "another unit or rate"),
    ("before and after swapped", lambda run, d: spot(d, True), "before"),
    ("floor in ms", lambda run, d: floored(run, d, 5), "least dwell time"),
    ("xyz: angstrom, nm given", lambda run, d: ["import", "surface", xyz(d / "m.xyz", "x (mm) y (mm) z (A)\n", 10), "--unit", "nm"], "angstrom|Angstrom"),
    ("xyz: um in a comment, nm given", lambda run, d: ["import", "surface", xyz(d / "m.xyz", "# x[mm] y[mm] z[um]\n", 1e-3), "--unit", "nm", "--coordinate-unit", "mm"], r"\bum\b|\bUm\b"),
]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binaries", type=Path)
    parser.add_argument("--only", default="")
    arguments = parser.parse_args()
    binaries = arguments.binaries.resolve()

    def run(command, out):
        program, *words = [str(word) for word in command]
        ended = subprocess.run([binaries / f"planish-{program}", *words, "--out", out], capture_output=True, text=True,
                               timeout=120)
        # Arrays without a manifest are said to be such, and are no mistake.
        lines = [line for line in ended.stderr.splitlines() if "no manifest.json" not in line]
        return ended.returncode, "\n".join(lines)

    silent, others, doubted, count = [], [], [], 0
    for name, make, words in CASES:
        if arguments.only not in name:
            continue
        with tempfile.TemporaryDirectory() as folder:
            d = Path(folder)
            code, said = run(make(run, d), d / "out")
        message = said.replace(str(d), "").strip().splitlines()
        named = words is not None and re.search(words, said) is not None
        how = {0: "warning", 1: "verdict", 2: "refused"}.get(code, f"exit {code}")
        if words is None:
            verdict = "right" if code == 0 and not said else "doubted"
            doubted += [name] if verdict == "doubted" else []
        elif named:
            verdict = how
        else:
            verdict = "other" if said else "silent"
            (others if said else silent).append(name)
        count += words is not None
        first = next((line for line in message if words and re.search(words, line)), message[0] if message else "")
        print(f"{verdict:8} | {name:32} | {first[:150]}")
    print(f"{count} mistakes: {count - len(silent) - len(others)} named, {len(others)} with other words, {len(silent)} silent; "
          f"{len(doubted)} right files doubted")
    return 1 if len(silent) > MOST_SILENT or doubted else 0


if __name__ == "__main__":
    sys.exit(main())
