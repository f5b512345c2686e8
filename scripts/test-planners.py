"""Runs programs in controllers that we did not write, and prints how the motion that they make compares with the plan.

    test-planners.py linuxcnc [--rows NAME,...] [--plans pvt,joint]      the trajectory planner of LinuxCNC
    test-planners.py readers  [--rows NAME,...]                         interpreters: positions to the last digit

The plans and programs are in out/planners; what is there already is not made again. Rows and columns are those of
docs/controller-programs.md.
"""

import argparse
import importlib.util
import json
import pathlib
import re
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
import linuxcnc  # noqa: E402


def load(name):
    """The script `name` as a module: its name has a hyphen."""
    spec = importlib.util.spec_from_file_location(name.replace("-", "_"), pathlib.Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


table = load("programs-table")
OUT = table.ROOT / "out/planners"
ROWS = {
    "coupon raster": ("coupon", table.RASTER, [], ["pvt", "joint"]),
    "flat-92x16 raster": ("flat-92x16", table.RASTER, [], ["pvt", "joint"]),
    "flat-92x16 maze": ("flat-92x16", table.MAZE, [], ["pvt", "joint"]),
    "disk-20 spiral": ("disk-20", table.SPIRAL, [], ["pvt", "joint"]),
    "flat-92x16 maze at 800 mm/s^2": ("flat-92x16", table.MAZE, [], ["pvt", "joint"]),
    "disk-20 spiral at 800 mm/s^2": ("disk-20", table.SPIRAL, [], ["pvt", "joint"]),
    "reference raster": (None, table.RASTER, [], ["pvt", "joint"]),
}
# Rows whose plans are for smaller limits than those of the simulated machine: acceleration of both axes, mm/s^2.
SLOWER = {"flat-92x16 maze at 800 mm/s^2": 800, "disk-20 spiral at 800 mm/s^2": 800}
# Programs of a plan: as planish-export writes it, with the feeds for the planner, and without our path mode. Flags, and
# the path mode in the place of that of the program.
MODES = {
    "as written": ([], None),
    "--linuxcnc-feeds": (["--linuxcnc-feeds"], None),
    "G64 alone": ([], "G64"),
}


def trajectory(to, plan):
    return to / {"pvt": "pvt", "joint": "joint/trajectory"}[plan]


def export(to, plan, controller, flags=(), ending=""):
    """The program of a plan; None with its message if planish-export refuses it."""
    program = to / f"{plan}{ending}.{controller}"
    if not program.exists():
        other = ["--other-machine"] if (to / "slower.json").exists() else []
        made = table.run("planish-export", controller, "--trajectory", trajectory(to, plan), "--machine", table.MACHINE,
                         *other, *flags, "--out", program, "--force", allowed=(0, 2))
        if made.returncode == 2:
            print(made.stderr.strip().splitlines()[-1], file=sys.stderr)
            return None
    return program


def export_mode(to, plan, mode):
    """The G-code of a plan in one of MODES, and the JSON file that says what it is; None if it is refused."""
    flags, path_mode = MODES[mode]
    program = export(to, plan, "gcode", flags, "-feeds" if flags else "")
    if program is None or path_mode is None:
        return program
    other = to / f"{plan}-{path_mode}.gcode"
    other.write_text(re.sub(r"^(G64 .*|G61)$", path_mode, program.read_text(), count=1, flags=re.M))
    pathlib.Path(f"{other}.json").write_text(pathlib.Path(f"{program}.json").read_text())
    return other


def execute(program):
    """The motion that LinuxCNC makes of `program`, as a log, and what it reported."""
    about = json.loads(pathlib.Path(f"{program}.json").read_text())
    log, said = pathlib.Path(f"{program}.csv"), pathlib.Path(f"{program}.said")
    if not said.exists():
        longest_s = 3 * about["total_time_s"] + 30
        has_many_lines = about["segments"] > linuxcnc.MANY_LINES_PER_S * about["total_time_s"]
        speed = 1 if has_many_lines else linuxcnc.FASTER
        said.write_text(linuxcnc.run(program, table.MACHINE, log, longest_s, speed))
    return log, said.read_text().strip()


# Samples at rest with the tool on, beside those of a dwell, from which the interpreter was too slow.
MOST_AT_REST = 20


def has_run(program, log):
    """True if the motion ends where the last line of the program does, and never waited for the interpreter."""
    rows = [line.split(",")[1:] for line in log.read_text().splitlines()[1:]]
    # At the end the tool is on until the interpreter has gone on.
    moves = [k for k in range(1, len(rows)) if rows[k][:-1] != rows[k - 1][:-1]]
    at_rest = sum(1 for k in range(1, moves[-1]) if rows[k] == rows[k - 1] and rows[k][-1] == "1")
    if at_rest > MOST_AT_REST and not re.search("^G4 P", program.read_text(), flags=re.M):
        return False
    last = re.findall(r"^G1 X(\S+) Y(\S+)", program.read_text(), flags=re.M)[-1]
    end = log.read_text().splitlines()[-1].split(",")[1:3]
    return all(abs(float(p) - float(q)) < 1e-3 for p, q in zip(last, end))


def used(log):
    """Largest use of a limit with the tool on, from the differences of the samples: name of the limit and fraction."""
    axes = json.loads(table.MACHINE.read_text())["axes"]
    rows = [line.split(",") for line in log.read_text().splitlines()[1:]]
    most, name = 0.0, "-"
    for k, axis in enumerate(axes):
        velocity, acceleration, _ = linuxcnc.limits(axis)
        p = [float(row[1 + k]) for row in rows]
        on = [row[-1] == "1" for row in rows]
        v = [(b - a) / linuxcnc.SERVO_PERIOD_S for a, b in zip(p, p[1:])]
        for i in range(1, len(v)):
            if not on[i]:
                continue
            a = (v[i] - v[i - 1]) / linuxcnc.SERVO_PERIOD_S
            for value, limit, what in [(v[i], velocity, "velocity"), (a, acceleration, "acceleration")]:
                if abs(value) / limit > most:
                    most, name = abs(value) / limit, f"{axis['name']} {what}"
    return most, name


def judge(to, program, log, planned_nm):
    """A line of the table: the executed motion beside the program."""
    about = json.loads(pathlib.Path(f"{program}.json").read_text())
    back = pathlib.Path(f"{program}-run")
    table.run("planish-import", "trace", log, "--tool-on", "tool_on", "--out", back, "--force", allowed=(0, 1))
    on_s = sum(1 for line in log.read_text().splitlines() if line.endswith(",1")) * linuxcnc.SERVO_PERIOD_S
    rms = table.residual(to, back, f"{back.name}-removal")
    fraction, name = used(log)
    planned_s = about["total_time_s"] - about["added_time_s"]
    return [f"{rms / planned_nm:.4f}", f"{on_s / planned_s:.5f}", f"{100 * fraction:.2f} % ({name})",
            "yes" if fraction <= 1.0 + 1e-3 else "no"]


def prepared(name):
    """Returns the folder with the plans of a row; None, with the reason on standard error, without its data."""
    to = OUT / name.replace("/", "-per-").replace(" ", "-")
    fixture, path, dwell, _ = ROWS[name]
    if (to / "part.json").exists():
        return to
    whole = table.MACHINE
    if name in SLOWER:
        stated = json.loads(whole.read_text())
        for axis in stated["axes"]:
            axis["max_acceleration_mm_per_s2"] = SLOWER[name]
        to.mkdir(parents=True, exist_ok=True)
        table.MACHINE = to / "slower.json"
        table.MACHINE.write_text(json.dumps(stated))
    is_here = table.prepare(to, fixture, path, dwell, ["pvt", "joint"])
    table.MACHINE = whole
    if is_here:
        return to
    print(f"left out, PLANISH_REFERENCE is not set: {name}", file=sys.stderr)
    return None


def run_linuxcnc(names, plans, modes):
    jobs = []
    for name in names:
        to = prepared(name)
        if to is None:
            continue
        for plan in plans:
            for mode in modes:
                program = export_mode(to, plan, mode)
                if program:
                    jobs.append((name, plan, mode, to, program))
    table.show(["plan", "program", "residual", "time", "largest use of a limit", "kept"])
    table.show(["---"] * 6)
    # One after the other: a simulator that ends has been seen to end another one.
    for name, plan, mode, to, program in jobs:
        log, said = execute(program)
        if not has_run(program, log):
            pathlib.Path(f"{program}.said").unlink()
            sys.exit(f"{program}: the run was interrupted, or the interpreter was too slow; run this again, what has "
                     "ended stays")
        planned = to / f"planned-{plan}.json"
        if not planned.exists():
            planned.write_text(json.dumps(table.residual(to, trajectory(to, plan), f"removal-{plan}")))
        planned_nm = json.loads(planned.read_text())
        about = json.loads(pathlib.Path(f"{program}.json").read_text())
        planned_s = about["total_time_s"] - about["added_time_s"]
        first = f"{name}, {plan}: {planned_nm:.4f} nm in {planned_s:.2f} s"
        table.show([first, mode, *(judge(to, program, log, planned_nm))])
        if said:
            print(f"{name}, {plan}, {mode}: LinuxCNC reports {said}", file=sys.stderr)


def words(text, pattern):
    """Numbers in the words of the program itself, in the order of its segments. `pattern` has a group for each of them."""
    return [tuple(map(float, numbers)) for numbers in re.findall(pattern, text, flags=re.M)]


def read_sinumerik(text):
    """Ends and F of the lines of a SINUMERIK program by nc-gcode-interpreter, and the floats of 32 bits in which it has
    them."""
    from nc_gcode_interpreter import nc_to_dataframe
    import numpy

    frame, _ = nc_to_dataframe(text, iteration_limit=10**8, disable_forward_fill=True)
    moves = frame.filter(frame["X"].is_not_null() & frame["Y"].is_not_null())
    return moves.select(["X", "Y", "F"]).to_numpy(), numpy.float32


def read_pmac(text):
    """Ends of the segments of a PMAC program by lexer and parser of dls-pmacanalyse."""
    from dls_pmacanalyse.pmacparser import PmacParser
    from dls_pmacanalyse.pmacstate import PmacState
    import numpy

    state = PmacState("planish")
    # The parser takes the tokens from the head of a list: the time is the square of their number.
    points = []
    lines = text.splitlines()
    for first in range(0, len(lines), LINES_OF_PMAC):
        part = ["OPEN PROGRAM 1 CLEAR", *lines[first:first + LINES_OF_PMAC], "CLOSE"]
        PmacParser(part, state).onLine()
        points += points_of_pmac([str(token) for token in state.getMotionProgram(1).v])
    return numpy.array(points), numpy.float64


# Lines of a program that are parsed at once.
LINES_OF_PMAC = 400


def points_of_pmac(tokens):
    """Positions in the tokens of a motion program: an axis, a sign, a number, a colon and the velocity."""
    points, point, k = [], {}, 0
    while k < len(tokens):
        if tokens[k] in ("X", "Y"):
            sign = -1.0 if tokens[k + 1] == "-" else 1.0
            number = tokens[k + 2] if tokens[k + 1] == "-" else tokens[k + 1]
            point[tokens[k]] = sign * float(number)
        if tokens[k] == "Y":
            points.append((point["X"], point["Y"]))
        k += 1
    return points


# Reader of each controller, and the pattern of its lines.
READERS = {
    "pmac": (read_pmac, r"^X(-?[0-9.]+)(?::\S+)? Y(-?[0-9.]+)"),
    "sinumerik": (read_sinumerik, r"^G1 X(\S+) Y(\S+) F(\S+)"),
}


def run_readers(names, plans):
    """A line for each program: the positions as an interpreter reads them, beside the words of the program."""
    import numpy

    known = table.run("planish-export", "--help").stdout
    table.show(["plan", "controller", "segments", "largest difference of a number"])
    table.show(["---"] * 4)
    for name in names:
        to = prepared(name)
        if to is None:
            continue
        for plan in plans:
            for controller, (read, pattern) in READERS.items():
                if f"  {controller} " not in known:
                    continue
                program = export(to, plan, controller)
                if not program:
                    continue
                text = program.read_text()
                points, kind = read(text)
                written = numpy.array(words(text, pattern))
                # A program that goes to its start has this position before its segments.
                points = points[len(points) - len(written):]
                apart = numpy.abs(numpy.asarray(points, kind) - written.astype(kind)).max()
                table.show([f"{name}, {plan}", controller, str(len(points)), f"{apart:g}"])


def main():
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("what", choices=["linuxcnc", "readers"])
    ask.add_argument("--rows", default=",".join(ROWS))
    ask.add_argument("--plans", default="pvt,joint")
    ask.add_argument("--modes", default=",".join(MODES))
    given = ask.parse_args()
    names, plans, modes = given.rows.split(","), given.plans.split(","), given.modes.split(",")
    if given.what == "linuxcnc":
        run_linuxcnc(names, plans, modes)
    else:
        run_readers(names, plans)


if __name__ == "__main__":
    main()
