#!/usr/bin/env python3
"""Tables of docs/axes.md: joint plans with and without rows for all axes of a machine, as motions of these axes.

axes-table.py [--out DIR] [--rows NAME,...] [--planning]

Every row is a plan by planish-joint, its motion by planish-axes and the verdict of planish-verify on all axes. The exit code
is 1 if a plan with rows exceeds a limit, or if its axes take more than 0.5 % longer. With --planning: the processor time that
planish-joint takes for five axes on an asphere, over that for x and y alone. DIR is out/axes-table by default.
"""

import argparse
import json
import math
import os
import pathlib
import shutil
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
BIN = ROOT / "target/release"
# Largest time that the axes may add to a plan with rows, over its time.
MOST_ADDED = 5e-3
# The same price for all plans, so that their times compare.
PRICE = ["--time-weight-nm2-per-s", "1e-3"]
RASTER = ["raster", "--pitch-mm=1", "--step-mm=1", "--overscan-mm=3.5", "--line-origin-mm=0.5"]
SPIRAL = ["spiral", "--pitch-mm=1", "--step-mm=1", "--overscan-mm=1"]
# Machine, slope of the sphere at the ends of the part in degrees, path.
ROWS = [
    ("ion-beam-xyz", 20, RASTER),
    ("bonnet-five-axis", 20, RASTER),
    ("bonnet-five-axis", 10, RASTER),
    ("spindle", 20, SPIRAL),
    ("spindle", 20, RASTER),
]


