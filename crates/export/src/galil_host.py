#!/usr/bin/env python3
"""Host of a Galil PVT program that planish export wrote: fills the buffer, begins, refills, switches the tool.

    python3 galil_host.py ADDRESS PROGRAM [PROGRAM ...]

PROGRAM is a program, or all its parts in their order. FILE.json beside each is read. The script needs gclib of Galil,
and Python 3.8 or later. It moves nothing before all checks have passed, and switches the tool off before anything else
if something fails, or on Ctrl-C.
"""

import argparse
import json
import re
import sys
import time
import zlib

BUFFER = 255  # segments of an axis that the controller holds (command reference, PV)
POLL_S = 0.01  # time between two questions while the buffer is full, s
SERVO_TOLERANCE = 20  # largest distance of the axes from the start, counts


class Refusal(Exception):
    """A reason not to begin."""


class Fault(Exception):
    """A reason to stop."""


def read_part(path):
    """Lines, checksum and description of a file."""
    with open(path, encoding="ascii") as file:
        lines = file.read().splitlines()
    with open(path + ".json", encoding="utf-8") as file:
        about = json.load(file)
    stated = re.search(r"checksum: crc32 ([0-9a-f]{8}) of the lines below", lines[0])
    found = format(zlib.crc32("".join(line + "\n" for line in lines[1:]).encode()), "08x")
    if not stated or stated.group(1) != found:
        raise Refusal(f"{path}: its checksum is {found}, not that of its first line: it was changed; export it again")
    if about["controller"] != "galil":
        raise Refusal(f"{path}: is a program for {about['controller']}")
    dry = any("DRY RUN" in line for line in lines if line.startswith("'"))
    if dry != about.get("dry_run", False):
        raise Refusal(f"{path}: its head and {path}.json disagree about a dry run")
    return lines, found, about


def read_program(paths):
    """All commands in their order, as (kind, line), and the descriptions of the parts."""
    parts = [read_part(path) for path in paths]
    before = None
    for number, (path, (_, checksum, about)) in enumerate(zip(paths, parts), 1):
        part = about.get("part", {"number": 1, "parts": 1})
        if part["number"] != number or part["parts"] != len(paths) or part.get("after") != before:
            raise Refusal(f"{path}: is part {part['number']} of {part['parts']}; give all parts of one program in order")
        before = checksum
    commands, block = [], None
    for line in (line for lines, _, _ in parts for line in lines):
        if line.startswith("'"):
            word = line[1:].strip()
            for name in ("prologue", "epilogue"):
                if word == f"{name} of the machine file":
                    block = name
                elif word == f"end of the {name}":
                    block = None
            continue
        commands.append((block or line[:2], line))
    return commands, [about for _, _, about in parts]


