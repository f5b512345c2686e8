#!/usr/bin/env python3
"""Tables of docs/controller-programs.md and of the CSV files beside it: plans as programs, read back and judged.

programs-table.py [--out DIR] [--rows NAME,...] [--controllers NAME,...] [--machine FILE]
                  [--grids | --axes | --at-limits N]

Without --grids: the rows of ROWS, every plan, every controller, then the worst of each plan; --rows may name those of
NAMED_ROWS, too. With --grids: clocks and counts. With --axes: the rows of AXES_ROWS, motions of all axes. With --at-limits: N random plans that use an
acceleration limit fully, as G-code on random clocks and counts; of a refusal, the program after its remedy. DIR is
out/programs/MACHINE by default.
Plans that are in DIR already are not made again. Every number is of the program as planish-import reads it:
planish-simulate predicts its residual, planish-verify judges its limits.
"""

import argparse
import json
import os
import pathlib
import random
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
BIN = pathlib.Path(os.environ.get("PLANISH_PROGRAMS", ROOT / "target/release"))
# Without a limit on jerk, because its plans use the full acceleration more.
MACHINE = ROOT / "fixtures/machines/ion-beam-no-jerk-limit.json"
# Controllers whose programs are cubics between two lines: together in the table of the worst.
PVT_CONTROLLERS = ["galil", "xps", "pmac", "csv", "ros", "aerotech", "automation1", "sinumerik-poly", "twincat", "zaber"]
LINES = ["gcode", "sinumerik", "xps-pt"]
CONTROLLERS = [*PVT_CONTROLLERS, *LINES]
# Flags by which a program switches the tool. Where no program does, the tool of a plan with lifts stays on.
SWITCHES = {"pmac": ["--tool-output", "1"], "csv": [], "gcode": [], "twincat": []}

RASTER = ["raster", "--pitch-mm=1", "--step-mm=1"]
MAZE = ["maze", "--pitch-mm=1.2", "--step-mm=1.2"]
RANDOM = ["random-adaptive", "--pitch-mm=1"]
SPIRAL = ["spiral", "--pitch-mm=1.3", "--step-mm=1"]
MULTI = ["multi-pitch", "--max-velocity-mm-per-s=5", "--step-mm=1"]
# Name: fixture (None: the measured mirror in PLANISH_REFERENCE), path, flags of the dwell times, plans.
ROWS = {
    "raster": ("flat-92x16", RASTER, [], ["pvt", "joint"]),
    "maze": ("flat-92x16", MAZE, [], ["pvt", "joint"]),
    "random-adaptive": ("flat-92x16", RANDOM, [], ["pvt", "joint"]),
    "spiral": ("disk-100", SPIRAL, [], ["pvt", "joint"]),
    # docs/joint.md: the joint plan takes minutes along lines this close.
    "multi-pitch": ("square-200", MULTI, ["--min-dwell-s-per-mm=0.2"], ["pvt"]),
}
GRID_ROWS = {
    "coupon raster": ("coupon", RASTER, [], ["pvt", "joint"]),
    "flat-92x16 raster": ("flat-92x16", RASTER, [], ["pvt", "joint"]),
    "reference raster": (None, RASTER, [], ["pvt", "joint"]),
    "reference maze": (None, MAZE, [], ["pvt", "joint"]),
}
# Rows that are made only where --rows names them.
NAMED_ROWS = {"coupon maze": ("coupon", MAZE, [], ["pvt", "joint"]), **GRID_ROWS}
# Name: fixture, path, machine, keys of the machine file that are set, form of the part. The slope of the sphere is 10
# degrees at the ends of the coupon of 20 mm.
SPHERE = {"kind": "sphere", "radius_mm": -57.6, "vertex_mm": [10, 6]}
AXES_ROWS = {
    "coupon raster on five axes": ("coupon", ["raster", "--pitch-mm=0.8", "--step-mm=0.8"], "bonnet-five-axis", {}, SPHERE),
    "coupon spiral on a spindle": ("coupon", ["spiral", "--pitch-mm=0.8", "--step-mm=0.8"], "spindle",
                               {"part_origin_mm": [-10, -6]}, SPHERE),
}
TICKS_S = [0.0005, 0.001, 0.002, 0.004]
COUNTS_MM = [0.0001, 0.001]