def run(*command, allowed=(0,)):
    """Runs a program of Planish; its user time in s."""
    program, *arguments = [str(c) for c in command]
    child = subprocess.Popen([BIN / program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    text = child.stdout.read()
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode not in allowed:
        sys.exit(f"{' '.join([program, *arguments])}\n{text}")
    return usage.ru_utime, child.returncode


def outcome(directory):
    return json.loads((directory / "manifest.json").read_text())["outcome"]


def write(path, content):
    path.write_text(json.dumps(content))
    return path


def fixture(to, name, **changes):
    """Surface and tool of the recipe of the coupon with some changes."""
    recipe = json.loads((ROOT / "fixtures/coupon.json").read_text())
    recipe.update(changes)
    run("planish-fixture", write(to / f"{name}.json", recipe), "--out", to / name, "--force")
    return ["--surface", to / name / "surface", "--tif", to / name / "tif"]


def machines(to, name, middle_mm):
    """The machine with the part's middle in its origin, and the one that has nothing but its limits along x and y."""
    machine = json.loads((ROOT / f"fixtures/machines/{name}.json").read_text())
    plane = {key: machine[key] for key in ("name", "axes", "time_to_full_acceleration_s")}
    contact = machine["kinematics"].get("contact")
    plane["axes"] = [{"name": axis, **contact} for axis in "xy"] if contact else machine["axes"][:2]
    machine["part_origin_mm"] = [-v for v in middle_mm]
    return write(to / f"{name}.json", machine), write(to / f"{name}-plane.json", plane)


def planned(to, part, path, machine, form):
    flags = ["--form", form] if form else []
    return run("planish-joint", *part, "--tool-path", path, "--machine", machine, *flags, *PRICE, "--out", to, "--force")[0]


def followed(to, machine, form):
    """The report on the motion of all axes for the plan in `to`, and whether it keeps their limits."""
    run("planish-axes", "motion", "--trajectory", to / "trajectory", "--machine", machine, "--form", form, "--out",
        to / "axes", "--force")
    kept = run("planish-verify", "--axes", to / "axes", "--machine", machine, "--out", to / "verdict", "--force",
               allowed=(0, 1))[1] == 0
    return outcome(to / "axes"), kept


def most_limiting(report):
    """The limit that the plan is near for most of the time."""
    near = [(axis[f"time_near_{quantity}_limit"], f"{quantity} of {axis['name']}")
            for axis in report["axes"] for quantity in ("velocity", "acceleration")]
    part, name = max(near)
    return f"{name}, {100 * part:.1f} %" if part >= 5e-4 else "none"


def show(*cells):
    print("| " + " | ".join(cells) + " |", flush=True)


def table(to, names):
    part = fixture(to, "coupon", tif={"peak_nm_per_s": 50.0, "half_size_mm": 3.5, "shape": {"gaussian": {"sigma_mm": 1.0}}})
    middle_mm = [10.0, 6.0]
    show("machine", "edge slope", "path", "x and y alone: nm", "s", "s of the axes", "all axes: nm", "s", "s of the axes",
         "added", "near a limit for most of the time")
    show(*["---"] * 11)
    failed = False
    for name, slope_deg, path in ROWS:
        if names and name not in names:
            continue
        machine, plane = machines(to, name, middle_mm)
        sphere = {"kind": "sphere", "radius_mm": -10.0 / math.sin(math.radians(slope_deg)), "vertex_mm": middle_mm}
        form = write(to / f"sphere-{slope_deg}.json", sphere)
        run("planish-toolpath", *path, *part[:2], "--out", to / path[0], "--force")
        cells = [name, f"{slope_deg} deg", path[0]]
        for rows in (False, True):
            plan = to / f"{name}-{slope_deg}-{path[0]}-{'with' if rows else 'without'}"
            planned(plan, part, to / path[0], machine if rows else plane, form if rows else None)
            of_plan = outcome(plan / "trajectory")
            of_axes, kept = followed(plan, machine, form)
            added = of_axes["total_time_s"] / of_axes["planned_time_s"] - 1.0
            cells += [f"{of_plan['rms_nm']:.4f}", f"{of_plan['total_time_s']:.2f}", f"{of_axes['total_time_s']:.2f}"]
        failed |= not kept or added > MOST_ADDED or of_axes["contact_deviation_um"] > 2.0
        show(*cells, f"{100 * added:.4f} %" if kept else "limits exceeded", most_limiting(of_plan["report"]))
    return failed


def planning(to):
    part = fixture(to, "square", pixels=[81, 81], width_mm=40.0,
                   tif={"peak_nm_per_s": 60.0, "half_size_mm": 5.0, "shape": {"gaussian": {"sigma_mm": 1.5}}})
    middle_mm = [20.0, 20.0]
    machine, plane = machines(to, "bonnet-five-axis", middle_mm)
    form = write(to / "asphere.json", {"kind": "asphere", "radius_mm": -70.0, "conic_constant": -0.6, "even_terms": [2e-8],
                                       "vertex_mm": middle_mm})
    run("planish-toolpath", "spiral", "--pitch-mm=1", "--step-mm=0.268", "--overscan-mm=1", *part[:2], "--out", to / "turns",
        "--force")
    times = []
    for name, of_plan, over in (("x, y", plane, None), ("x, y, z, a, b", machine, form)):
        plan = to / f"planning-{len(times)}"
        # planish-joint does not make a plan again that is there.
        shutil.rmtree(plan, ignore_errors=True)
        times.append(planned(plan, part, to / "turns", of_plan, over))
        report = outcome(plan / "trajectory")
        print(f"{name}: {times[-1]:.2f} s of user time, {report['report']['nodes']} nodes, {report['end']}, "
              f"{report['report']['rounds']} rounds, {report['rms_nm']:.4f} nm in {report['total_time_s']:.2f} s", flush=True)
    points = len((to / "turns/point_mm.npy").read_bytes()) // 16
    print(f"{points} points: five axes over two: {times[1] / times[0]:.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "out/axes-table")
    parser.add_argument("--rows", default="", help="machines, separated by commas; all without it")
    parser.add_argument("--planning", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.planning:
        planning(args.out)
        return
    if table(args.out, [name for name in args.rows.split(",") if name]):
        sys.exit("a plan with rows for all axes exceeds a limit, or its axes take longer")


if __name__ == "__main__":
    main()
