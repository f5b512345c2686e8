"""A G-code program as LinuxCNC's interpreter (rs274) understands it, against the table of the plan.

    python interpreter.py RUN        RUN/program.gcode of a run with export=gcode

The interpreter prints canonical calls: STRAIGHT_FEED(x, y, ...) and SET_FEED_RATE(mm/min), both with
four decimals, DWELL(s). A line takes 60 length / feed. Compared: every end against the program's own
words to half of the last decimal, and the total time against the header to the 5e-5 of the feed.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile


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
    words = [re.match(r"G1 X(\S+) Y(\S+) F(\S+)", line) for line in program.read_text().splitlines()]
    planned = [[float(v) for v in w.groups()] for w in words if w]
    here, feed, seconds, slack, found = about["start_mm"], None, 0.0, 0.0, []
    for name, arguments in re.findall(r"(\w+)\(([^)]*)\)", interpret(program)):
        if name == "SET_FEED_RATE":
            feed = float(arguments)
        elif name == "DWELL":
            seconds += float(arguments)
        elif name == "STRAIGHT_FEED":
            x, y = (float(v) for v in arguments.split(",")[:2])
            length = ((x - here[0]) ** 2 + (y - here[1]) ** 2) ** 0.5
            seconds += 60 * length / feed
            # Ends to 5e-5 mm each, feed to 5e-5 mm/min.
            slack += 60 * (1e-4 / feed + length * 5e-5 / feed**2)
            here = (x, y)
            found.append(here)
    assert len(found) == len(planned), f"{len(found)} lines for {len(planned)}"
    for (x, y), (px, py, _) in zip(found, planned):
        assert abs(x - px) <= 5.1e-5 and abs(y - py) <= 5.1e-5, f"{x}, {y} for {px}, {py}"
    error = abs(seconds - about["total_time_s"])
    assert error <= slack, f"{seconds} s for {about['total_time_s']}"
    print(f"rs274: {len(found)} lines, total time off by {error:.1e} s of {seconds:.3f} (allowed {slack:.1e})")


if __name__ == "__main__":
    main(sys.argv[1])
