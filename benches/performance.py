"""Measures Planish and its peers in one run and writes the tables of docs/performance*: `just performance`.

    performance.py STAGES OUT PAGE

STAGES is the directory of the binaries, OUT where the cases are made, PAGE the page whose tables
are replaced. Whole processes: wall time (median and least of the runs) and the most memory held, as
the process says itself (`--wall-time`). In process: the lines of `cargo bench` (divan), with peers.py
beside them, and the distance of some of them to what limits them.
"""

import csv
import json
import math
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import peers

MACHINE = "fixtures/machines/ion-beam.json"
# Disks of one pixel spacing: (pixels per side, width, mm). The work grows with the area.
DISKS = [(821, 50.0), (1641, 100.0), (4096, 249.6), (8192, 499.2)]


def run(command):
    """Seconds of one process. A negative verdict (exit code 1) is a result."""
    start = time.perf_counter()
    code = subprocess.run([str(part) for part in command]).returncode
    seconds = time.perf_counter() - start
    if code not in (0, 1):
        raise SystemExit(f"{' '.join(map(str, command))}: exit code {code}")
    return seconds


class Whole:
    """Stages as whole processes."""

    def __init__(self, stages, out):
        self.stages, self.out, self.rows = stages, out, []

    def measure(self, work, size, stage, *flags, runs=5):
        told = self.out / "wall.json"
        command = [self.stages / f"planish-{stage}", *flags, "--wall-time", told]
        seconds, memory = [], []
        for _ in range(runs):
            # A stage whose output is there already does nothing.
            shutil.rmtree(flags[-1], ignore_errors=True)
            seconds.append(run(command))
            memory.append(json.loads(told.read_text())["peak_memory_mb"])
        row = {
            "work": work,
            "size": size,
            "runs": runs,
            "median_s": statistics.median(seconds),
            "least_s": min(seconds),
            "memory_mib": max(memory),
        }
        self.rows.append(row)
        print(row, flush=True)
        return row

    def line(self, name, recipe, path_flags, dwell, runs):
        """One mirror through every stage; `dwell` is the solver with its flags. `--out` is the last flag."""
        at = self.out / name
        at.mkdir(parents=True, exist_ok=True)
        (at / "recipe.json").write_text(json.dumps(recipe))
        nx, ny = recipe["pixels"]
        pixels, out = f"{ny} x {nx} px", lambda artifact: ["--out", at / artifact]
        self.measure("fixture", pixels, "fixture", at / "recipe.json", *out("fixture"), runs=1)
        mirror = ["--surface", at / "fixture/surface", "--tif", at / "fixture/tif"]
        self.measure("tool path, raster", pixels, "toolpath", "raster", *mirror, *path_flags, *out("path"), runs=runs)
        points = len(np.load(at / "path/dwell_point_mm.npy", mmap_mode="r"))
        both, path = f"{pixels}, {points} points", ["--tool-path", at / "path"]
        solved = self.measure(f"dwell, {dwell[0]}", both, "dwell", *dwell, *mirror, *path, *out("dwell"), runs=runs)
        planned = ["--dwell", at / "dwell", "--machine", MACHINE]
        for mode in ("smooth", "monotone"):
            moved = self.measure(f"schedule, PVT {mode}", f"{points} segments", "schedule", "pvt", "--mode", mode, *path, *planned, *out("trajectory"), runs=runs)
        motion = ["--trajectory", at / "trajectory"]
        removed = self.measure("simulate", both, "simulate", *motion, *mirror, *out("removal"), runs=runs)
        self.measure("verify", f"{points} segments", "verify", "--machine", MACHINE, *motion, *out("verdict"), runs=runs)
        return {"pixels": nx * ny, "points": points, "dwell": solved, "schedule": moved, "simulate": removed}


