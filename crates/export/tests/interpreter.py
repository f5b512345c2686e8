"""A G-code program as LinuxCNC understands it.

    python interpreter.py RUN        RUN/program.gcode of a run with export=gcode

The interpreter (rs274) against the table of the plan: it prints canonical calls, STRAIGHT_FEED(x, y, ...)
and SET_FEED_RATE(mm/min), both with four decimals, DWELL(s). A line takes 60 length / feed. Compared: every
end against the program's own words to half of the last decimal, and the total time against the header to
the 5e-5 of the feed. A run of lines from rest to rest takes half of its first and half of its last line longer.

Offsets that an operator left by G54 and G92 must not move a program for a machine whose file places the part.

The interpreter ignores outputs. So where LinuxCNC's simulator is installed (`linuxcnc`), a short program of
planish-export with every kind of switch runs in it (scripts/linuxcnc.py, root), in real time and twice, after a run
that has left the output on; digital output 0 and the position are sampled every millisecond.
"""

import json
import os
import pathlib
import re
import shutil
import struct
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "scripts"))
import linuxcnc  # noqa: E402


def interpret(program):
    with tempfile.TemporaryDirectory() as home:
        for name in ("tool.tbl", "empty.var"):
            pathlib.Path(home, name).touch()
        out = pathlib.Path(home, "out.txt")
        command = ["rs274", "-t", f"{home}/tool.tbl", "-v", f"{home}/empty.var", "-g", program, out]
        run = subprocess.run(command, env={**os.environ, "HOME": home}, capture_output=True, text=True)
        assert run.returncode == 0, run.stdout + run.stderr
        return out.read_text()


def main(folder):
    program = pathlib.Path(folder, "program.gcode").resolve()
    about = json.loads(pathlib.Path(f"{program}.json").read_text())
    words = [re.match(r"(?:G53 )?G1 X(\S+) Y(\S+) F(\S+)", line) for line in program.read_text().splitlines()]
    planned = [[float(v) for v in w.groups()] for w in words if w]
    here, feed, seconds, slack, found, line = about["start_mm"], None, 0.0, 0.0, [], 0.0
    for name, arguments in re.findall(r"(\w+)\(([^)]*)\)", interpret(program)):
        if name == "SET_FEED_RATE":
            feed = float(arguments)
        elif name == "DWELL":
            seconds += float(arguments) + line / 2
            line = 0.0
        elif name == "STRAIGHT_FEED":
            x, y = (float(v) for v in arguments.split(",")[:2])
            length = ((x - here[0]) ** 2 + (y - here[1]) ** 2) ** 0.5
            # Half of the first line of a run before it.
            seconds += 60 * length / feed * (1 if line else 1.5)
            line = 60 * length / feed
            # Ends to 5e-5 mm each, feed to 5e-5 mm/min.
            slack += 60 * (1e-4 / feed + length * 5e-5 / feed**2)
            here = (x, y)
            found.append(here)
    seconds += line / 2
    assert len(found) == len(planned), f"{len(found)} lines for {len(planned)}"
    for (x, y), (px, py, _) in zip(found, planned):
        assert abs(x - px) <= 5.1e-5 and abs(y - py) <= 5.1e-5, f"{x}, {y} for {px}, {py}"
    error = abs(seconds - about["total_time_s"])
    assert error <= slack, f"{seconds} s for {about['total_time_s']}"
    print(f"rs274: {len(found)} lines, total time off by {error:.1e} s of {seconds:.3f} (allowed {slack:.1e})")


# Moves by 1 mm or stands, for 0.4 s each, with the tool on or off.
SEGMENTS = [
    (True, True), (False, True), (True, False), (False, False), (True, True), (False, False), (True, False),
    (True, True), (True, False), (False, True), (True, True),
]
SECONDS = 0.4
START = 1.0

DRIVER = """#!/usr/bin/python3
import linuxcnc, subprocess, time
command, status, errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()
for state in linuxcnc.STATE_ESTOP_RESET, linuxcnc.STATE_ON:
    command.state(state)
    command.wait_complete()
command.mode(linuxcnc.MODE_AUTO)
command.wait_complete()
for i, program in enumerate(["{home}/left_on.ngc", "{program}", "{program}"]):
    sampled = open("{home}/sampled" + str(i), "w")
    sampler = subprocess.Popen(["halsampler", "-t"], stdout=sampled)
    time.sleep(0.3)
    command.program_open(program)
    command.wait_complete()
    command.auto(linuxcnc.AUTO_RUN, 0)
    time.sleep(0.5)
    for _ in range(3000):
        status.poll()
        error = errors.poll()
        if error:
            open("{home}/error", "a").write(str(error))
        if status.interp_state == linuxcnc.INTERP_IDLE and status.inpos:
            break
        time.sleep(0.02)
    time.sleep(0.3)
    sampler.terminate()
    sampler.wait()
"""


def npy(path, kind, shape, values):
    code = {"<f8": "d", "|u1": "B", "<i8": "q"}[kind]
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    header += " " * (63 - (10 + len(header)) % 64) + "\n"
    data = struct.pack(f"<{len(values)}{code}", *values)
    path.write_bytes(b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header.encode() + data)


