#!/usr/bin/env python3
"""Draws the pictures of the method pages from runs: draw.py RUNS PICTURES (`just method-pictures`).

RUNS holds the runs `raster`, `maze` and `dwell` and the artifact `tolerance`. The pictures are SVG files in PICTURES.
The other two pictures there, `pareto.svg` and `campaign.svg`, are drawn by the programs.
"""

import json
import math
import pathlib
import sys

import numpy as np

# Colours of curves that are told apart without colour vision (Okabe and Ito).
COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"]
GREY = "#8a8a8a"


def nice_ticks(low, high, most=6):
    """Returns round numbers from low to high."""
    step = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(step * factor for factor in (1, 2, 5, 10) if (high - low) / (step * factor) <= most)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, int(math.floor(high / step + 1e-9)) + 1)]


class Panel:
    """A pair of axes at a place of the picture, in px; `equal` gives both axes the same scale."""

    def __init__(self, box, x, y, labels, log=False, equal=False):
        self.left, self.top, self.width, self.height = box
        self.x, self.y, self.labels, self.log = x, y, labels, log
        if equal:
            scale = min(self.width / (x[1] - x[0]), self.height / (y[1] - y[0]))
            self.width, self.height = scale * (x[1] - x[0]), scale * (y[1] - y[0])
        self.parts = []

    def at(self, x, y):
        """Returns the place of a point, px."""
        low, high = (math.log10(v) for v in self.y) if self.log else self.y
        y = np.log10(np.maximum(y, self.y[0] * 1e-3)) if self.log else np.asarray(y, float)
        px = self.left + self.width * (np.asarray(x, float) - self.x[0]) / (self.x[1] - self.x[0])
        return px, self.top + self.height * (high - y) / (high - low)

    def line(self, x, y, colour, width=1.6, more=""):
        """Adds a curve; only the part within the panel is drawn."""
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(*self.at(x, y)))
        self.parts.append(
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width}" {more}'
            f'clip-path="url(#c{id(self) % 99991})"/>'
        )

    def dots(self, x, y, colour, radius=2.5):
        """Adds points."""
        for a, b in zip(*self.at(x, y)):
            if self.left - 1 <= a <= self.left + self.width + 1 and self.top - 1 <= b <= self.top + self.height + 1:
                self.parts.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{radius}" fill="{colour}"/>')

    def svg(self, name):
        """Returns the panel with its axes."""
        right, bottom = self.left + self.width, self.top + self.height
        out = [f'<clipPath id="{name}"><rect x="{self.left}" y="{self.top}" width="{self.width:.1f}" height="{self.height:.1f}"/></clipPath>']
        x_ticks = nice_ticks(*self.x)
        if self.log:
            powers = range(math.ceil(math.log10(self.y[0]) - 1e-9), int(math.log10(self.y[1]) + 1e-9) + 1)
            y_ticks = [10.0**k for k in powers]
        else:
            y_ticks = nice_ticks(*self.y)
        for tick in x_ticks:
            px = float(self.at(tick, self.y[1])[0])
            out.append(f'<path d="M{px:.1f} {self.top}V{bottom:.1f}" stroke="#e2e2e2"/>')
            out.append(f'<text x="{px:.1f}" y="{bottom + 17:.1f}" text-anchor="middle">{tick:.6g}</text>')
        for tick in y_ticks:
            py = float(self.at(self.x[0], tick)[1])
            out.append(f'<path d="M{self.left} {py:.1f}H{right:.1f}" stroke="#e2e2e2"/>')
            out.append(f'<text x="{self.left - 6}" y="{py + 4:.1f}" text-anchor="end">{tick:.6g}</text>')
        out.append(f'<rect x="{self.left}" y="{self.top}" width="{self.width:.1f}" height="{self.height:.1f}" fill="none" stroke="#444"/>')
        out += [part.replace(f"#c{id(self) % 99991}", f"#{name}") for part in self.parts]
        middle = (self.top + bottom) / 2
        out.append(f'<text x="{(self.left + right) / 2:.1f}" y="{bottom + 36:.1f}" text-anchor="middle">{self.labels[0]}</text>')
        out.append(f'<text transform="translate({self.left - 46} {middle:.1f}) rotate(-90)" text-anchor="middle">{self.labels[1]}</text>')
        return out


def write(path, size, panels, names):
    """Writes a picture: its panels, and the names of the curves above them."""
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0]}" height="{size[1]}" viewBox="0 0 {size[0]} {size[1]}" font-family="sans-serif" font-size="13">']
    out.append('<rect width="100%" height="100%" fill="#fff"/>')
    left = panels[0].left
    for name, colour in names:
        out.append(f'<path d="M{left} 16h22" stroke="{colour}" stroke-width="3"/><text x="{left + 28}" y="20">{name}</text>')
        left += 48 + 7.2 * len(name)
    for k, panel in enumerate(panels):
        out += panel.svg(f"p{k}")
    path.write_text("\n".join(out + ["</svg>", ""]), encoding="utf-8")