def run(*command, allowed=(0,)):
    """Runs a program of Planish; the text of its last line."""
    program, *arguments = [str(c) for c in command]
    done = subprocess.run([BIN / program, *arguments], capture_output=True, text=True)
    if done.returncode not in allowed:
        sys.exit(f"{' '.join([program, *arguments])}\n{done.stdout}{done.stderr}")
    return done


def outcome(directory):
    return json.loads((directory / "manifest.json").read_text())["outcome"]


def prepare(to, fixture, path, dwell, plans):
    """Surface, TIF, path and plans of a row in `to`."""
    to.mkdir(parents=True, exist_ok=True)
    if fixture is None:
        if "PLANISH_REFERENCE" not in os.environ:
            return False
        subprocess.run(["just", "reference-mirror", to], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        surface, tif = to / "surface", to / "tif"
    else:
        run("planish-fixture", ROOT / f"fixtures/{fixture}.json", "--out", to / "fixture", "--force")
        surface, tif = to / "prepared", to / "fixture/tif"
        run("planish-surface", "prepare", "--surface", to / "fixture/surface", "--level", "piston", "--out", surface,
            "--force")
    part = ["--surface", surface, "--tif", tif]
    run("planish-toolpath", *path, *part, "--machine", MACHINE, "--out", to / "path", "--force")
    along = ["--tool-path", to / "path"]
    least = dwell or [f"--min-dwell-of-machine={MACHINE}"]
    run("planish-dwell", "bounded-least-squares", *part, *along, *least, "--out", to / "dwell", "--force",
        allowed=(0, 1))
    run("planish-schedule", "pvt", *along, "--dwell", to / "dwell", "--machine", MACHINE, "--out", to / "pvt", "--force",
        allowed=(0, 1))
    if "joint" in plans:
        run("planish-joint", *part, *along, "--machine", MACHINE, *dwell, "--out", to / "joint", "--force", allowed=(0, 1))
    (to / "part.json").write_text(json.dumps([str(surface), str(tif)]))
    return True


def residual(to, trajectory, name):
    surface, tif = json.loads((to / "part.json").read_text())
    run("planish-simulate", "--trajectory", trajectory, "--surface", surface, "--tif", tif, "--out", to / name, "--force")
    return outcome(to / name)["rms_nm"]


def judge(to, plan, controller, flags):
    """A line of the table: the plan as a program, read back."""
    trajectory = to / {"pvt": "pvt", "joint": "joint/trajectory"}[plan]
    planned = to / f"planned-{plan}.json"
    if not planned.exists():
        planned.write_text(json.dumps(residual(to, trajectory, f"removal-{plan}")))
    rms = json.loads(planned.read_text())
    program = to / f"{plan}-{controller}"
    lifts = outcome(to / "path").get("lifts", 0) if (to / "path/manifest.json").exists() else 0
    if lifts:
        flags = [*flags, *SWITCHES.get(controller, ["--always-on"])]
    made = run("planish-export", controller, "--trajectory", trajectory, "--machine", MACHINE, *flags, "--out", program,
               "--force", allowed=(0, 1, 2))
    if made.returncode == 2:
        return None, f"refused: {made.stderr.strip().splitlines()[-1]}"
    about = json.loads(pathlib.Path(f"{program}.json").read_text())
    back = to / f"{plan}-{controller}-back"
    run("planish-import", "program", program, "--controller", controller, "--about", f"{program}.json", "--out", back,
        "--force")
    kept = run("planish-verify", "--trajectory", back, "--machine", MACHINE, "--out", to / "verdict", "--force",
               allowed=(0, 1)).returncode == 0
    program_rms = residual(to, back, "removal-program")
    # The tool that stays on in a lift removes there: no comparison with the plan.
    stays_on = "--always-on" in flags
    return {
        "segments": about["segments"],
        "rms": None if stays_on else program_rms / rms,
        "time": about["total_time_s"] / (about["total_time_s"] - about["added_time_s"]),
        "deviation_um": 1e3 * about["path_deviation_mm"],
        "used": {p["quantity"]: p["value"] / p["limit"] for p in about["limits"]["largest"]},
        "kept": kept,
    }, f"{rms:.4f} nm in {about['total_time_s'] - about['added_time_s']:.2f} s"


def table_of_axes(out, names, controllers):
    """The table of motions of all axes: every row, every one of `controllers`."""
    show(["plan", "controller", "segments", "residual", "time", "contact um", "largest use of a limit", "kept"])
    show(["---"] * 8)
    for name in names:
        fixture, path, machine, keys, form = AXES_ROWS[name]
        to = out / name.replace(" ", "-")
        to.mkdir(parents=True, exist_ok=True)
        stated = json.loads((ROOT / f"fixtures/machines/{machine}.json").read_text())
        (to / "machine.json").write_text(json.dumps({**stated, **keys}))
        (to / "form.json").write_text(json.dumps(form))
        run("planish-fixture", ROOT / f"fixtures/{fixture}.json", "--out", to / "fixture", "--force")
        surface, tif = to / "fixture/surface", to / "fixture/tif"
        (to / "part.json").write_text(json.dumps([str(surface), str(tif)]))
        run("planish-toolpath", *path, "--surface", surface, "--tif", tif, "--out", to / "path", "--force")
        along = ["--tool-path", to / "path"]
        run("planish-dwell", "bounded-least-squares", "--surface", surface, "--tif", tif, *along, "--out", to / "dwell",
            "--force", allowed=(0, 1))
        on, over = ["--machine", to / "machine.json"], ["--form", to / "form.json"]
        run("planish-schedule", "pvt", *along, "--dwell", to / "dwell", *on, "--out", to / "pvt", "--force",
            allowed=(0, 1))
        run("planish-axes", "motion", "--trajectory", to / "pvt", *on, *over, "--out", to / "axes", "--force")

        def left(axes):
            run("planish-axes", "contact", "--axes", axes, *on, *over, "--out", to / "contact", "--force")
            return residual(to, to / "contact", "removal")

        rms = left(to / "axes")
        for controller in controllers:
            program, back = to / f"program-{controller}", to / f"back-{controller}"
            flags = ["--rotary-lines"] if controller == "gcode" else []
            run("planish-export", controller, "--axes", to / "axes", *on, *over, *flags, "--out", program, "--force")
            about = json.loads(pathlib.Path(f"{program}.json").read_text())
            run("planish-import", "program", program, "--controller", controller, "--about", f"{program}.json", "--out",
                back, "--force")
            kept = run("planish-verify", "--axes", back, *on, "--out", to / "verdict", "--force",
                       allowed=(0, 1)).returncode == 0
            planned_s = about["total_time_s"] - about["added_time_s"]
            line = {
                "rms": left(back) / rms,
                "time": about["total_time_s"] / planned_s,
                "deviation_um": 1e3 * about["contact_deviation_mm"],
                "used": {p["quantity"]: p["value"] / p["limit"] for p in about["limits"]["largest"]},
                "kept": kept,
            }
            show([f"{name}: {rms:.4f} nm in {planned_s:.2f} s", controller, str(about["segments"]), *cells(line)])


def random_plan(to, number):
    """A plan that uses an acceleration limit fully, in `to`; the method, or None where the limit is not reached."""
    global MACHINE
    draw = random.Random(number)
    pitch = draw.uniform(0.7, 1.3)
    path = draw.choice([["raster", f"--step-mm={pitch}"], ["maze", f"--step-mm={pitch}"], ["random-adaptive"],
                        ["spiral", f"--step-mm={pitch}"]])
    acceleration = 10 ** draw.uniform(1.3, 3.3)
    limits = [(draw.uniform(20, 250), acceleration * ratio) for ratio in (1, draw.choice([0.5, 0.73, 1]))]
    plan = draw.choice(["pvt", "pvt", "pvt", "joint"])
    to.mkdir(parents=True, exist_ok=True)
    MACHINE = to / "machine.json"
    if not (to / "part.json").exists():
        axes = [{"name": name, "max_velocity_mm_per_s": v, "max_acceleration_mm_per_s2": a}
                for name, (v, a) in zip("xy", limits)]
        MACHINE.write_text(json.dumps({"name": f"random {number}", "time_to_full_acceleration_s": 0, "axes": axes}))
        path = [path[0], f"--pitch-mm={pitch}", *path[1:]]
        if path[0] == "random-adaptive":
            path.append(f"--seed={number}")
        prepare(to, draw.choice(["coupon", "coupon", "coupon-ring", "flat-92x16"]), path, [], [plan])
    trajectory = to / {"pvt": "pvt", "joint": "joint/trajectory"}[plan]
    run("planish-verify", "--trajectory", trajectory, "--machine", MACHINE, "--out", to / "verdict", "--force",
        allowed=(0, 1))
    used = outcome(to / "verdict")["max_acceleration_mm_per_s2"]
    return plan, path[0], max(u / a for u, (_, a) in zip(used, limits))


def table_at_limits(out, count, first):
    """Random plans at their acceleration limit as G-code, on random clocks and counts."""
    show(["plan", "use of the limit", "clock ms", "count um", "first answer", "residual", "time", "kept"])
    show(["---"] * 8)
    number, drawn, good = first, 0, 0
    while drawn < count:
        number += 1
        to = out / str(number)
        plan, path, used = random_plan(to, number)
        if used < 0.98:
            continue
        drawn += 1
        draw = random.Random(1000 + number)
        tick, size = draw.choice([None, None, 5e-4, 1e-3, 2e-3, 4e-3]), draw.choice([None, 1e-4, 1e-3])
        flags = {"--tick-s": tick, "--count-mm": size}
        given = [f"{flag}={value:g}" for flag, value in flags.items() if value]
        line, answer = judge(to, plan, "gcode", given)
        first_answer = "program" if line else answer
        if line is None:
            # The flags that the remedy names, with its numbers.
            named = re.findall(r"(--[a-z-]+)[ =]([0-9.e-]+)", answer.split("give ", 1)[-1])
            first_answer = "refused: " + " ".join(f"{name} {value}" for name, value in named)
            kept = [f for f in given if f.split("=")[0] not in [name for name, _ in named]]
            line, answer = judge(to, plan, "gcode", [*kept, *(f"{name}={value}" for name, value in named)])
        shown = [f"{number}: {path}, {plan}", f"{used:.4f}", f"{1e3 * tick:g}" if tick else "-",
                 f"{1e3 * size:g}" if size else "-", first_answer]
        if line is None:
            show([*shown, answer, "", ""])
            continue
        good += line["rms"] <= 1.02 and line["time"] <= 1.02 and line["kept"]
        show([*shown, f"{line['rms']:.4f}", f"{line['time']:.5f}", "yes" if line["kept"] else "no"])
    print(f"{good} of {drawn} with at most 1.02 times the residual and the time of the plan")


def show_worst(judged):
    """The worst residual, time and path of each plan, over the controllers with PVT segments, then over those with
    lines. `judged` has a plan, a controller and a line of the table each."""
    names = [f"{kind} {column}" for kind in ("PVT", "lines") for column in ("residual", "time", "path um")]
    print(flush=True)
    show(["plan", *names])
    show(["---"] * 7)
    for plan in dict.fromkeys(plan for plan, _, _ in judged):
        worst = []
        for controllers in (PVT_CONTROLLERS, LINES):
            lines = [line for name, controller, line in judged if name == plan and controller in controllers]
            # Without a residual the tool stays on in the lifts.
            residuals = [line["rms"] for line in lines if line["rms"] is not None]
            worst.append(f"{max(residuals):.4f}" if residuals else "-")
            worst.append(f"{max(line['time'] for line in lines):.5f}" if lines else "-")
            worst.append(f"{max(line['deviation_um'] for line in lines):.2f}" if lines else "-")
        show([plan, *worst])


def cells(line):
    rms = "tool stays on" if line["rms"] is None else f"{line['rms']:.4f}"
    used = max(line["used"].values()) if line["used"] else 0.0
    which = max(line["used"], key=line["used"].get) if line["used"] else "-"
    return [rms, f"{line['time']:.5f}", f"{line['deviation_um']:.2f}", f"{100 * used:.3f} % ({which})",
            "yes" if line["kept"] else "no"]


def show(cells):
    print("| " + " | ".join(cells) + " |", flush=True)


def main():
    global MACHINE
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--out", type=pathlib.Path)
    ask.add_argument("--rows", default="")
    ask.add_argument("--controllers", default=",".join(CONTROLLERS))
    ask.add_argument("--grids", action="store_true")
    ask.add_argument("--axes", action="store_true")
    ask.add_argument("--at-limits", type=int, metavar="N")
    ask.add_argument("--first", type=int, default=0)
    ask.add_argument("--machine", type=pathlib.Path, default=MACHINE)
    given = ask.parse_args()
    controllers = given.controllers.split(",")
    MACHINE = given.machine.resolve()
    out = given.out or ROOT / "out/programs" / MACHINE.stem
    if given.at_limits:
        return table_at_limits(given.out or ROOT / "out/programs/at-limits", given.at_limits, given.first)
    if given.axes:
        names = given.rows.split(",") if given.rows else AXES_ROWS
        return table_of_axes(given.out or ROOT / "out/programs/axes", names, controllers)
    rows = {**ROWS, **NAMED_ROWS}
    names = given.rows.split(",") if given.rows else list(GRID_ROWS if given.grids else ROWS)
    if given.grids:
        show(["plan", "controller", "tick ms", "count um", "residual", "time", "path um", "largest use of a limit", "kept"])
        show(["---"] * 9)
    else:
        show(["plan", "controller", "segments", "residual", "time", "path um", "largest use of a limit", "kept"])
        show(["---"] * 8)
    judged = []
    for name in names:
        fixture, path, dwell, plans = rows[name]
        to = out / name.replace(" ", "-")
        if not (to / "part.json").exists() and not prepare(to, fixture, path, dwell, plans):
            print(f"left out, PLANISH_REFERENCE is not set: {name}", file=sys.stderr)
            continue
        for plan in plans:
            for controller in controllers:
                grids = [[]]
                if given.grids:
                    clock = "--sample-s={:g}".format if controller == "galil" else "--tick-s={:g}".format
                    # A Galil counts pairs of samples.
                    part = 0.5 if controller == "galil" else 1.0
                    grids = [[clock(part * t), f"--count-mm={c}"] for c in COUNTS_MM for t in TICKS_S]
                for flags in grids:
                    line, told = judge(to, plan, controller, flags)
                    grid = [f.split("=")[1] for f in flags]
                    if given.grids:
                        grid = [f"{1e3 * float(grid[0]) / part:g}", f"{1e3 * float(grid[1]):g}"]
                    first = [f"{name}, {plan}" + ("" if line is None else f": {told}"), controller]
                    if line is None:
                        show([*first, *grid, told])
                    else:
                        judged.append((first[0], controller, line))
                        show([*first, *(grid or [str(line["segments"])]), *cells(line)])
    if not given.grids:
        show_worst(judged)


if __name__ == "__main__":
    main()
