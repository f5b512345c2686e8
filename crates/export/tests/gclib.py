"""A simulated Galil in place of gclib: the buffers of PVT mode, outputs and inputs, on a clock of its own.

Every command takes LATENCY_S, and time.sleep passes that time. At the end the file LOG has what happened: lines of
segments in their order, outputs with the number of segments that had run, the largest number of segments in a buffer,
the position, and faults: a segment more than the buffer holds, a buffer that ran empty before the end of the motion.

Source: Galil DMC-40x0 command reference, PV, BT, TM, TP, SB, CB, ST, BG, AI.
"""

import atexit
import json
import os
import time

BUFFER = 255
SETTINGS = json.loads(os.environ["GALIL"])
LATENCY_S = SETTINGS.get("latency_s", 0.0005)
LOG = SETTINGS["log"]

now_s = 0.0


class Galil:
    def __init__(self):
        self.position = dict(zip("AB", SETTINGS["position"]))
        self.queue = {"A": [], "B": []}
        self.moving, self.segment_end_s, self.done = False, 0.0, 0
        self.log = {"lines": [], "commands": [], "outputs": [], "fullest": 0, "faults": []}

    def advance(self, seconds):
        global now_s
        now_s += seconds
        while self.moving and now_s >= self.segment_end_s:
            heads = [self.queue[axis].pop(0) for axis in "AB"]
            for axis, (distance, _, _) in zip("AB", heads):
                self.position[axis] += distance
            self.done += 1
            self.begin_segment()

    def begin_segment(self):
        if not all(self.queue.values()):
            self.log["faults"].append(f"a buffer ran empty after {self.done} segments")
            self.moving = False
            return
        heads = [self.queue[axis][0] for axis in "AB"]
        if heads[0][2] != heads[1][2]:
            self.log["faults"].append("the axes have segments of different times")
        samples = heads[0][2]
        if samples == 0:
            self.moving = False
            for axis in "AB":
                self.queue[axis].pop(0)
            return
        self.segment_end_s += samples * SETTINGS["sample_s"]

    def segment(self, line):
        self.log["lines"].append(line)
        axis, numbers = line[2], [int(n) for n in line[4:].split(",")]
        if numbers == [0, 0, -1]:
            self.queue[axis].clear()
            return
        if len(self.queue[axis]) >= BUFFER:
            self.log["faults"].append(f"a segment more than the buffer holds: {line}")
        self.queue[axis].append(numbers)
        self.log["fullest"] = max(self.log["fullest"], len(self.queue[axis]))

    def answer(self, what):
        if what.startswith("@IN"):
            return 1.0 if now_s > 0.5 else 0.0
        if what == "_TM":
            return SETTINGS["sample_s"] * 1.024e6
        name, axis = what[:3], what[3]
        return {"_TP": self.position[axis], "_BG": float(self.moving), "_BT": float(self.done),
                "_PV": float(BUFFER - len(self.queue[axis]))}[name]

    def command(self, line):
        self.advance(LATENCY_S)
        if line.startswith("MG "):
            return f" {self.answer(line[3:]):.4f}"
        if line.startswith("PV"):
            self.segment(line)
            return ""
        self.log["commands"].append(line)
        if line == "BTAB":
            self.log["lines"].append(line)
            self.moving, self.segment_end_s, self.done = True, now_s, 0
            self.begin_segment()
        elif line == "ST":
            self.moving = False
        elif line[:2] in ("SB", "CB"):
            self.log["outputs"].append([line, self.done, self.moving])
        elif line[:2] != "SH":
            raise RuntimeError(f"? {line}")
        return ""


galil = Galil()
time.sleep = galil.advance


class py:
    def GOpen(self, address):
        galil.log["address"] = address

    def GClose(self):
        pass

    def GCommand(self, line):
        return galil.command(line)


def write_log():
    galil.log["position"] = [galil.position[axis] for axis in "AB"]
    galil.log["time_s"] = now_s
    with open(LOG, "w", encoding="utf-8") as file:
        json.dump(galil.log, file)


atexit.register(write_log)
