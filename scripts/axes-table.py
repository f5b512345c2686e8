#!/usr/bin/env python3
"""Table of docs/axes.md: joint plans with and without rows for all axes of a machine, as motions of these axes.

axes-table.py [--out DIR] [--rows NAME,...]

Every row is a plan by planish-joint, its motion by planish-axes and the verdict of planish-verify on all axes. The exit code
is 1 if a plan with rows exceeds a limit, or if its axes take more than 0.5 % longer. DIR is out/axes-table by default.
"""

import argparse
import json
import math
import pathlib
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
    """Runs a program of Planish; its exit code."""
    program, *arguments = [str(c) for c in command]
    done = subprocess.run([BIN / program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode not in allowed:
        sys.exit(f"{' '.join([program, *arguments])}\n{done.stdout}")
    return done.returncode


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
    run("planish-joint", *part, "--tool-path", path, "--machine", machine, *flags, *PRICE, "--out", to, "--force")


def followed(to, part, machine, form):
    """The report on the motion of all axes for the plan in `to`, the RMS that it leaves, nm, and whether it keeps their limits."""
    run("planish-axes", "motion", "--trajectory", to / "trajectory", "--machine", machine, "--form", form, "--out",
        to / "axes", "--force")
    kept = run("planish-verify", "--axes", to / "axes", "--machine", machine, "--out", to / "verdict", "--force",
               allowed=(0, 1)) == 0
    run("planish-axes", "contact", "--axes", to / "axes", "--machine", machine, "--form", form, "--out", to / "executed",
        "--force")
    run("planish-simulate", "--trajectory", to / "executed", *part, "--out", to / "removal", "--force", allowed=(0, 1))
    return outcome(to / "axes"), outcome(to / "removal")["rms_nm"], kept


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
    show("machine", "edge slope", "path", "x and y alone: nm", "s", "on the axes: nm", "s", "all axes: nm", "s",
         "on the axes: nm", "s", "added", "near a limit for most of the time")
    show(*["---"] * 13)
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
            of_axes, rms_nm, kept = followed(plan, part, machine, form)
            added = of_axes["total_time_s"] / of_axes["planned_time_s"] - 1.0
            cells += [f"{of_plan['rms_nm']:.4f}", f"{of_plan['total_time_s']:.2f}", f"{rms_nm:.4f}",
                      f"{of_axes['total_time_s']:.2f}"]
        failed |= not kept or added > MOST_ADDED or of_axes["contact_deviation_um"] > 2.0
        show(*cells, f"{100 * added:.4f} %" if kept else "limits exceeded", most_limiting(of_plan["report"]))
    return failed


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "out/axes-table")
    parser.add_argument("--rows", default="", help="machines, separated by commas; all without it")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if table(args.out, [name for name in args.rows.split(",") if name]):
        sys.exit("a plan with rows for all axes exceeds a limit, or its axes take longer")


if __name__ == "__main__":
    main()