def certified(whole):
    """Bounded least squares with its certificate, by pitch and by size: the least time is 0.1 s per mm^2 on the flat, and 0.1 s a
    point on the disks."""
    rows = []
    for name, pitch, runs in (
        ("flat-92x16", 1.0, 3), ("flat-92x16", 0.5, 3), ("flat-92x16", 0.25, 3), ("disk-1641", 0.5, 3), ("disk-4096", 0.5, 1),
    ):
        at = whole.out / name
        least_s = 0.1 * pitch**2 if name.startswith("flat") else 0.1
        mirror = ["--surface", at / "fixture/surface", "--tif", at / "fixture/tif"]
        path = at / f"path-{pitch}"
        run([whole.stages / "planish-toolpath", "raster", *mirror, "--pitch-mm", pitch, "--step-mm", pitch, "--out", path])
        flags = ["bounded-least-squares", "--min-dwell-s", least_s, *mirror, "--tool-path", path, "--out", at / f"certified-{pitch}"]
        row = whole.measure(name, "", "dwell", *flags, runs=runs)
        whole.rows.remove(row)
        found = json.loads((at / f"certified-{pitch}/manifest.json").read_text())["outcome"]["report"]
        points = len(np.load(path / "dwell_point_mm.npy", mmap_mode="r"))
        gap = "none" if found["end"] != "optimal" else f"{found['relative_gap']:.0e}"
        rows.append((
            name, pitch, points, runs, figures(row["least_s"]), figures(row["median_s"]), figures(row["memory_mib"]),
            f"{found['model_rms_nm']:.4f}", f"{found['total_time_s']:.1f}", gap,
        ))
    return (
        ["part", "pitch, mm", "points", "runs", "least, s", "median, s", "memory, MiB", "RMS, nm", "total, s", "relative gap"], rows
    )


def exponent(sizes, times):
    """Slope of log(time) against log(size), least squares."""
    return np.polyfit(np.log(sizes), np.log(times), 1)[0]


def disk(side, width):
    recipe = json.loads(Path("fixtures/disk-100-1641.json").read_text())
    recipe.update(name=f"disk-{side}", pixels=[side, side], width_mm=width)
    recipe["aperture"]["circle"]["diameter_mm"] = width
    # The same spacing for all, so that the spectrum is that of the recipe.
    recipe["scale"]["on_pixels"] = [round(4.11 * width)] * 2
    return recipe


UNITS = {"ns": 1e-9, "µs": 1e-6, "us": 1e-6, "ms": 1e-3, "s": 1.0}


def divan(text):
    """Name, runs, least and median seconds of every line of a divan table."""
    rows, names = [], []
    for line in text.splitlines():
        found = re.match(r"^([│ ]*)[├╰]─ (\S+(?: \S+)*?)\s{2,}(.*)$", line)
        if not found:
            continue
        depth, name, rest = len(found[1]) // 3, found[2], found[3]
        names[depth:] = [name]
        cells = [c.strip() for c in rest.split("│")]
        times = [re.match(r"([\d.]+) (\S+)", c) for c in cells[:3]]
        if len(cells) >= 5 and times[0] and times[2]:
            least, median = (float(t[1]) * UNITS[t[2]] for t in (times[0], times[2]))
            rows.append((" ".join(names), int(cells[4]), least, median))
    return rows


def figures(x):
    """Three significant digits, no exponent."""
    return f"{x:.{max(0, 2 - math.floor(math.log10(abs(x))))}f}"


def table(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, cells)) + " |" for cells in lines)


def replace(page, name, text):
    """Puts a table between its two marks."""
    pattern = rf"(<!-- table: {name} -->\n).*?(<!-- end -->)"
    after, count = re.subn(pattern, lambda m: f"{m[1]}{text}\n{m[2]}", page, flags=re.DOTALL)
    if count != 1:
        raise SystemExit(f"the page has no table {name}")
    return after