class Host:
    def __init__(self, controller, abouts):
        self.controller = controller
        self.about = abouts[0]
        self.last = abouts[-1]
        self.marks = [mark for about in abouts for mark in about["marks"]]
        self.is_dry = self.about.get("dry_run", False)
        axes = self.about.get("axes") or [
            {"start": p, "count": c} for p, c in zip(self.about["start_mm"], self.about["count_mm"])]
        self.letters = "ABCDE"[: len(axes)]
        self.start = [round(axis["start"] / axis["count"]) for axis in axes]
        excerpt = self.about.get("excerpt", {})
        self.on_after = excerpt.get("run_up_segments", 0)
        self.off_after = len(self.marks) - excerpt.get("run_down_segments", 0)
        self.is_on = False
        self.has_begun = False

    def ask(self, what):
        return float(self.controller.GCommand("MG " + what).strip())

    def tool(self, on):
        if self.is_dry and on:
            return
        for line in self.about.get("tool_on_lines" if on else "tool_off_lines", []):
            self.controller.GCommand(line)
        self.is_on = on

    def wait_for_input(self, number):
        """AI n: input n high, or -n low, as the command waits within a program of the controller."""
        while (self.ask(f"@IN[{abs(number)}]") != 0) != (number > 0):
            time.sleep(POLL_S)

    def machine_line(self, line):
        """A line of the machine file; WT and AI wait in programs of the controller only, so the host waits."""
        if line[:2] == "WT":
            time.sleep(float(line[2:].split(",")[0]) / 1e3)
        elif line[:2] == "AI":
            self.wait_for_input(int(float(line[2:].split(",")[0])))
        else:
            self.controller.GCommand(line)

    def check(self, tolerance):
        """Refuses a controller that would make another motion of the program."""
        if not self.is_dry and not self.about.get("tool_on_lines"):
            raise Refusal("the machine file states no tool_on and tool_off: nothing would switch the tool")
        tm = self.about["sample_s"] * 1.024e6
        if abs(self.ask("_TM") - tm) > 1e-3 * tm:
            raise Refusal(f"TM is {self.ask('_TM'):g}, and the program is for TM {tm:g}")
        for letter, start in zip(self.letters, self.start):
            here = self.ask("_TP" + letter)
            if abs(here - start) > tolerance:
                raise Refusal(f"axis {letter} stands at {here:.0f} counts, the program begins at {start}")
            if self.ask("_BG" + letter) != 0:
                raise Refusal(f"axis {letter} moves")

    def follow(self):
        """Switches the tool by the number of segments that have run, and refuses a motion that ended early."""
        if not self.has_begun:
            return
        done = self.ask("_BTA")
        is_moving = self.ask("_BGA") != 0
        wanted = is_moving and self.on_after <= done < self.off_after
        if wanted != self.is_on:
            self.tool(wanted)
        if not is_moving and not self.is_ended:
            raise Fault(f"the motion ended after {done:.0f} segments: the buffer ran empty, or an axis stopped")

    def run(self, commands):
        room = dict.fromkeys(self.letters, 0)
        self.is_ended = False
        for kind, line in commands:
            if kind == "prologue":
                self.machine_line(line)
            elif kind == "PV":
                letter = line[2]
                if line.endswith("=0,0,-1"):
                    self.controller.GCommand(line)
                    continue
                while room[letter] < 1:
                    self.follow()
                    room[letter] = int(self.ask("_PV" + letter))
                    if room[letter] < 1:
                        time.sleep(POLL_S)
                self.controller.GCommand(line)
                room[letter] -= 1
            elif kind == "BT":
                self.controller.GCommand(line)
                self.has_begun = True
                self.follow()
        self.is_ended = True
        while self.ask("_BGA") != 0:
            self.follow()
            time.sleep(POLL_S)
        self.tool(False)
        for kind, line in commands:
            if kind == "epilogue":
                self.machine_line(line)

    def stop(self):
        try:
            self.tool(False)
        finally:
            self.controller.GCommand("ST")
        if self.has_begun:
            done = int(self.ask("_BTA"))
            mark = self.marks[min(done, len(self.marks) - 1)]
            print(f"stopped after {done} segments, mark {done}: line, time s, position: {mark}", file=sys.stderr)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("address", help="address of the controller, as gclib takes it")
    parser.add_argument("program", nargs="+", help="program, or all its parts in their order")
    parser.add_argument("--start-tolerance", type=float, default=SERVO_TOLERANCE, metavar="COUNTS",
                        help="largest distance of the axes from the start, counts (default: %(default)s)")
    arguments = parser.parse_args()
    try:
        commands, abouts = read_program(arguments.program)
        import gclib
        controller = gclib.py()
        controller.GOpen(arguments.address)
        host = Host(controller, abouts)
    except (Refusal, OSError, KeyError, ValueError) as problem:
        sys.exit(f"{problem}; nothing was sent")
    try:
        host.tool(False)
        host.check(arguments.start_tolerance)
        host.run(commands)
    except Refusal as problem:
        sys.exit(f"{problem}; nothing has moved")
    except Fault as problem:
        host.stop()
        sys.exit(str(problem))
    except BaseException:
        host.stop()
        raise
    finally:
        controller.GClose()
    print(f"{len(host.marks)} segments, {host.last['total_time_s']:.4f} s")


if __name__ == "__main__":
    main()