def bench_program(home, more=None):
    """The program of SEGMENTS, by planish-export, for a machine file with the keys `more`, too."""
    plan = home / "plan"
    plan.mkdir()
    n, x, coefficients = len(SEGMENTS), START, []
    for moves, _ in SEGMENTS:
        d, h = float(moves), SECONDS
        coefficients += [x, 0.0, 3 * d / h**2, -2 * d / h**3] + [0.0] * 4
        x += d
    npy(plan / "break_time_s.npy", "<f8", (n + 1,), [SECONDS * k for k in range(n + 1)])
    npy(plan / "coefficient_mm.npy", "<f8", (n, 2, 4), coefficients)
    npy(plan / "tool_on.npy", "|u1", (n,), [on for _, on in SEGMENTS])
    npy(plan / "dwell_index.npy", "<i8", (n,), [0] * n)
    axis = {"max_velocity_mm_per_s": 100, "max_acceleration_mm_per_s2": 1000}
    machine = {"name": "bench", "axes": [{"name": name, **axis} for name in "xy"], **(more or {})}
    (home / "machine.json").write_text(json.dumps(machine))
    export = ROOT / "target/release/planish-export"
    program = home / "program.ngc"
    command = [export, "gcode", "--trajectory", plan, "--machine", home / "machine.json", "--out", program]
    subprocess.run(command, check=True, capture_output=True)
    return program


# Offsets that an operator may have left: of G54, and of G92.
OFFSETS = "G21 G54\nG10 L2 P1 X10 Y20\nG92 X3 Y4\nM2\n"


def offsets():
    """Positions on the axes after offsets were left: the same with G53, moved by G54 alone without."""
    for more, moved in (({"part_origin_mm": [40, 50]}, (0, 0)), ({}, (10, 20))):
        with tempfile.TemporaryDirectory() as folder:
            home = pathlib.Path(folder)
            program = bench_program(home, more)
            (home / "left.ngc").write_text(OFFSETS)
            for name in ("tool.tbl", "empty.var"):
                (home / name).touch()
            for run in (home / "left.ngc", program):
                command = ["rs274", "-t", home / "tool.tbl", "-v", home / "empty.var", "-g", run, home / "out.txt"]
                subprocess.run(command, env={**os.environ, "HOME": folder}, check=True, capture_output=True)
            calls = (home / "out.txt").read_text()
            assert "DISABLE_FEED_OVERRIDE" in calls and "DISABLE_SPEED_OVERRIDE" in calls, calls
            feeds = re.findall(r"STRAIGHT_FEED\((\S+), (\S+),", calls)
            # Calls are in the coordinates of G54, 10 and 20 mm from the axes.
            x, y = float(feeds[-1][0]) + 10, float(feeds[-1][1]) + 20
            origin = more.get("part_origin_mm", [0, 0])
            end = START + sum(moves for moves, _ in SEGMENTS)
            wanted = origin[0] + end + moved[0], origin[1] + moved[1]
            assert abs(x - wanted[0]) < 1e-3 and abs(y - wanted[1]) < 1e-3, f"{x}, {y} for {wanted}"
    print("rs274: offsets of G54 and G92 move no program with G53, and of the others G54 alone; the overrides are off")


def sampled(home, run):
    rows = [line.split() for line in (home / f"sampled{run}").read_text().splitlines()]
    return [(row[1] == "1", float(row[2]) / linuxcnc.GAIN) for row in rows if len(row) == 4]


def simulate():
    # /tmp is another one in the namespaces of the simulator.
    with tempfile.TemporaryDirectory(dir=ROOT / "target") as folder:
        home = pathlib.Path(folder)
        program = bench_program(home)
        (home / "left_on.ngc").write_text("M64 P0\nG4 P0.1\nM2\n")
        axes = json.loads((home / "machine.json").read_text())["axes"]
        run = linuxcnc.simulate(home, axes, DRIVER.format(home=home, program=program), longest_s=120, speed=1)
        assert run.returncode == 0 and not (home / "error").exists(), run.stdout + run.stderr
        assert sampled(home, 0)[-1][0], "the run before leaves the output on"
        checked = 0
        for run in (1, 2):
            checked += check_samples(sampled(home, run))
    print(f"simulator: output as planned in {checked} samples, two runs of {len(SEGMENTS)} segments, off at the end")


def check_samples(samples):
    """Counts the samples that were compared with the plan."""
    # To the start, then the segments: in the middle of a move, and in the middle of the time at one place.
    first = next(i for i, (_, x) in enumerate(samples) if abs(x - START) < 1e-3)
    moving = [on for on, x in samples[:first] if samples[0][1] != x]
    assert moving and not any(moving), "the output is on during the rapid to the start"
    place, x, checked = first, START, 0
    for moves, planned in SEGMENTS:
        if moves:
            x += 1
            begin = next(i for i in range(place, len(samples)) if samples[i][1] > x - 0.75)
            end = next(i for i in range(place, len(samples)) if samples[i][1] > x - 0.25)
            place = next(i for i in range(place, len(samples)) if samples[i][1] > x - 1e-3)
        else:
            begin = place + int(250 * SECONDS)
            end = place + int(750 * SECONDS)
            assert abs(samples[end][1] - x) < 1e-2, "a dwell was shorter"
        found = {on for on, _ in samples[begin:end]}
        assert found == {planned}, f"at {x} mm, {'move' if moves else 'dwell'}: {found} for {planned}"
        checked += end - begin
    assert not samples[-1][0], "the output is on at the end"
    return checked


if __name__ == "__main__":
    main(sys.argv[1])
    offsets()
    if shutil.which("linuxcnc"):
        simulate()
    else:
        print("simulator: skipped, no linuxcnc")
