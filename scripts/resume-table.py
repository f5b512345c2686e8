"""Interrupts runs at random times, plans the rest, and prints how much of the undisturbed residual is reached.

    just resume-table                               three fixtures, 30 times each
    just resume-table coupon times=3 tool_on=0.1,1  one fixture, fewer times, some of the rows
    just resume-table coupon plan_joint=yes         where the closed loop alone does not mend the run, also by a joint plan

The log of the executed motion has noise of 0.1 um at 200 Hz. Every row is one time for which the tool stayed on.
"""

import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

FIXTURES = ["coupon", "disk-20", "flat-92x16"]
TOOL_ON_S = [0.0, 0.1, 1.0]
OUT = Path("out/resume-table")
PLANISH = Path(os.environ.get("PLANISH_PROGRAMS", "target/release")) / "planish"
RATE_HZ = 200
NOISE_MM = 1e-4
PLAN = "pvt+refined"


def planish(*words, codes=(0, 1)):
    """Runs a command of Planish without its messages; fails with them if the exit code is another one."""
    ended = subprocess.run([PLANISH, *map(str, words)], capture_output=True, text=True)
    if ended.returncode not in codes:
        sys.exit(ended.stdout + ended.stderr)


def load(trajectory, name):
    return np.load(trajectory / f"{name}.npy")


def write_log(trajectory, abort_s, noise, path):
    """Writes the log of the motion until the abort: time, noisy positions, state of the tool."""
    starts, c, on = (load(trajectory, name) for name in ["break_time_s", "coefficient_mm", "tool_on"])
    time = np.arange(0, abort_s, 1 / RATE_HZ)
    k = np.clip(np.searchsorted(starts, time, side="right") - 1, 0, len(c) - 1)
    u = time - starts[k]
    p = sum(c[k, :, n] * u[:, None] ** n for n in range(4)) + noise.normal(0, NOISE_MM, (len(time), 2))
    rows = np.column_stack([time, p, on[k]])
    np.savetxt(path, rows, delimiter=",", header="time_s,x_mm,y_mm,tool_on", comments="", fmt="%.9g")


def resumed(run, log, tool_on_s, plan_joint, rest):
    """Plans the rest of an interrupted run, and returns what `planish resume` says of it."""
    shutil.rmtree(rest, ignore_errors=True)
    planish("resume", f"run={run}", f"plan={PLAN}", f"log={log}", "trace=--tool-on=tool_on",
            f"tool_on_s={tool_on_s}", f"plan_joint={plan_joint}", "new_path=no", f"out={rest}")
    return json.loads((rest / "resume.json").read_text())


def row(run, fixture, times, tool_on_s, plan_joint):
    """Plans the rest after each of the times; returns the ratios to the undisturbed residual, and the named marks."""
    trajectory = run / "methods" / PLAN / "trajectory"
    rest = OUT / fixture / f"rest-{tool_on_s:g}"
    ratios, marks = [], []
    for k, abort_s in enumerate(times):
        log = OUT / fixture / f"log-{tool_on_s:g}.csv"
        write_log(trajectory, abort_s, np.random.default_rng(k), log)
        outcome = resumed(run, log, tool_on_s, "no", rest)
        if plan_joint and not outcome["is_mended"]:
            outcome = resumed(run, log, tool_on_s, "yes", rest)
        best = next(way for way in outcome["ways"] if way["name"] == outcome["recommended"])
        ratio = best["rms_nm"] / outcome["undisturbed_rms_nm"]
        ratios.append(ratio)
        if not outcome["is_mended"]:
            marks.append(best["mark"]["depth_nm"])
            x, y = outcome["executed"]["place_mm"]
            print(f"  {fixture}, {tool_on_s:g} s: abort at {abort_s:.2f} s, ({x:.2f}, {y:.2f}) mm: {ratio:.3f}, "
                  f"mark {best['mark']['depth_nm']:.2f} nm at {best['mark']['place_mm']} mm, at once beyond the plan "
                  f"{outcome['mark']['depth_nm']:.2f} nm", file=sys.stderr, flush=True)
    return ratios, marks


def main():
    words = sys.argv[1:]
    count = next((int(word[6:]) for word in words if word.startswith("times=")), 30)
    chosen = next((word[8:] for word in words if word.startswith("tool_on=")), None)
    seconds = [float(s) for s in chosen.split(",")] if chosen else TOOL_ON_S
    plan_joint = "plan_joint=yes" in words
    fixtures = [word for word in words if "=" not in word] or FIXTURES
    print("| fixture | tool on s | mended | largest ratio of these | named marks, nm |")
    print("|---|---|---|---|---|")
    for fixture in fixtures:
        run = OUT / fixture / "run"
        planish("run", "raster", f"fixture={fixture}", "plan_joint=no", "frames=0", f"out={run}")
        total_s = load(run / "methods" / PLAN / "trajectory", "break_time_s")[-1]
        draw = random.Random(67)
        times = [total_s * draw.uniform(0.02, 0.98) for _ in range(count)]
        for tool_on_s in seconds:
            ratios, marks = row(run, fixture, times, tool_on_s, plan_joint)
            mended = [ratio for ratio in ratios if ratio <= 1.05]
            named = f"{min(marks):.2f} to {max(marks):.2f}" if marks else "none"
            largest = f"{max(mended):.4f}" if mended else "-"
            print(f"| `{fixture}` | {tool_on_s} | {len(mended)} of {count} | {largest} | {named} |", flush=True)


main()