class Motion:
    """A trajectory artifact."""

    def __init__(self, folder):
        self.time = np.load(folder / "break_time_s.npy")
        self.coefficient = np.load(folder / "coefficient_mm.npy")

    def at(self, time):
        """Returns position (mm) and speed (mm/s) at times, s."""
        k = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.coefficient) - 1)
        u = (time - self.time[k])[:, None]
        c = self.coefficient[k]
        position = c[:, :, 0] + u * (c[:, :, 1] + u * (c[:, :, 2] + u * c[:, :, 3]))
        velocity = c[:, :, 1] + u * (2 * c[:, :, 2] + 3 * u * c[:, :, 3])
        return position, np.hypot(*velocity.T)


def dwell(runs, pictures):
    """Draws the desired removal and the dwell densities of four solvers along a pass in the middle of the map."""
    run = runs / "dwell"
    point = np.load(run / "tool_path/point_mm.npy")
    middle = np.load(run / "tool_path/dwell_point_mm.npy")
    height = np.load(run / "surface/height_nm.npy")
    x, y = (np.load(run / f"surface/{axis}_mm.npy") for axis in "xy")
    rows = middle[:, 1]
    line = rows[np.argmin(abs(rows - y.mean()))]
    here = np.flatnonzero(abs(rows - line) < 1e-6)
    here = here[np.argsort(middle[here, 0])]
    row = height[np.argmin(abs(y - line))]
    span = (float(middle[here, 0].min()), float(middle[here, 0].max()))
    top = Panel((70, 40, 640, 110), span, (0, float(np.nanmax(row)) * 1.1), ("", "removal, nm"))
    top.line(x, row, "#333")
    bottom = Panel((70, 185, 640, 230), span, (3e-3, 30), ("x along one pass, mm", "dwell density, s/mm"), log=True)
    solvers = ["bounded-least-squares", "lucy-richardson", "rifta", "nnls"]
    length = np.hypot(*np.diff(point, axis=0).T)
    for solver, colour in zip(solvers, COLOURS):
        density = np.load(run / f"solvers/{solver}/dwell/dwell_s.npy") / length
        bottom.line(middle[here, 0], density[here], colour)
    names = list(zip(["bounded-least-squares", "lucy-richardson", "rifta", "non-negative-least-squares"], COLOURS))
    write(pictures / "dwell.svg", (740, 470), [top, bottom], names)


def schedulers(runs, pictures):
    """Draws the curve and the speed of four schedulers around the fastest corners of a maze."""
    run = runs / "maze"
    point = np.load(run / "tool_path/point_mm.npy")
    time = np.concatenate([[0], np.cumsum(np.load(run / "dwell/dwell_s.npy"))])
    # Window of segments with the least time, away from both ends.
    count = 14
    first = 40 + int(np.argmin(time[40 + count : -40] - time[40 : -40 - count]))
    window = (time[first], time[first + count])
    part = point[first - 4 : first + count + 5]
    shown = part[4:-4]
    centre, half = (shown.min(0) + shown.max(0)) / 2, float(np.ptp(shown, axis=0).max()) / 2 + 0.6
    left = Panel(
        (70, 40, 330, 330),
        (centre[0] - half, centre[0] + half),
        (centre[1] - half, centre[1] + half),
        ("x, mm", "y, mm"),
        equal=True,
    )
    left.line(part[:, 0], part[:, 1], "#cccccc", 5)
    left.dots(shown[:, 0], shown[:, 1], "#555")
    methods = ["pvt", "pvt+smooth", "constant-acceleration", "trig-spline"]
    curves = []
    for method in methods:
        motion = Motion(run / f"methods/{method}/trajectory")
        index = np.load(run / f"methods/{method}/trajectory/dwell_index.npy")
        own = np.flatnonzero((index >= first) & (index < first + count))
        begin, end = motion.time[own[0]], motion.time[own[-1] + 1]
        instants = np.linspace(begin, end, 500)
        curves.append((instants - begin, *motion.at(instants)))
    fastest = max(speed.max() for _, _, speed in curves)
    longest = max(instants[-1] for instants, _, _ in curves)
    right = Panel((480, 40, 330, 330), (0, longest), (0, fastest * 1.05), ("time, s", "speed, mm/s"))
    for (instants, position, speed), colour in zip(curves, COLOURS):
        left.line(position[:, 0], position[:, 1], colour)
        right.line(instants, speed, colour)
    names = list(zip(["pvt, monotone", "pvt, smooth", "constant-acceleration", "trig-spline"], COLOURS))
    write(pictures / "schedulers.svg", (840, 425), [left, right], names)


def refine(runs, pictures):
    """Draws the residual and the total time of every round of the closed loop."""
    at = runs / "raster/methods/pvt+refined/iterations"
    rms, total = np.load(at / "rms_nm.npy"), np.load(at / "total_time_s.npy")
    rounds = np.arange(len(rms))
    left = Panel((70, 25, 290, 230), (0, len(rms) - 1), (0.1, 10), ("round", "residual, nm RMS"), log=True)
    left.line(rounds, rms, COLOURS[0])
    left.dots(rounds, rms, COLOURS[0])
    low, high = float(total.min()), float(total.max())
    margin = 0.08 * (high - low)
    right = Panel((450, 25, 290, 230), (0, len(rms) - 1), (low - margin, high + margin), ("round", "total time, s"))
    right.line(rounds, total, COLOURS[1])
    right.dots(rounds, total, COLOURS[1])
    write(pictures / "refine.svg", (770, 305), [left, right], [])