def versions():
    cpu = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    names = ("numpy", "scipy", "clarabel")
    return f"{os.cpu_count()} cores ({cpu[1] if cpu else 'unknown'}); " + ", ".join(
        f"{n} {__import__(n).__version__}" for n in names
    )


def main():
    stages, out, page = map(Path, sys.argv[1:])

    def put(name, content):
        page.write_text(replace(page.read_text(), name, content))

    def write(name, head, rows):
        """Writes a long table as a CSV file beside the page."""
        with (page.parent / f"performance-{name}.csv").open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([head, *rows])

    put("machine", f"{versions()}; load when it began: {os.getloadavg()[0]:.1f}.")
    bench = subprocess.run(
        ["cargo", "bench", "--locked", "--workspace", "--bench", "stages"],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    ).stdout
    head = ["work", "runs", "least, ms", "median, ms"]
    in_ms = lambda rows: [(n, r, figures(1e3 * a), figures(1e3 * b)) for n, r, a, b in rows]
    kernels = divan(bench)
    medians = {name: median for name, _, _, median in kernels}
    write("kernels", head, in_ms(kernels))
    write("limits", *limits(medians))

    whole = Whole(stages, out)
    flat = json.loads(Path("fixtures/flat-92x16.json").read_text())
    pitch = ["--pitch-mm", "1", "--step-mm", "1"]
    solver = ["bounded-least-squares", "--min-dwell-s", "0.1"]
    whole.line("flat-92x16", flat, pitch, solver, runs=5)
    pipeline = ["just", "run", "raster", "refine=no", f"out={out / 'raster'}"]
    samples = []
    for _ in range(5):
        shutil.rmtree(out / "raster", ignore_errors=True)
        samples.append(run(pipeline))
    whole.rows.append({
        "work": "`just run raster refine=no`, every stage, 24 frames and the page",
        "size": "168 x 985 px",
        "runs": 5,
        "median_s": statistics.median(samples),
        "least_s": min(samples),
        "memory_mib": None,
    })
    fine = ["--pitch-mm", "0.5", "--step-mm", "0.4"]
    solver = ["lucy-richardson", "--unknowns", "map", "--max-iterations", "20", "--min-dwell-s", "0.02"]
    disks = [
        whole.line(f"disk-{side}", disk(side, width), fine, solver, runs)
        for (side, width), runs in zip(DISKS, (5, 5, 3, 1))
    ]
    columns = ["work", "size", "runs", "least, s", "median, s", "memory, MiB"]
    rows = [
        (r["work"], r["size"], r["runs"], figures(r["least_s"]), figures(r["median_s"]),
         figures(r["memory_mib"]) if r["memory_mib"] else "")
        for r in whole.rows
    ]
    write("processes", columns, rows)
    sides = ("2703", "168 x 985 px, 2703", "1022564", "8192 x 8192 px, 1022564")
    put("whole", table(columns, [row for row in rows if row[1].startswith(sides)]))
    put("growth", growth(disks))
    write("certified", *certified(whole))
    write("ratios", *ratios(medians))
    write("residual", *residuals(whole, stages))
    write("peers", head, in_ms(peers.measure()))


def limits(seconds):
    """What cannot be done faster, and how far from it the work is; `seconds` by name of the kernel."""
    # memory_triad reads two arrays of 256 MiB and writes one.
    bytes_per_s = 3 * 2**28 / seconds["memory_triad 2"]
    # Along the rows and the columns, there and back: each time the nodes are read and written.
    transforms = 4 * 2 * 8 * (8192 + 106) ** 2 / bytes_per_s
    rows = [
        ("convolution f64 8192", f"memory, {bytes_per_s / 1e9:.0f} GB/s: four times over the nodes", transforms),
        ("convolution f32 8192", "the same: its map and its result are in double precision", transforms),
        ("simulate_large (8192, 10000)", "one `convolution f64 8192`", seconds["convolution f64 8192"]),
        ("simulate_large (8192, 1000000)", "one `convolution f64 8192`", seconds["convolution f64 8192"]),
        ("simulate_large (1641, 10000)", "one `convolution f64 1641`", seconds["convolution f64 1641"]),
        ("schedule_pvt_long false 1000000", "memory: 400 bytes a segment, counted in the loops", 4e8 / bytes_per_s),
        ("dwell_lucy_richardson_large true", "two `convolution f64 1641`: what the points reach, and what is left", 2 * seconds["convolution f64 1641"]),
    ]
    return (
        ["work", "limit", "limit, ms", "median, ms", "ratio"],
        [(n, what, figures(1e3 * least), figures(1e3 * seconds[n]), figures(seconds[n] / least)) for n, what, least in rows],
    )


