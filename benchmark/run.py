"""Runs the methods on the problems of the benchmark, scores their motions, and writes the table.

  python3 benchmark/run.py                     all problems
  python3 benchmark/run.py coupon wafer-100    these problems
  --jobs N    problems at the same time (default: the processors)
  --out DIR   runs and scores (default: out/benchmark)

A problem that has its scores is not run again. A measured problem whose part is missing is left out, with the reason.
The methods are all schedulers along three tool paths, as `planish-run compare` runs them, the closed loop and the joint
plan among them. A line has one path. The pitch is a quarter of the width of the tool; the other settings are those of the
pipelines.
"""

import argparse
import ast
import csv
import json
import math
import os
import struct
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = ROOT / "target/release"
FOLDER = ROOT / "benchmark/problems"
COLUMNS = [
    "time_s",
    "residual_rms_nm",
    "residual_rms_detilted_nm",
    "residual_pv_nm",
    "slope_rms_nrad",
    "bound_rms_nm",
    "reached_rms_nm",
    "excess",
]


def start(program, *words, log):
    """Runs a program and returns its exit code and what it printed; messages go to the log."""
    with log.open("a") as messages:
        command = [PROGRAMS / program, *map(str, words)]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=messages, text=True)
    return done.returncode, done.stdout


def array(file):
    """Returns the shape and the numbers of an array of doubles in NumPy's format."""
    content = file.read_bytes()
    start = 10 + struct.unpack("<H", content[8:10])[0]
    header = content[10:start].decode()
    shape = ast.literal_eval(header)["shape"]
    return shape, struct.unpack(f"<{(len(content) - start) // 8}d", content[start:])


def pitch_mm(tif):
    """Returns a quarter of the width of the tool at half its peak, mm: that of a disk of the same area."""
    _, rate = array(tif / "rate_nm_per_s.npy")
    steps = [x[1] - x[0] for _, x in (array(tif / f"{axis}_mm.npy") for axis in "xy")]
    area = sum(value >= 0.5 * max(rate) for value in rate) * steps[0] * steps[1]
    return round(0.25 * math.sqrt(4 * area / math.pi), 2)


def part(problem, out, log):
    """Returns the command that runs all methods, and its settings; None if the part is missing."""
    if "measured" in problem:
        folder = FOLDER / problem["measured"]["folder"]
        if not (folder / "surface").exists():
            return None
        line = folder / "line.json"
        if line.exists():
            return ["run", "line"], json.loads(line.read_text())
    else:
        folder = out / "part"
        start("planish-fixture", FOLDER / problem["recipe"], "--out", folder, "--force", log=log)
    pitch = pitch_mm(folder / "tif")
    return ["compare"], {"surface": folder / "surface", "tif": folder / "tif", "pitch_mm": pitch}


def run(name, out):
    """Runs and scores a problem. Returns its name, its scores, and a reason if it has none."""
    out = out / "runs" / name
    scores = out / "scores.json"
    if scores.exists():
        return name, json.loads(scores.read_text()), None
    out.mkdir(parents=True, exist_ok=True)
    log = out / "log.txt"
    log.unlink(missing_ok=True)
    problem = json.loads((FOLDER / f"{name}.json").read_text())
    task = part(problem, out, log)
    if task is None:
        return name, [], "its part is missing; benchmark/measured.py makes it"
    command, settings = task
    settings |= {"machine": FOLDER / problem["machine"], "frames": 0, "out": out / "plans"}
    words = [f"{key}={value}" for key, value in settings.items()]
    code, _ = start("planish-run", *command, *words, log=log)
    if code > 1:
        return name, [], f"`planish-run {' '.join(command)}` ended with code {code}; see {log}"
    motions = sorted((out / "plans").glob("**/methods/*/trajectory"))
    code, text = start("planish-benchmark", "score", "--no-errors", FOLDER / f"{name}.json", *motions, log=log)
    if code > 1:
        return name, [], f"`planish-benchmark score` ended with code {code}; see {log}"
    rows = json.loads(text)
    for row in rows:
        place = Path(row.pop("submission"))
        path = "line" if place.parts[-4] == "plans" else place.parts[-4]
        row["method"] = f"{path} {place.parts[-2]}"
    scores.write_text(json.dumps(rows, indent=2) + "\n")
    return name, rows, None


def write_tables(scored, out):
    """Writes every score, and the table of the excess in percent: rows are methods, columns problems."""
    with (out / "scores.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["problem", "method", *COLUMNS, "refused"])
        for name, rows in scored.items():
            for row in rows:
                numbers = [row.get(column) for column in COLUMNS]
                writer.writerow([name, row["method"], *numbers, row.get("refused")])
    methods = sorted({row["method"] for rows in scored.values() for row in rows})
    with (out / "excess.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["excess over the bound, %", *scored])
        for method in methods:
            cells = [cell(row for row in rows if row["method"] == method) for rows in scored.values()]
            writer.writerow([method, *cells])
    for name, rows in scored.items():
        valid = [row for row in rows if "excess" in row]
        best = min(valid, key=lambda row: row["excess"], default=None)
        if best:
            print(
                f"{name:28} {best['method']:36} {best['time_s']:8.1f} s {best['residual_rms_nm']:9.4f} nm, "
                f"bound {best['bound_rms_nm']:9.4f} nm, excess {100 * best['excess']:6.1f} %"
            )


def cell(rows):
    """Returns the excess of a method on a problem, in percent; nothing if it has no motion there."""
    row = next(rows, {})
    return f"{100 * row['excess']:.1f}" if "excess" in row else ("breaks a limit" if row else "")


def main():
    parser = argparse.ArgumentParser(description="Run and score the methods on the problems of the benchmark.")
    parser.add_argument("problems", nargs="*", help="names of problems; all if none is given")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="problems at the same time")
    parser.add_argument("--out", type=Path, default=ROOT / "out/benchmark", help="runs and scores")
    arguments = parser.parse_args()
    names = arguments.problems or sorted(file.stem for file in FOLDER.glob("*.json"))
    unknown = [name for name in names if not (FOLDER / f"{name}.json").exists()]
    if unknown:
        sys.exit(f"{unknown[0]}: no problem of benchmark/problems")
    out = arguments.out.resolve()
    scored, failed = {}, False
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for name, rows, reason in pool.map(lambda name: run(name, out), names):
            if reason:
                print(f"{name}: left out: {reason}", file=sys.stderr)
                failed |= "missing" not in reason
            else:
                scored[name] = rows
    if scored:
        write_tables(scored, out)
        every = [row["excess"] for rows in scored.values() for row in rows if "excess" in row]
        # The bound is (1) of its module in double precision.
        below = sum(excess < -1e-9 for excess in every)
        failed |= below > 0
        print(f"{below} of {len(every)} motions are below the bound")
        print(f"-> {out / 'scores.csv'}, {out / 'excess.csv'}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