def joint(runs, pictures):
    """Draws the turn between two passes, and the speed along a pass, of the closed loop and of the joint plan."""
    run = runs / "raster"
    point = np.load(run / "tool_path/point_mm.npy")
    middle = np.load(run / "tool_path/dwell_point_mm.npy")
    lines = np.unique(middle[:, 1].round(6), return_counts=True)
    usual = lines[0][lines[1] > 0.8 * lines[1].max()]
    y0, y1 = usual[len(usual) // 2 - 1 : len(usual) // 2 + 1]
    on_line = np.flatnonzero(abs(middle[:, 1] - y0) < 1e-6)
    end = point[on_line[-1] + 1]
    side = 1.0 if end[0] > middle[:, 0].mean() else -1.0
    x_range = sorted([end[0] - side * 2.2, end[0] + side * 0.8])
    left = Panel((70, 40, 300, 300), x_range, ((y0 + y1) / 2 - 1.5, (y0 + y1) / 2 + 1.5), ("x, mm", "y, mm"), equal=True)
    left.line(point[:, 0], point[:, 1], "#cccccc", 5)
    right = Panel((450, 40, 330, 300), (float(point[:, 0].min()), float(point[:, 0].max())), (0.03, 50),
                  ("x along one pass, mm", "speed, mm/s"), log=True)
    for method, colour in zip(["pvt+refined", "joint"], COLOURS):
        motion = Motion(run / f"methods/{method}/trajectory")
        index = np.load(run / f"methods/{method}/trajectory/dwell_index.npy")
        own = np.flatnonzero((index >= on_line[0]) & (index <= on_line[-1]))
        position, speed = motion.at(np.linspace(motion.time[own[0]], motion.time[own[-1] + 1], 600))
        right.line(position[:, 0], speed, colour)
        near = np.flatnonzero((index >= on_line[-1] - 4) & (index <= on_line[-1] + 8))
        position, _ = motion.at(np.linspace(motion.time[near[0]], motion.time[near[-1] + 1], 800))
        left.line(position[:, 0], position[:, 1], colour)
    names = [("closed loop (pvt, refined)", COLOURS[0]), ("joint plan", COLOURS[1])]
    write(pictures / "joint.svg", (810, 395), [left, right], names)


def tolerance(runs, pictures):
    """Draws a bar for the added residual of every process error, split by what the tool reaches."""
    outcome = json.loads((runs / "tolerance/manifest.json").read_text())["outcome"]
    errors = sorted(outcome["errors"], key=lambda error: -error["adds_rms_nm"])
    width, left, row = 400, 190, 20
    largest = errors[0]["adds_rms_nm"]
    height = 40 + row * len(errors)
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + width + 150}" height="{height + 40}" '
           f'viewBox="0 0 {left + width + 150} {height + 40}" font-family="sans-serif" font-size="13">',
           '<rect width="100%" height="100%" fill="#fff"/>']
    for k, error in enumerate(errors):
        y = 30 + row * k
        reached, missed = error["reached_rms_nm"] ** 2, error["unreached_rms_nm"] ** 2
        bar = width * error["adds_rms_nm"] / largest
        part = bar * reached / (reached + missed) if reached + missed > 0 else 0
        out.append(f'<text x="{left - 8}" y="{y + 13}" text-anchor="end">{error["kind"]}</text>')
        out.append(f'<rect x="{left}" y="{y}" width="{part:.1f}" height="{row - 5}" fill="{COLOURS[0]}"/>')
        out.append(f'<rect x="{left + part:.1f}" y="{y}" width="{bar - part:.1f}" height="{row - 5}" fill="{COLOURS[1]}"/>')
        out.append(f'<text x="{left + bar + 6:.1f}" y="{y + 13}">{error["adds_rms_nm"]:.3f}</text>')
    out.append(f'<text x="{left}" y="20">added residual, nm RMS; its mean square in waves that the tool '
               f'<tspan fill="{COLOURS[0]}">reaches</tspan> and <tspan fill="{COLOURS[1]}">does not reach</tspan></text>')
    residual = outcome["residual"]
    out.append(f'<text x="{left}" y="{height + 18}">without errors {outcome["nominal_rms_nm"]:.3f} nm; with all errors '
               f'{residual["median_nm"]:.3f} nm in half of the runs</text>')
    (pictures / "tolerance.svg").write_text("\n".join(out + ["</svg>", ""]), encoding="utf-8")


def main():
    runs, pictures = (pathlib.Path(word) for word in sys.argv[1:3])
    pictures.mkdir(parents=True, exist_ok=True)
    for draw in (dwell, schedulers, refine, joint, tolerance):
        draw(runs, pictures)


if __name__ == "__main__":
    main()