def ratios(seconds):
    """16 times the work in process."""
    rows = []
    for kernel, small, large, what in (
        ("schedule_pvt_long false", "62500", "1000000", "segments"),
        ("schedule_pvt_long true", "62500", "1000000", "segments"),
        ("schedule_trig_spline_long", "42848", "685568", "segments"),
        ("dwell_bounded_least_squares_by_pitch", "1", "0.25", "mm between the points, 16 times as many"),
    ):
        ratio = seconds[f"{kernel} {large}"] / seconds[f"{kernel} {small}"]
        rows.append((kernel, f"{small} to {large} {what}", figures(ratio)))
    return ["work", "from and to", "times"], rows


def residuals(whole, stages):
    """Lucy-Richardson on the disk of 1641 x 1641 pixels: seconds, and what is left."""
    at = whole.out / "disk-1641"
    height, rate = np.load(at / "fixture/surface/height_nm.npy"), np.load(at / "fixture/tif/rate_nm_per_s.npy")
    rows = []
    for dtype in (np.float32, np.float64):
        samples = [peers.lucy_richardson_of(height, rate, 20, dtype) for _ in range(3)]
        seconds = statistics.median(s for s, _ in samples)
        rows.append((f"SciPy, {np.dtype(dtype).name}, dwell times on the pixels", 20, figures(seconds), f"{samples[0][1]:.4f}"))
    told = whole.out / "wall.json"
    for name, steps, flags in (
        ("Planish, squares of pixels, then to the path", 20, []),
        ("Planish, the same, accelerated", 12, ["--accelerated"]),
        ("Planish, every pixel, then to the path", 20, ["--pixels-per-cell", "1"]),
    ):
        command = [
            stages / "planish-dwell", "lucy-richardson", "--unknowns", "map", "--max-iterations", steps, "--min-decrease", "0",
            "--total-variation", "0", *flags, "--surface", at / "fixture/surface", "--tif", at / "fixture/tif",
            "--tool-path", at / "path", "--wall-time", told, "--out", at / "residual",
        ]
        seconds = []
        for _ in range(5):
            shutil.rmtree(at / "residual", ignore_errors=True)
            seconds.append(run(command))
        report = json.loads((at / "residual/manifest.json").read_text())["outcome"]["report"]
        rows.append((name, steps, figures(statistics.median(seconds)), f"{report['model_rms_nm']:.4f}"))
    return ["solver", "steps", "median, s", "RMS of what is left, nm"], rows


def growth(disks):
    """Exponents fitted to the whole processes, and what 16 times the work costs by them."""
    rows = []
    for stage, size in (("dwell", "pixels"), ("schedule", "points"), ("simulate", "pixels")):
        sizes = [d[size] for d in disks]
        for what in ("median_s", "memory_mib"):
            slope = exponent(sizes, [d[stage][what] for d in disks])
            name = "time" if what == "median_s" else "memory"
            unit = size if size == "pixels" else "segments"
            rows.append((stage, name, f"{unit}: {sizes[0]:.2g} to {sizes[-1]:.2g}", f"{slope:.2f}", figures(16**slope)))
    return table(["stage", "of", "against", "exponent", "16 x the work"], rows)


if __name__ == "__main__":
    main()
